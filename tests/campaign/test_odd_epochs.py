"""A clock that was never set is told: epochs far from those of the other images of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from giantlike.campaign.store.odd_epochs import odd_epochs
from giantlike.campaign.store.records import ObservationRecord
from giantlike.campaign.store.results import load_result
from giantlike.campaign.store.run_folder import RunFolder
from tests.campaign.test_export import TIMES, _record, _run

YEAR_S = 365.25 * 86400.0


@pytest.mark.parametrize("years", [-34.0, 126.0])
def test_images_of_a_run_with_a_wrong_clock_are_suspect_and_say_so(years: float, tmp_path: Path) -> None:
    wrong = float(TIMES[0]) + years * YEAR_S
    folder = _run(
        tmp_path / "run",
        [_record(0), _record(1), _record(2, et=wrong), _record(3, status="failed", et=wrong), _record(4)],
    )
    for index in (1, 2):
        seen = ObservationRecord(
            index=index, file=f"image_{index}.fits", target="ROCK", estimator="moment", status="ok",
            predicted_px=[10.0, 20.0], predicted_camera_km=[1.0, 2.0, 300.0], center_px=[10.5, 20.5],
            covariance_px2=[[0.1, 0.0], [0.0, 0.1]],
        )  # fmt: skip
        RunFolder(folder).save(seen, "key")
    result = load_result(folder)
    assert [record.status for record in result.attitudes] == ["ok", "ok", "suspect", "failed", "ok"]
    assert [("odd_epoch" in record.flags) for record in result.attitudes] == [False, False, True, False, False]
    assert {record.file: record.status for record in result.observations} == {
        "image_1.fits": "ok", "image_2.fits": "suspect",
    }  # fmt: skip


def test_a_mission_of_decades_has_no_odd_epoch() -> None:
    rng = np.random.default_rng(2)
    for spread_s in (60.0, YEAR_S, 30.0 * YEAR_S):
        for count in (1, 2, 3, 10, 100):
            epochs = 7.6e8 + spread_s * rng.random(count)
            assert odd_epochs({str(k): float(et) for k, et in enumerate(epochs)}) == {}


def test_two_images_or_none_with_an_epoch_tell_nothing() -> None:
    assert odd_epochs({"a": 0.0, "b": 7.6e8}) == {}
    assert odd_epochs({"a": None, "b": None, "c": 0.0, "d": float("nan")}) == {}
    assert odd_epochs({"a": None, "b": 1.0, "c": 0.0, "d": 50.0 * YEAR_S}) == {"d": 50.0}
