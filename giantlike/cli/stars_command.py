"""``giantlike stars``: attitudes of single images, without a campaign."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import typer

from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog, load_catalog
from giantlike.cli.arguments import Hdu, Images, Json, Sequence
from giantlike.cli.outcome import ExitCode, print_json
from giantlike.cli.progress import progress_bar
from giantlike.cli.sequence_input import sequence_pattern, without_pattern
from giantlike.cli.star_review import write_review
from giantlike.core.arrays import require
from giantlike.core.atomic import make_folder
from giantlike.core.detector import Detector
from giantlike.core.errors import OpNavError
from giantlike.core.frames import pointing_deg, quaternion_xyzw
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.image import Image
from giantlike.processing import Detections
from giantlike.processing.detection.sequence import FixedPattern
from giantlike.stars import StarNavigation, StarOptions

_NUMBERS = MappingProxyType(
    {
        "ra_deg": (11, ".5f"),
        "dec_deg": (11, ".5f"),
        "roll_deg": (10, ".4f"),
        "fov_deg": (10, ".4f"),
        "n_matched": (11, "d"),
        "rms_px": (8, ".3f"),
    }
)
"""Numbers of a solution, and how a table shows them: width and format."""
_SIGMAS = ("sigma_x_arcsec", "sigma_y_arcsec", "sigma_z_arcsec")
_MORE = ("n_detected", "n_rejected", "false_match_probability", "identification", *_SIGMAS, "quaternion_xyzw")
"""What JSON tells besides; the quaternion is camera_from_inertial, the sigmas are about the camera axes."""
_DEFAULT_FOV_ERROR = 0.2
"""What the command line hands over when --fov-error is not given."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StarsRequest:
    """How images are to be read and solved: a camera, or a rough field of view along x and how wrong it may be.

    ``review`` is a folder for pictures of what was found.
    """

    camera: Camera | None
    fov_deg: float | None
    fov_error: float
    lost_in_space: bool
    max_magnitude: float | None
    hdu: int | str | None
    sequence: bool = False
    bottom_up: bool = False
    review: Path | None = None

    def __post_init__(self) -> None:
        require((self.camera is None) != (self.fov_deg is None), "give either --camera CAMERA.toml or --fov DEG")
        percent = 100 * self.fov_error
        if self.fov_deg is None:
            alone = self.fov_error == _DEFAULT_FOV_ERROR
            require(alone, f"--fov-error {percent:g} goes with --fov; a camera file says its field of view itself")
        else:
            require(0 < self.fov_deg < 170, f"--fov must be between 0 and 170 degrees, got {self.fov_deg:g}")
            require(0 < self.fov_error <= 0.2, f"--fov-error must be in (0, 20] percent, got {percent:g}")

    def options(self) -> StarOptions:
        """Options of the solution; raises InputError where a value is out of range."""
        return StarOptions(
            max_magnitude=self.max_magnitude,
            lost_in_space=self.lost_in_space,
            estimate_scale=self.camera is None,
            scale_error=self.fov_error,
        )


def stars(
    images: Images,
    camera: Annotated[Path | None, typer.Option(help="Camera file.", metavar="CAMERA.toml")] = None,
    fov: Annotated[
        float | None, typer.Option(help="Rough field of view along x, instead of a camera file.", metavar="DEG")
    ] = None,
    fov_error: Annotated[
        float, typer.Option(help="Error that --fov may have, percent (at most 20).", metavar="PERCENT")
    ] = 100 * _DEFAULT_FOV_ERROR,
    lost_in_space: Annotated[
        bool, typer.Option("--lost-in-space", help="Search the whole sky if the a priori attitude does not help.")
    ] = False,
    max_magnitude: Annotated[float | None, typer.Option(help="Faintest catalog star.")] = None,
    catalog: Annotated[str, typer.Option(help="default, a built catalog, or one in CSV.")] = "default",
    sequence: Sequence = False,
    bottom_up: Annotated[
        bool, typer.Option("--bottom-up", help="The first stored row is the bottom of the picture: turn the rows.")
    ] = False,
    review: Annotated[
        Path | None, typer.Option(help="Folder for pictures of detections, matches and residuals.", metavar="DIR")
    ] = None,
    hdu: Hdu = None,
    json: Json = False,
) -> ExitCode:
    """Solve the attitude of star images, without a campaign file.

    An image whose header has no a priori attitude is always solved lost-in-space.
    """
    wanted = StarsRequest(
        camera=None if camera is None else Camera.load(camera),
        fov_deg=fov,
        fov_error=fov_error / 100,
        lost_in_space=lost_in_space,
        max_magnitude=max_magnitude,
        hdu=hdu,
        sequence=sequence,
        bottom_up=bottom_up,
        review=review,
    )
    options = wanted.options()
    loaded = load_catalog(catalog)
    if wanted.review is not None:
        make_folder(wanted.review)
    detector = Detector() if wanted.camera is None else wanted.camera.detector
    pattern = None
    if wanted.sequence:
        pattern = sequence_pattern(images, hdu=wanted.hdu, detector=detector, bottom_up=wanted.bottom_up)
    results = []
    with progress_bar() as progress:
        for number, path in enumerate(images):
            progress("solving stars", number, len(images))
            results.append(_solve(path, loaded, wanted, options, pattern))
        progress("solving stars", len(images), len(images))
    if json:
        print_json(results)
    else:
        _print_table(results)
    failed = any(result["status"] == "failed" for result in results)
    return ExitCode.SOME_IMAGES_FAILED if failed else ExitCode.DONE


def _solve(
    path: Path,
    catalog: StarCatalog,
    wanted: StarsRequest,
    options: StarOptions,
    pattern: FixedPattern | Failure | None,
) -> dict[str, Any]:
    """One object of the JSON list; what is not known is None."""
    values: dict[str, Any] = {"file": str(path), "status": "failed", "reason": None} | dict.fromkeys(_NUMBERS)
    values |= {"detail": "", "flags": []} | dict.fromkeys(_MORE)
    try:
        image = Image.open(path, hdu=wanted.hdu, bottom_up=wanted.bottom_up)
        camera = wanted.camera
        if camera is None:
            assert wanted.fov_deg is not None
            camera = Camera.from_fov(wanted.fov_deg, image.columns, image.rows)
        image, detector = without_pattern(image, camera.detector, pattern)
        camera = replace(camera, detector=detector)
        if image.camera_from_inertial is None:
            options = replace(options, lost_in_space=True)
        navigation = StarNavigation(camera, catalog, options)
        detections = navigation.detect(image)
        outcome = navigation.solve_detections(image, detections) if isinstance(detections, Detections) else detections
        if wanted.review is not None and isinstance(detections, Detections):
            write_review(wanted.review, path, image, detections, outcome)
    except OpNavError as error:
        return values | {"reason": str(Reason.UNREADABLE_IMAGE), "detail": str(error)}
    if isinstance(outcome, Failure):
        return values | {"reason": str(outcome.reason), "detail": outcome.detail}
    ra, dec, roll = pointing_deg(outcome.camera_from_inertial, camera.model.unproject(camera.center_px))
    return values | {
        "status": "suspect" if outcome.flags.suspect else "ok",
        "ra_deg": ra,
        "dec_deg": dec,
        "roll_deg": roll,
        "fov_deg": outcome.fov_deg,
        "n_matched": outcome.n_used,
        "rms_px": outcome.rms_px,
        "flags": list(outcome.flags.names()),
        "n_detected": outcome.n_detected,
        "n_rejected": outcome.n_rejected,
        "false_match_probability": outcome.false_match_probability,
        "identification": outcome.provenance.get("identification"),
        **dict(zip(_SIGMAS, (np.sqrt(np.diag(outcome.covariance_rad2)) * ARCSEC_PER_RAD).tolist(), strict=True)),
        "quaternion_xyzw": quaternion_xyzw(outcome.camera_from_inertial).tolist(),
    }


def _print_table(results: list[dict[str, Any]]) -> None:
    """One line per image, and under a failed one the reason."""
    width = max(len(result["file"]) for result in results)
    heads = "".join(f"{name.removesuffix('_deg'):>{size}}" for name, (size, _) in _NUMBERS.items())
    typer.echo(f"{'file':<{width}}  status {heads}")
    for result in results:
        numbers = "".join(
            f"{'' if result[name] is None else format(result[name], style):>{size}}"
            for name, (size, style) in _NUMBERS.items()
        )
        typer.echo(f"{result['file']:<{width}}  {result['status']:<7}{numbers}".rstrip())
        if result["status"] != "ok":
            typer.echo(f"  {result['reason'] or ', '.join(result['flags'])}: {result['detail']}".rstrip(" :"))
