"""ADES files pass the validator of the IAU, come back equal from its converters, and wrong input is refused."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from giantlike.core.errors import InputError
from giantlike.io.ades import AdesContext, AdesObservation, write_ades

valsubmit = pytest.importorskip("ades.valsubmit")
CONTEXT = AdesContext(
    station="C51",
    submitter="A. Analyst",
    measurers=("A. Analyst", "B. Navigator"),
    design="Refractor",
    aperture_m=0.19,
)
OBJECTS = (("permID", "Saturn 5"), ("permID", "101955"), ("provID", "2019 AB12"), ("trkSub", "P10u2_Ab"))
USUAL = AdesObservation(
    identification=OBJECTS[0],
    epoch_utc="2005-11-26T01:02:03.000004",
    ra_deg=12.5,
    dec_deg=-3.25,
    sigma_ra_arcsec=0.1,
    sigma_dec_arcsec=0.2,
    correlation=0.3,
    position_km=np.array([1e6, -2e6, 3e5]),
    velocity_km_s=np.array([1.0, 2.0, -3.0]),
    position_covariance_km2=np.diag([1.0, 2.0, 3.0]),
    sigma_time_s=0.01,
    exposure_s=1.5,
    n_stars=40,
)


def drawn(rng: np.random.Generator) -> AdesObservation:
    """An observation with numbers of any size, some of them missing."""
    root = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-3, 4)
    known = rng.random(4) < 0.7
    return replace(
        USUAL,
        identification=OBJECTS[rng.integers(len(OBJECTS))],
        epoch_utc=f"20{rng.integers(10, 60)}-03-{rng.integers(1, 31):02d}T10:20:{rng.uniform(0, 59.9):09.6f}",
        ra_deg=rng.choice([rng.uniform(0.0, 360.0), 0.0, 360.0 - 1e-11, 359.9999999996]),
        dec_deg=rng.choice([rng.uniform(-90.0, 90.0), -90.0, 90.0, -1e-12]),
        sigma_ra_arcsec=10.0 ** rng.uniform(-8, 4.9),
        sigma_dec_arcsec=10.0 ** rng.uniform(-8, 4.9),
        correlation=rng.choice([rng.uniform(-0.9999, 0.9999), -0.999999]),
        position_km=rng.normal(size=3) * 10.0 ** rng.uniform(0, 10),
        velocity_km_s=rng.normal(size=3) * 10.0 ** rng.uniform(-6, 2),
        position_covariance_km2=root @ root.T + 1e-3 * np.trace(root @ root.T) * np.eye(3) if known[0] else None,
        sigma_time_s=10.0 ** rng.uniform(-8, 4) if known[1] else None,
        exposure_s=10.0 ** rng.uniform(-4, 4.9) if known[2] else None,
        n_stars=int(rng.integers(1, 10**6)) if known[3] else None,
    )


def elements_of(path: Path) -> list[list[tuple[str, str | None]]]:
    """Elements of all observations of an XML file, in order."""
    from lxml import etree

    return [[(element.tag, element.text) for element in optical] for optical in etree.parse(path).iter("optical")]


def convert(module: str, source: str, target: str) -> None:
    """Run a converter anew: they keep their state in module variables."""
    name = f"ades.{module}"
    loaded = importlib.reload(importlib.import_module(name))
    getattr(loaded, module)(source, target)


@pytest.mark.monte_carlo(few=20, full=200)
def test_random_files_are_valid_and_come_back_equal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, draws: int
) -> None:
    monkeypatch.chdir(tmp_path)  # the validator writes its verdict there
    rng = np.random.default_rng(1)
    for _ in range(draws):
        observations = [drawn(rng) for _ in range(rng.integers(1, 6))]
        write_ades("a.xml", CONTEXT, observations)
        write_ades("a.psv", CONTEXT, observations)
        convert("psvtoxml", "a.psv", "b.xml")
        convert("xmltopsv", "b.xml", "c.psv")
        convert("psvtoxml", "c.psv", "d.xml")
        for name in ("a.xml", "b.xml"):
            valsubmit.valsubmit(name)
            verdict = Path("valsubmit.file").read_text()
            assert "submit is OK" in verdict
            assert "failed" not in verdict
        assert elements_of(Path("a.xml")) == elements_of(Path("b.xml")) == elements_of(Path("d.xml"))


def test_numbers_are_those_given(tmp_path: Path) -> None:
    write_ades(tmp_path / "a.xml", CONTEXT, [USUAL])
    cells = dict(elements_of(tmp_path / "a.xml")[0])
    assert cells["permID"] == "Saturn 5"
    assert cells["obsTime"] == "2005-11-26T01:02:03.000004Z"
    assert (cells["sys"], cells["ctr"]) == ("ICRF_KM", "399")
    assert [float(cells[f"pos{k}"] or 0) for k in (1, 2, 3)] == [1e6, -2e6, 3e5]
    assert (cells["ra"], cells["dec"]) == ("12.500000000", "-3.250000000")
    assert (cells["rmsRA"], cells["rmsDec"], cells["rmsCorr"]) == ("0.1", "0.2", "0.300000")
    assert float(cells["posCov22"] or 0) == 2.0


NAN = float("nan")


@pytest.mark.parametrize(
    "bad",
    [
        {"identification": ("permID", "Bennu")},
        {"identification": ("permID", "")},
        {"identification": ("provID", "99942")},
        {"identification": ("trkSub", "ninechars")},
        {"identification": ("trkSub", "a|b")},
        {"identification": ("artSat", "GIANT")},
        {"epoch_utc": "2005-11-26 01:02:03"},
        {"epoch_utc": "2005-11-26T01:02:03Z"},
        {"epoch_utc": "2005-11-26T01:02:03.1234567"},
        {"epoch_utc": "26 NOV 2005 01:02:03"},
        {"ra_deg": -0.1},
        {"ra_deg": 360.1},
        {"ra_deg": NAN},
        {"dec_deg": 90.1},
        {"dec_deg": -91.0},
        {"dec_deg": NAN},
        {"sigma_ra_arcsec": 0.0},
        {"sigma_ra_arcsec": -1.0},
        {"sigma_ra_arcsec": 1e6},
        {"sigma_dec_arcsec": NAN},
        {"sigma_dec_arcsec": float("inf")},
        {"correlation": 1.0},
        {"correlation": -1.0},
        {"correlation": NAN},
        {"position_km": np.array([1.0, 2.0])},
        {"position_km": np.array([1e12, 0.0, 0.0])},
        {"position_km": np.array([NAN, 0.0, 0.0])},
        {"velocity_km_s": np.array([NAN, 0.0, 0.0])},
        {"position_covariance_km2": np.diag([1.0, 1.0, -1.0])},
        {"position_covariance_km2": np.diag([1.0, 1.0, NAN])},
        {"position_covariance_km2": np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])},
        {"position_covariance_km2": np.eye(2)},
        {"sigma_time_s": 0.0},
        {"sigma_time_s": 1e6},
        {"exposure_s": -1.0},
        {"exposure_s": 1e6},
        {"n_stars": 0},
        {"n_stars": 1_000_000},
        {"remarks": "a|b"},
        {"remarks": "two\nlines"},
        {"remarks": "é"},
        {"remarks": "x" * 301},
    ],
)
def test_wrong_observations_are_refused_before_a_byte_is_written(bad: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        replace(USUAL, **bad)


@pytest.mark.parametrize(
    "bad",
    [
        {"station": "C5"},
        {"submitter": " A"},
        {"measurers": ()},
        {"measurers": ("a|b",)},
        {"design": "x" * 26},
        {"detector": ""},
        {"aperture_m": 0.0},
        {"aperture_m": NAN},
        {"star_catalog": "Gaia"},
    ],
)
def test_wrong_contexts_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        replace(CONTEXT, **bad)


def test_another_ending_and_no_observation_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.xml or \.psv"):
        write_ades(tmp_path / "a.txt", CONTEXT, [USUAL])
    with pytest.raises(InputError, match="needs an observation"):
        write_ades(tmp_path / "a.xml", CONTEXT, [])
    assert not list(tmp_path.iterdir())
