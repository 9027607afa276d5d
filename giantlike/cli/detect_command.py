"""``giantlike detect``: point sources of images, without identifying them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from giantlike.camera import Camera
from giantlike.cli.arguments import Frames, Hdu, Images, Json, Sequence
from giantlike.cli.frames_input import BOTH_PATTERNS, ImageReader, sequence_pattern, without_pattern
from giantlike.cli.outcome import ExitCode, Results, rows_of, show_results
from giantlike.cli.progress import with_progress
from giantlike.core.arrays import require
from giantlike.core.detector import Detector
from giantlike.core.errors import OpNavError
from giantlike.core.outcomes import Failure, Reason
from giantlike.image import Image
from giantlike.processing import DetectionFlag, DetectionOptions, Detections, detect_sources
from giantlike.processing.detection.noise import NoiseSource
from giantlike.processing.detection.sequence import FixedPattern, compare_sequence
from giantlike.processing.psf.estimate import PsfEstimate, estimate_psf, remeasure
from giantlike.processing.psf.profile import PsfKind

_SHOWN = 20  # maximum detections of an image in the text table


@dataclass(frozen=True, slots=True)
class DetectedImage:
    """Detections of one image, and its point spread function if requested."""

    detections: Detections
    psf: PsfEstimate | Failure | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectRequest:
    """Options of a search for sources, shared by all images."""

    camera: Camera | None = None  # its PSF and detector are used, and images of another size fail
    psf_sigma_px: float | None = None  # instead of the camera's; by default it is estimated from each image
    min_snr: float = 0.0  # detections of a lower signal-to-noise ratio are left out
    hdu: int | str | None = None  # of FITS files
    reader: ImageReader  # opens the images
    sequence: bool = False  # the images are of one camera: a fixed pattern is removed, and detections are compared
    psf: PsfKind | None = None  # kind of the PSF estimated from each image, for the positions of stars
    psf_degree: int = 0  # of the polynomials with which it varies over the field
    options: DetectionOptions = field(default_factory=DetectionOptions)

    def __post_init__(self) -> None:
        sigma = self.psf_sigma_px
        require(sigma is None or 0 <= sigma <= 20, f"--psf-sigma must be in [0, 20] px, got {sigma}")
        require(0 <= self.psf_degree <= 3, f"--psf-degree must be 0 to 3, got {self.psf_degree}")
        known = self.camera is not None or self.options.noise is not NoiseSource.DETECTOR
        require(known, "--noise detector needs --camera, whose file describes the detector")
        require(math.isfinite(self.min_snr) and self.min_snr >= 0, f"--min-snr must be >= 0, got {self.min_snr}")

    @property
    def detector(self) -> Detector:
        """Detector of the camera, or one with default properties."""
        return Detector() if self.camera is None else self.camera.detector

    def search(self, image: Image, pattern: FixedPattern | Failure | None = None) -> DetectedImage | Failure:
        """Sources of one image, after the pattern of its sequence is removed, and its point spread function."""
        camera = self.camera
        if camera is not None:
            camera.require_image(image)
        sigma = self.psf_sigma_px
        if sigma is None and camera is not None and camera.psf is not None:
            sigma = camera.psf.sigma_px
        image, detector = without_pattern(image, image.detector or self.detector, pattern)
        found = detect_sources(
            image.pixels, detector=detector, psf_sigma_px=sigma, mask=image.mask, options=self.options
        )
        if isinstance(found, Failure) or self.psf is None:
            return found if isinstance(found, Failure) else DetectedImage(found)
        psf = estimate_psf(
            image.pixels, found, detector=detector, kind=self.psf, degree=self.psf_degree, mask=image.mask
        )
        if isinstance(psf, PsfEstimate):
            found = remeasure(image.pixels, found, psf, detector=detector, mask=image.mask)
        return DetectedImage(found, psf)


def detect(
    images: Images,
    camera: Annotated[
        Path | None, typer.Option(help="Camera file: its PSF and detector are used.", metavar="CAMERA.toml")
    ] = None,
    psf_sigma: Annotated[
        float | None, typer.Option(help="Sigma of the PSF; default: the camera's, or as estimated.", metavar="PX")
    ] = None,
    min_snr: Annotated[float, typer.Option(help="Leave out sources of lower signal-to-noise ratio.")] = 0.0,
    threshold: Annotated[float, typer.Option(help="Detection limit in units of the noise.", metavar="SIGMA")] = 5.0,
    noise: Annotated[
        NoiseSource, typer.Option(help="Source of the noise of a pixel.", case_sensitive=False)
    ] = NoiseSource.LOCAL,
    covered: Annotated[
        tuple[int, int, int, int] | None,
        typer.Option(help="For --noise covered: pixels without light.", metavar="X Y COLUMNS ROWS"),
    ] = None,
    streak: Annotated[
        bool | None, typer.Option("--streak/--no-streak", help="Stars are streaks; by default this is detected.")
    ] = None,
    psf: Annotated[
        PsfKind | None, typer.Option(help="Estimate the PSF from each image, and fit sources with it.")
    ] = None,
    psf_degree: Annotated[int, typer.Option(help="Degree of the variation of that PSF over the field, 0 to 3.")] = 0,
    sequence: Sequence = False,
    frames: Frames = None,
    hdu: Hdu = None,
    json: Json = False,
) -> ExitCode:
    """Find stars and other point sources, with their positions and covariances.

    With --json all of them are listed, brightest first, with quality flags.
    """
    require(frames is None or not sequence, BOTH_PATTERNS)
    wanted = DetectRequest(
        camera=None if camera is None else Camera.load(camera),
        psf_sigma_px=psf_sigma,
        min_snr=min_snr,
        hdu=hdu,
        reader=ImageReader(frames, hdu=hdu),
        sequence=sequence,
        psf=psf,
        psf_degree=psf_degree,
        options=DetectionOptions(threshold_sigma=threshold, streak=streak, noise=noise, covered=covered),
    )
    return show_results(_all_searched(images, wanted), _lines, json=json)


def _all_searched(images: list[Path], wanted: DetectRequest) -> list[dict[str, Any]]:
    """The JSON list."""
    pattern = sequence_pattern(images, hdu=wanted.hdu, detector=wanted.detector) if wanted.sequence else None
    outcomes = [_search_file(path, wanted, pattern) for path in with_progress("detecting", images)]
    if wanted.sequence:
        compared = iter(compare_sequence([found.detections for found in outcomes if isinstance(found, DetectedImage)]))
        outcomes = [
            DetectedImage(next(compared), found.psf) if isinstance(found, DetectedImage) else found
            for found in outcomes
        ]
    return [_result(path, outcome, wanted) for path, outcome in zip(images, outcomes, strict=True)]


def _search_file(path: Path, wanted: DetectRequest, pattern: FixedPattern | Failure | None) -> DetectedImage | Failure:
    try:
        return wanted.search(wanted.reader.open(path, wanted.detector), pattern)
    except OpNavError as error:
        return Failure(Reason.UNREADABLE_IMAGE, str(error))


def _result(path: Path, outcome: DetectedImage | Failure, wanted: DetectRequest) -> dict[str, Any]:
    """One object of the JSON list; unknown values are None."""
    values: dict[str, Any] = {"file": str(path), "status": "failed", "reason": None, "detail": ""}
    values |= {"psf_sigma_px": None, "noise_dn": None, "detections": []}
    if isinstance(outcome, Failure):
        return values | {"reason": str(outcome.reason), "detail": outcome.detail}
    found, psf = outcome.detections, outcome.psf
    values |= {
        "status": "ok",
        "psf_sigma_px": found.psf_sigma_px,
        "noise_dn": found.noise_dn,
        "detections": _rows(found.select(found.snr >= wanted.min_snr)),
    }
    if psf is None:
        return values
    if isinstance(psf, Failure):
        return values | {"psf": {"reason": str(psf.reason), "detail": psf.detail}}
    return values | {"psf": psf.to_mapping()}


def _rows(found: Detections) -> list[dict[str, Any]]:
    """One object per detection, brightest first; where the stars are streaks also their ends."""
    sigma = np.sqrt(np.diagonal(found.covariance_px2, axis1=1, axis2=2))
    columns: dict[str, list[Any]] = {
        "x_px": found.points_px[:, 0].tolist(),
        "y_px": found.points_px[:, 1].tolist(),
        "sigma_x_px": sigma[:, 0].tolist(),
        "sigma_y_px": sigma[:, 1].tolist(),
        "flux_dn": found.flux_dn.tolist(),
        "snr": found.snr.tolist(),
        "flags": [DetectionFlag(flags).names() for flags in found.flags.tolist()],
        "is_star": found.clean.tolist(),
    }
    if found.halves_px is not None and found.half_sigma_px is not None:
        ends = np.stack([found.points_px - found.halves_px, found.points_px + found.halves_px], axis=1)
        columns |= {
            "ends_px": ends.tolist(),
            "length_px": (2.0 * np.hypot(*found.halves_px.T)).tolist(),
            "sigma_length_px": (2.0 * found.half_sigma_px).tolist(),
        }
    return rows_of(columns)


def _lines(results: Results) -> Iterator[str]:
    """A line per image, and under it the brightest detections or the reason of the failure."""
    for result in results:
        rows = result["detections"]
        if result["status"] == "failed":
            yield f"{result['file']}: failed\n  {result['reason']}: {result['detail']}"
            continue
        stars = sum(row["is_star"] for row in rows)
        yield (
            f"{result['file']}: {len(rows)} detections, {stars} look like stars; "
            f"PSF sigma {result['psf_sigma_px']:.3f} px, noise {result['noise_dn']:.4g} DN"
        )
        if "psf" in result:
            yield f"  {_psf_line(result['psf'])}"
        if rows:
            yield f"  {'x_px':>10}{'y_px':>10}{'sigma_x':>9}{'sigma_y':>9}{'flux_dn':>12}{'snr':>9}  flags"
        for row in rows[:_SHOWN]:
            yield (
                f"  {row['x_px']:>10.3f}{row['y_px']:>10.3f}{row['sigma_x_px']:>9.4f}{row['sigma_y_px']:>9.4f}"
                f"{row['flux_dn']:>12.1f}{row['snr']:>9.1f}  {', '.join(row['flags'])}".rstrip()
            )
        if len(rows) > _SHOWN:
            yield f"  ... and {len(rows) - _SHOWN} fainter ones: --json lists all"


def _psf_line(psf: Mapping[str, Any]) -> str:
    """The point spread function in one line, as a camera file would hold its width."""
    if "reason" in psf:
        return f"point spread function: {psf['reason']}: {psf['detail']}"
    middle = ", ".join(f"{name} {values[0]:.4g}" for name, values in psf["coefficients"].items())
    return (
        f"[psf] sigma_px = {psf['sigma_px']:.4f}  # +- {psf['sigma_error_px']:.4f}, {psf['kind']} in the middle: "
        f"{middle}; {psf['n_used']} stars, reduced chi-square {psf['reduced_chi2']:.3g}"
    )
