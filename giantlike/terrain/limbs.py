"""The limb of a body with relief: how high above its smooth limb the outline is seen, all around.

Seen along the line of sight, the outline at a position angle is the highest of all ground in the half-plane that
the angle and the line of sight span: hills before and behind the limb of the ellipsoid stand above the valleys on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, as_finite, require
from giantlike.core.frames import rotate
from giantlike.core.values import Value
from giantlike.terrain.height_map import HeightMap

_LEAST_ANGLES, _MOST_ANGLES = 360, 7200
"""Position angles of a profile: every degree, and every 0.05 deg, a pixel on a limb of 1100 px."""
_MOST_ALONG = 640  # places along a line of sight; with more, neighbors are farther apart than this
_ALONG_AT_ONCE = 400_000  # places that are looked up at once: some 50 MB of working memory
_CANDIDATES, _LEVELS, _REACH_SIGMAS = 24, 25, 4.0
"""Places along a line of sight that may be its highest, and heights at which the chance of each is summed."""
_PARTS = 3
"""Independent heights in a step of a map: what it does not resolve is as rough as the rest.

Of a made-up Moon by Kaula's rule, the mean limb of maps with 2, 1, 0.5 and 0.2 samples to the degree is 0.06, 0.14,
0.25 and 0.31 km lower than with 8; with 3 it is predicted to 0.01, 0.05, 0.02 and -0.14 km, with 2 to 0.0, 0.0, -0.06
and -0.28 km, with 4 to 0.03, 0.08, 0.08 and -0.03 km.
"""
_BIAS_ERROR = 0.25
"""Error of that prediction over the root mean square of what is not resolved: 0.07, 0.18, 0.31 and 0.55 km there."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbProfile(Value):
    """Predicted altitude of a limb above that of the smooth body, by position angle.

    Parameters
    ----------
    angles_rad : (k,) float64, rad
        In even steps from 0, about the direction from the camera to the center of the body: from ``first_body``
        towards ``second_body``.
    altitude_km : (k,) float64, km; across the outline, the mean of relief that the map does not resolve included
    unresolved_km : (k,) float64, km; the part for relief that the map does not resolve; never negative
    known : (k,) bool; where the map holds the ground of the limb; elsewhere the altitude is a mean
    points_body_km, normals_body : (k, 3) float64, km and unitless, body axes; of the smooth body's limb
    first_body, second_body : (3,) float64, unitless, body axes; unit vectors across the line of sight
    sigma_km : float, km; of the altitude, by heights of the map and gaps in it, shared by wide parts
    common_sigma_km : float, km; of what the map does not resolve, common to the whole limb
    scatter_km : float, km; RMS of relief that the map does not resolve, new in each step along the limb
    """

    angles_rad: Float
    altitude_km: Float
    unresolved_km: Float
    known: Mask
    points_body_km: Float
    normals_body: Float
    first_body: Float
    second_body: Float
    sigma_km: float
    common_sigma_km: float
    scatter_km: float

    def at(self, directions_body: Float, *, width_rad: float = 0.0) -> Float:
        """Altitude (n,), km, of the limb where lines of sight (n, 3), body axes, touch it.

        ``width_rad``, rad: position angle over which the altitude is averaged, the width that one measurement of the
        limb sees.
        """
        step = 2.0 * math.pi / self.angles_rad.size
        count = max(round(width_rad / step), 1)
        sums = np.cumsum(np.concatenate([[0.0], np.tile(self.altitude_km, 3)]))
        start = self.angles_rad.size - count // 2 + np.arange(self.angles_rad.size)
        mean = (sums[start + count] - sums[start]) / count
        place = np.arctan2(directions_body @ self.second_body, directions_body @ self.first_body)
        # The middle of an even number of samples lies half a step before its nearest one.
        angles = self.angles_rad - (0.5 * step if count % 2 == 0 else 0.0)
        result: Float = np.interp(place, angles, mean, period=2.0 * math.pi)
        return result

    def in_image(
        self, model: CameraModel, camera_from_body: Rotation, position_camera_km: ArrayLike
    ) -> tuple[Float, Float]:
        """Outline with its relief (k, 2), px, and how far it lies outside that of the smooth body (k,), px.

        ``position_camera_km`` (3,), km, camera axes: center of the body, as in the geometry of the profile. NaN where
        the camera does not image it.
        """
        place = as_finite(position_camera_km, (3,), "position_camera_km")
        raised_km = self.points_body_km + self.altitude_km[:, None] * self.normals_body
        smooth, raised = (
            model.project(place + rotate(camera_from_body, points)) for points in (self.points_body_km, raised_km)
        )
        altitude_px: Float = np.copysign(np.linalg.norm(raised - smooth, axis=1), self.altitude_km)
        return raised, altitude_px

    def bias(self, sun_direction_body: ArrayLike | None = None) -> tuple[float, Float]:
        """Bias that the relief gives a fit of the smooth body, before there is an image.

        ``sun_direction_body`` (3,), unit vector to the Sun, body axes: the limb that it lights counts; all of it by
        default. Returns the growth of the radius, km (the range comes out shorter by as much, times range over radius),
        and the shift of the center (2,), km, along ``first_body`` and ``second_body``. Raises InputError where the Sun
        lights too little of the limb.
        """
        lit = np.ones(self.angles_rad.size, dtype=np.bool_)
        if sun_direction_body is not None:
            lit = self.normals_body @ as_finite(sun_direction_body, (3,), "sun_direction_body") > 0.0
        require(int(lit.sum()) > 3, "the Sun lights none of the limb")
        angles = self.angles_rad[lit]
        design = np.stack([np.ones(angles.size), np.cos(angles), np.sin(angles)], axis=1)
        radius, first, second = np.linalg.lstsq(design, self.altitude_km[lit], rcond=None)[0]
        return float(radius), np.array([first, second])

    @property
    def mean_km(self) -> float:
        """Mean altitude, km: above zero, because only what is high is seen."""
        return float(self.altitude_km.mean())


def limb_profile(
    heights: HeightMap, radii_km: Float, camera_body_km: Float, *, angles: int = 720, up_body: Float | None = None
) -> LimbProfile:
    """Predict the altitude of the limb of a body with relief.

    Parameters
    ----------
    heights : HeightMap
    radii_km : (3,), km; semi-axes of the ellipsoid above whose limb the altitude is
    camera_body_km : (3,), km, body axes; the camera, from the center of the body
    angles : int; position angles
    up_body : (3,), body axes, optional; direction of the position angle 0; any by default

    Raises
    ------
    InputError
        The camera is inside the ellipsoid or its relief, or an argument makes no sense.

    Notes
    -----
    A half-plane through the line of sight to the center cuts the surface in a curve, whose every point lies at one
    position angle; so the outline there is the largest angle from the center along it, without rays. Relief that the
    map does not resolve is taken as independent in each third of a step; the expected largest follows from the product
    of the distributions, and is above the largest that the map has.
    """
    radii = as_finite(radii_km, (3,), "radii_km")
    camera = as_finite(camera_body_km, (3,), "camera_body_km")
    count = int(min(max(angles, _LEAST_ANGLES), _MOST_ANGLES))
    inside = float(np.linalg.norm(camera / (radii + heights.span_km)))
    require(inside > 1.0, "the camera must be outside the body and its relief")
    up = None if up_body is None else tuple(as_finite(up_body, (3,), "up_body").tolist())
    return _profile(heights, tuple(radii.tolist()), tuple(camera.tolist()), count, up)


@lru_cache(maxsize=8)
def _profile(
    heights: HeightMap, radii: tuple[float, ...], camera: tuple[float, ...], count: int, up: tuple[float, ...] | None
) -> LimbProfile:
    """The same with arguments by which it is kept: estimators of one image ask for one profile."""
    distance = float(np.linalg.norm(camera))
    toward = np.asarray(camera) / distance
    first = np.asarray(up if up is not None else np.eye(3)[int(np.argmin(np.abs(toward)))], dtype=np.float64)
    first = first - (first @ toward) * toward
    require(float(np.linalg.norm(first)) > 1e-6, "up_body must not be along the line of sight")
    first /= np.linalg.norm(first)
    second = np.cross(first, toward)
    angles: Float = np.arange(count, dtype=np.float64) * (2.0 * math.pi / count)
    across = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    limb = _SmoothLimb.from_ellipsoid(np.asarray(radii), toward, across, distance)
    reach = math.sqrt(2.0 * heights.span_km / float(np.mean(radii))) + 2.0 * heights.step_rad
    step = max(heights.step_rad / _PARTS, 2.0 * reach / _MOST_ALONG)
    places: Float = np.arange(-math.ceil(reach / step), math.ceil(reach / step) + 1, dtype=np.float64) * step
    unresolved = heights.unresolved_km(_PARTS * step)
    tops, added, known = (np.empty(count) for _ in range(3))
    size = max(_ALONG_AT_ONCE // places.size, 1)
    for start in range(0, count, size):
        part = slice(start, min(start + size, count))
        seen = limb.altitudes(heights, part, places)
        known[part] = np.isfinite(seen).all(axis=1)
        tops[part], added[part] = _expected_top(seen, unresolved)
    good = known > 0.0
    altitude = tops + added
    if not good.any():
        altitude, added = np.zeros(count), np.zeros(count)
    else:
        altitude[~good], added[~good] = float(altitude[good].mean()), float(added[good].mean())
    gap = math.sqrt(1.0 - float(good.mean())) * heights.rms_km
    return LimbProfile(
        angles_rad=angles,
        altitude_km=altitude,
        unresolved_km=added,
        known=good,
        points_body_km=limb.points_km,
        normals_body=limb.normals,
        first_body=first,
        second_body=second,
        sigma_km=math.hypot(heights.sigma_km, gap),
        common_sigma_km=_BIAS_ERROR * unresolved,
        scatter_km=unresolved,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _SmoothLimb(Value):
    """Limb of the ellipsoid in k half-planes, whose axes are the way to the camera and one across it."""

    toward: Float
    across: Float
    distance_km: float
    polar_rad: Float  # angle (k,) at the center from the camera to the point of the limb
    half_angle_rad: Float  # angle (k,) at the camera from the center to the limb
    arm_km: Float  # length (k,) of the line of sight to the limb
    points_km: Float  # points (k, 3) of the limb
    normals: Float  # unit normals (k, 3) of the surface there
    lean: Float  # cosine (k,) between the half-plane and the normal of the surface at the limb

    @classmethod
    def from_ellipsoid(cls, radii_km: Float, toward: Float, across: Float, distance_km: float) -> _SmoothLimb:
        """Tangents from the camera to the ellipses in which half-planes cut the ellipsoid."""
        metric = radii_km**-2.0
        aa = np.einsum("ki,i,ki->k", across, metric, across)
        ac = across @ (metric * toward)
        cc = float(toward @ (metric * toward))
        x = np.sqrt((1.0 - 1.0 / (distance_km**2 * cc)) / (aa - ac**2 / cc))
        y = (1.0 / distance_km - ac * x) / cc
        half = np.arctan2(x, distance_km - y)
        points = x[:, None] * across + y[:, None] * toward
        normal = metric * points
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        outward = np.cos(half)[:, None] * across + np.sin(half)[:, None] * toward
        return cls(
            toward=toward,
            across=across,
            distance_km=distance_km,
            polar_rad=np.arctan2(x, y),
            half_angle_rad=half,
            arm_km=np.hypot(x, distance_km - y),
            points_km=points,
            normals=normal,
            lean=np.einsum("ki,ki->k", normal, outward),
        )

    def altitudes(self, heights: HeightMap, part: slice, places_rad: Float) -> Float:
        """Apparent altitudes (p, m), km, of ground along the lines of sight of some half-planes, about their limb."""
        polar = self.polar_rad[part, None] + places_rad
        sine, cosine = np.sin(polar), np.cos(polar)
        ground = sine[..., None] * self.across[part, None] + cosine[..., None] * self.toward
        radius = heights.radii_km(ground)
        angle = np.arctan2(radius * sine, self.distance_km - radius * cosine)
        off = np.tan(angle - self.half_angle_rad[part, None])
        return off * (self.arm_km * self.lean)[part, None]


def _expected_top(seen_km: Float, sigma_km: float) -> tuple[Float, Float]:
    """Largest of altitudes (p, m), and how much above it the largest of them with independent errors is expected."""
    filled = np.where(np.isfinite(seen_km), seen_km, -np.inf)
    top = filled.max(axis=1)
    top = np.where(np.isfinite(top), top, 0.0)
    if not sigma_km > 0.0:
        return top, np.zeros(len(top))
    count = min(_CANDIDATES, filled.shape[1])
    high = np.partition(filled, filled.shape[1] - count, axis=1)[:, -count:]
    below = np.minimum(top[:, None] - high, 1e6 * sigma_km) / sigma_km
    levels = np.linspace(-_REACH_SIGMAS, _REACH_SIGMAS + 2.0, _LEVELS)
    # The mean of a variable is its least value and the area above its distribution.
    chance = np.prod(ndtr(levels[None, :, None] + below[:, None, :]), axis=2)
    step = levels[1] - levels[0]
    mean = levels[0] + np.sum(1.0 - chance, axis=1) * step - 0.5 * step
    return top, np.maximum(mean * sigma_km, 0.0)
