"""Corrections and findings of a fix: typed values, of which its provenance holds the texts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from giantlike.core.findings import Corrections, Findings, Response, Smear
from giantlike.core.outcomes import CenterFix

TABLE = Response(bend=0.712345678, dark_dn=20.1234567, bright_dn=220.0)


def fix(corrections: Corrections, findings: Findings) -> CenterFix:
    return CenterFix(
        estimator="own",
        target="BODY",
        center_px=np.zeros(2),
        covariance_px2=np.eye(2),
        predicted_px=np.zeros(2),
        residuals=np.zeros(0),
        n_used=1,
        n_rejected=0,
        score=1.0,
        provenance={"image": "a.fits"},
        corrections=corrections,
        findings=findings,
    )


def test_the_provenance_of_a_fix_holds_the_texts_of_what_is_known_and_of_nothing_else() -> None:
    found = fix(Corrections(response=TABLE, limb_altitude_km=0.0), Findings(checks={"misfit": 0.123456, "step": 1.0}))
    assert found.provenance == {
        "image": "a.fits",
        "response": "bend=0.7123 dark_dn=20.1235 bright_dn=220",
        "limb_altitude_km": "0",
        "checks": "misfit=0.123 step=1",
    }
    checked = replace(found, findings=replace(found.findings, checked_by="moment", weight=0.55))
    assert checked.provenance == {**found.provenance, "checked_by": "moment", "weight": "0.55"}


def test_corrections_are_those_that_their_texts_state() -> None:
    stated = Corrections(response=TABLE, smear=Smear(straight_px2=1.23456), altitude_sigma_km=1.0 / 3.0)
    assert stated.response == Response(bend=0.7123, dark_dn=20.1235, bright_dn=220.0)
    assert stated.smear == Smear(straight_px2=1.235)
    assert stated.altitude_sigma_km == 0.333333
    assert replace(stated) == stated


def test_of_two_corrections_of_one_kind_the_second_counts() -> None:
    first, second = Corrections(seen_size=1.1, limb_altitude_km=2.0), Corrections(limb_altitude_km=0.0)
    assert first | second == Corrections(seen_size=1.1, limb_altitude_km=0.0)
    assert first | Corrections() == first
