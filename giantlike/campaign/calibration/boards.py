"""Calibration of a camera from images of a checkerboard; writes the same files as one from stars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from giantlike._system.atomic import make_folder
from giantlike.calibration import calibrate
from giantlike.calibration.boards import CORNER_SIGMA_PX, board_observations
from giantlike.calibration.star_images import StarCalibration
from giantlike.camera import Camera
from giantlike.campaign.calibration.page import write_calibration_page
from giantlike.campaign.calibration.solve import CampaignCalibration, write_calibration
from giantlike.campaign.store.run_folder import CALIBRATION_FILE
from giantlike.core.arrays import require
from giantlike.core.errors import DataError
from giantlike.core.outcomes import Failure, Reason
from giantlike.image import Image

_USUAL = frozenset(
    {"fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "e2", "e4", "e5", "e6", "b2", "b3", "b4"}
)
"""Parameters, of any model, that an ordinary series of boards supports; higher terms are left at zero."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardSetup:
    """Board, camera model and parameters of a calibration from images of a checkerboard."""

    across: int  # across, down: inner corners of the board
    down: int
    fov_deg: float  # in degrees; rough field of view along x
    model_type: str  # a key of :data:`~giantlike.camera_models.MODELS`
    # parameters; None: focal lengths, principal point and the lens terms that an ordinary series of boards supports
    # (for a fisheye ``k1``, ``k2``)
    estimate: tuple[str, ...] | None = None
    sigma_px: float = CORNER_SIGMA_PX  # standard deviation of a corner per axis


def calibrate_boards(files: Sequence[Path], setup: BoardSetup, folder: Path) -> CampaignCalibration:
    """Calibrate a camera from images of a checkerboard; write camera, JSON, table of residuals and page."""
    require(not (folder / CALIBRATION_FILE).exists(), f"{folder}: there is a calibration already; give another folder")
    images, lost = _open(files)
    sizes = {(image.columns, image.rows) for image in images}
    require(len(sizes) == 1, f"images of one camera have one size, got {sorted(sizes)}")
    (columns, rows) = sizes.pop()
    camera = Camera.from_fov(setup.fov_deg, columns, rows, type_name=setup.model_type)
    names = camera.model.parameter_names
    estimate = setup.estimate or tuple(name for name in names if name in _USUAL)
    observations, failed = board_observations(
        images, camera.model, across=setup.across, down=setup.down, sigma_px=setup.sigma_px
    )
    lost += failed
    solution = (
        calibrate(observations, camera.model, estimate=estimate, columns=columns, rows=rows)
        if observations
        else Failure(Reason.NO_PATTERN_MATCH, f"none of {len(files)} images shows the board; {lost[0][1].detail}")
    )
    outcome = (
        solution
        if isinstance(solution, Failure)
        else StarCalibration(result=solution, rounds=1, settled=True, failed=())
    )
    result = CampaignCalibration.from_outcome(outcome, camera, lost, targets="corners")
    make_folder(folder)
    write_calibration(folder, result)
    write_calibration_page(folder, folder.name, camera, result)
    return result


def _open(files: Sequence[Path]) -> tuple[list[Image], list[tuple[str, Failure]]]:
    images, lost, first = [], [], None
    for file in files:
        try:
            images.append(Image.open(file))
        except DataError as error:
            first = first or error
            lost.append((file.name, Failure(Reason.UNREADABLE_IMAGE, str(error))))
    if not images and first is not None:
        raise first
    return images, lost
