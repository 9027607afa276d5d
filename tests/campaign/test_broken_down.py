"""A computation that broke down is counted: its image is among the failed ones, whatever other estimators found."""

from __future__ import annotations

from pathlib import Path

from giantlike.campaign.store.records import ObservationRecord, Problem
from giantlike.campaign.store.results import StatusCounts, load_result
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.outcomes import Reason
from tests.campaign.test_export import _record, _run


def test_an_internal_error_of_one_estimator_makes_its_image_a_failed_one(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run", [_record(0), _record(1)])
    for index, reason in ((0, Reason.INTERNAL_ERROR), (1, Reason.NO_LIMB)):
        fixed = ObservationRecord(
            index=index, file=f"image_{index}.fits", target="ROCK", estimator="moment", status="ok",
            predicted_px=[10.0, 20.0], predicted_camera_km=[1.0, 2.0, 300.0], center_px=[10.5, 20.5],
            covariance_px2=[[0.1, 0.0], [0.0, 0.1]],
        )  # fmt: skip
        failed = ObservationRecord(
            index=index, file=f"image_{index}.fits", target="ROCK", estimator="auto", status="failed",
            problem=Problem(reason=reason, detail="the computation broke down: LinAlgError: Singular matrix"),
        )  # fmt: skip
        RunFolder(folder).save(fixed, "key")
        RunFolder(folder).save(failed, "key")
    result = load_result(folder)
    assert result.failed_images == ("image_0.fits",)  # exit code 1; a failed fix beside a good one is none
    assert StatusCounts.from_records(result.by_estimator["ROCK", "auto"]).reasons == {"internal_error": 1, "no_limb": 1}
