"""``giantlike stars``: attitudes of single images, without a campaign."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import typer

from giantlike._system.atomic import make_folder
from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog, load_catalog
from giantlike.cli.arguments import Frames, Hdu, Images, Json, Sequence
from giantlike.cli.frames_input import BOTH_PATTERNS, ImageReader, sequence_pattern, without_pattern
from giantlike.cli.outcome import ExitCode, Results, show_results
from giantlike.cli.progress import with_progress
from giantlike.core.arrays import require
from giantlike.core.detector import Detector
from giantlike.core.errors import DataError, OpNavError
from giantlike.core.frames import pointing_deg, quaternion_xyzw
from giantlike.core.outcomes import AttitudeFix, Failure, Reason
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
"""Additional keys in JSON; the quaternion is camera_from_inertial, the sigmas are about the camera axes."""
_DEFAULT_FOV_ERROR = 0.2  # value of the command line when --fov-error is not given


@dataclass(frozen=True, slots=True, kw_only=True)
class StarsRequest:
    """Options of a solution, common to all images: a camera, or a rough field of view along x and its error.

    ``review`` is a folder for pictures of the detections.
    """

    catalog: StarCatalog
    camera: Camera | None
    fov_deg: float | None
    options: StarOptions
    pattern: FixedPattern | Failure | None
    reader: ImageReader
    review: Path | None


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
    frames: Frames = None,
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
    known = None if camera is None else Camera.load(camera)
    _check_fov(known, fov, fov_error / 100)
    require(frames is None or not sequence, BOTH_PATTERNS)
    options = StarOptions(
        max_magnitude=max_magnitude,
        lost_in_space=lost_in_space,
        estimate_scale=known is None,
        scale_error=fov_error / 100,
    )
    loaded = load_catalog(catalog)
    if review is not None:
        make_folder(review)
    detector = Detector() if known is None else known.detector
    wanted = StarsRequest(
        catalog=loaded,
        camera=known,
        fov_deg=fov,
        options=options,
        pattern=sequence_pattern(images, hdu=hdu, detector=detector, bottom_up=bottom_up) if sequence else None,
        reader=ImageReader(frames, hdu=hdu, bottom_up=bottom_up),
        review=review,
    )
    results = [_solve(path, wanted) for path in with_progress("solving stars", images)]
    return show_results(results, _lines, json=json)


def _check_fov(camera: Camera | None, fov_deg: float | None, fov_error: float) -> None:
    require((camera is None) != (fov_deg is None), "give either --camera CAMERA.toml or --fov DEG")
    percent = 100 * fov_error
    if fov_deg is None:
        alone = fov_error == _DEFAULT_FOV_ERROR
        require(alone, f"--fov-error {percent:g} goes with --fov; a camera file says its field of view itself")
    else:
        require(0 < fov_deg < 170, f"--fov must be between 0 and 170 degrees, got {fov_deg:g}")
        require(0 < fov_error <= 0.2, f"--fov-error must be in (0, 20] percent, got {percent:g}")


def _solve(path: Path, wanted: StarsRequest) -> dict[str, Any]:
    """One object of the JSON list; unknown values are None."""
    values: dict[str, Any] = {"file": str(path), "status": "failed", "reason": None} | dict.fromkeys(_NUMBERS)
    values |= {"detail": "", "flags": []} | dict.fromkeys(_MORE)
    try:
        camera, options = wanted.camera, wanted.options
        image = wanted.reader.open(path, Detector() if camera is None else camera.detector)
        if camera is None:
            assert wanted.fov_deg is not None
            counts = Detector()  # 1 electron per number; values that cannot be counts are detected (Detector.of_image)
            camera = replace(Camera.from_fov(wanted.fov_deg, image.columns, image.rows), detector=counts)
        image, detector = without_pattern(image, camera.detector, wanted.pattern)
        camera = replace(camera, detector=detector)
        if image.camera_from_inertial is None:
            options = replace(options, lost_in_space=True)
        navigation = StarNavigation(camera, wanted.catalog, options)
        detections, outcome = navigation.detect_and_solve(image)
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


def _lines(results: Results) -> Iterator[str]:
    """One line per image, and under a failed one the reason."""
    width = max(len(result["file"]) for result in results)
    heads = "".join(f"{name.removesuffix('_deg'):>{size}}" for name, (size, _) in _NUMBERS.items())
    yield f"{'file':<{width}}  status {heads}"
    for result in results:
        numbers = "".join(
            f"{'' if result[name] is None else format(result[name], style):>{size}}"
            for name, (size, style) in _NUMBERS.items()
        )
        yield f"{result['file']:<{width}}  {result['status']:<7}{numbers}".rstrip()
        if result["status"] != "ok":
            yield f"  {result['reason'] or ', '.join(result['flags'])}: {result['detail']}".rstrip(" :")


def write_review(
    folder: Path, path: Path, image: Image, detections: Detections, outcome: AttitudeFix | Failure
) -> tuple[Path, ...]:
    """Write ``NAME.stars.png`` (detections, matches, rejects on the image), ``NAME.residuals.png`` where solved."""
    from giantlike.plotting import StarMarks, charts_figure, overlay_figure, overlay_panels, star_residual_charts

    solved = outcome if isinstance(outcome, AttitudeFix) else None
    marks, said = StarMarks.of_detections(detections.points_px), "not solved"
    if solved is not None:
        said = f"{solved.n_used} matched, {solved.n_rejected} thrown out"
        marks = replace(
            marks, matched_px=solved.observed_px, predicted_px=solved.predicted_px, rejected_px=solved.rejected_px
        )
    panels = overlay_panels(image.pixels, f"{len(detections)} detected, {said}", stars=marks)
    figures = {"stars": overlay_figure(panels)}
    if solved is not None:
        charts = star_residual_charts(
            solved.observed_px, solved.residuals_px, solved.magnitudes, solved.sigma_px, image.columns, image.rows
        )
        figures["residuals"] = charts_figure(charts)
    files = tuple(folder / f"{path.name}.{name}.png" for name in figures)
    try:
        for file, figure in zip(files, figures.values(), strict=True):
            figure.savefig(file, dpi=130)
    except OSError as error:
        raise DataError(folder, f"cannot write the pictures: {error.strerror or error}") from error
    return files
