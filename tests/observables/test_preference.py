"""The fix that a filter should take, also of a run that is read back."""

from __future__ import annotations

from dataclasses import replace

from giantlike.campaign.run.observables import with_fix
from giantlike.campaign.store.observables import _fix
from giantlike.campaign.store.records import ObservationRecord
from giantlike.core.findings import Findings
from giantlike.core.outcomes import CenterFix, Failure
from giantlike.observables import preferred
from giantlike.relative import Moment
from giantlike.shapes import sphere
from tests.limb_images import CAMERA, body_image


def read_back(fix: CenterFix) -> CenterFix:
    """The fix as it is read from the record of a run."""
    case = body_image(sphere(0.5), 3, phase_deg=40.0)
    geometry = case.scene.geometry(case.image)
    assert not isinstance(geometry, Failure)
    empty = ObservationRecord(index=0, file="a.fits", target="BODY", estimator=fix.estimator, status="ok")
    record = with_fix(empty, CAMERA, geometry, fix)
    return _fix(ObservationRecord.model_validate_json(record.model_dump_json()))


def test_what_checked_a_fix_of_auto_is_known_of_a_run_that_is_read_back() -> None:
    case = body_image(sphere(0.5), 3, phase_deg=40.0)
    alone = replace(Moment().estimate(case.image, case.camera, case.scene).unwrap(), estimator="auto")
    checked = replace(alone, findings=Findings(checked_by="limb_matching"))
    for fix, reason in ((alone, "auto, which nothing else confirms"), (checked, "auto, checked by limb_matching")):
        assert not fix.flags.suspect
        again = read_back(fix)
        assert preferred([fix]).reason == preferred([again]).reason == reason
        assert again.provenance == fix.provenance
