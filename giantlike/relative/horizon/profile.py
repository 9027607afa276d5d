"""Brightness of an ellipsoid across its horizon in closed form, without a ray traced or an image rendered.

A blurred step at the horizon, times brightness that changes inward with the slant of the surface: the ellipsoidal
sigmoid that the estimators on horizons fit to pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from giantlike._system.compiled import compiled
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value, select_rows
from giantlike.processing.limb.scan import PIXEL_VARIANCE_PX2
from giantlike.ray_tracing import Reflectance
from giantlike.relative.horizon.blur import DepthBlur
from giantlike.relative.horizon.geometry import Figure, PixelRays, ray_residuals
from giantlike.relative.horizon.ray_loops import curvatures
from giantlike.relative.horizon.surface import HorizonSurface, trace_rays
from giantlike.shapes import Ellipsoid
from giantlike.shapes.limbs import limb_ellipse

Indices = NDArray[np.int64]

_OVERVIEW, _LEAST_NODES, _MOST_NODES = 360, 300, 1200
"""Points of a horizon from which its length is found; least and largest number of the points laid on it.

With 180 instead of 300 on disks of 100 px, light between points near the terminator is off: limbs of Lommel and
Seeliger at 100 degrees of phase by 3.7e-4 of the range instead of 2.9e-4 (60,000 DN, six views), in the same time.
"""
_NODE_PX = 2.0  # length of horizon to a point, px
_KNOT_ERROR, _KNOT_REACH = 5e-4, 8
"""Error of brightness interpolated along the horizon relative to the largest; and maximum points between knots.

Where the terminator meets the horizon the brightness has a kink, at another place for each depth: with knots in even
steps of 0.07 rad centers of disks of 300 px moved by up to 0.9 sigma.
"""
_KNOT_DEPTHS_PX = np.array([0.3, 1.0, 2.0, 3.5, 6.0])  # inside the horizon, where the brightness along it is looked at
_DEPTHS, _WING_DEPTHS = 36, 18
"""Depths that the integral over a blur takes, and those over wings, whose light is smooth and of which little counts:
with 18 for these, centers of seven disks of 300 px were where they are with 36 to 0.014 sigma."""
_TABLE_STEP = 0.35  # of the width of the blur
_TINY = float(np.finfo(np.float64).tiny)
_LIT_DEPTHS_PX = np.array([0.5, 2.0, 3.5])  # inside the horizon, where limb counts as lit or dark


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedFigure(Value):
    """An ellipsoid in front of the camera."""

    figure: Figure
    position_camera_km: Float  # of its center


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HorizonArc(Value):
    """Points of a horizon in even steps along its image, those that the camera model images."""

    points_px: Float  # (k, 2)
    points_camera_km: Float  # (k, 3); the same points in space
    normals_px: Float  # (k, 2); outward
    design: Float  # (k, 3) px/km; outward motion with the position of the body
    along_px: Float  # (k,); length of the horizon from its start, without parts that are not imaged
    spacing_px: float
    perimeter_px: float
    complete: bool  # all of the horizon has an image
    directions: Float  # (k, 3), camera axes; of the points
    by_pixel: Float  # (k, 3, 2) 1/px; change of the directions with the pixel
    curvature: Float  # (k,) 1/px; of the horizon in the image, positive where it bulges outward
    body: PlacedFigure  # the ellipsoid

    @property
    def tangents_px(self) -> Float:
        """Unit vectors (k, 2) along the horizon."""
        return np.stack([-self.normals_px[:, 1], self.normals_px[:, 0]], axis=-1)

    @property
    def inward(self) -> Float:
        """Change (k, 3) of the directions by one pixel inward, 1/px."""
        result: Float = -(self.by_pixel @ self.normals_px[..., None])[..., 0]
        return result

    def thin(self, cell_px: float, every: int) -> HorizonArc:
        """Return the points in every so many-th of the cells of a length, px."""
        return select_rows(self, (self.along_px / cell_px).astype(np.int64) % every == 0)


def horizon_arc(model: CameraModel, figure: Figure, position_camera_km: Float) -> HorizonArc | Failure:
    """Lay points on the horizon of an ellipsoid."""
    turn = figure.camera_from_axes
    ellipse = limb_ellipse(Ellipsoid(radii_km=figure.radii_km), rotate(turn.inv(), -position_camera_km))
    middle, first, second = (rotate(turn, vector) for vector in ellipse)
    if not np.isfinite(middle).all():
        return Failure(Reason.DEGENERATE_GEOMETRY, "the camera lies inside the ellipsoid")
    angles = np.linspace(0.0, 2.0 * np.pi, _OVERVIEW + 1)

    def at(turns: Float) -> Float:
        result: Float = position_camera_km + middle + np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * second
        return result

    corners = model.project(at(angles))
    lengths = np.nan_to_num(np.linalg.norm(np.diff(corners, axis=0), axis=1))
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    perimeter = float(along[-1])
    if not perimeter > 0.0:
        return Failure(Reason.OUT_OF_FRAME, "the camera model images no part of the horizon")
    count = int(np.clip(perimeter / _NODE_PX, _LEAST_NODES, _MOST_NODES))
    places = np.asarray((np.arange(count) + 0.5) * perimeter / count, dtype=np.float64)
    points = at(np.interp(places, along, angles).astype(np.float64))
    pixels = model.project(points)
    imaged = np.isfinite(pixels).all(axis=1)
    rays = PixelRays.through(pixels[imaged], model)
    _, design, normals = ray_residuals(rays, figure, position_camera_km, steps=1)  # they are on the horizon
    _, conic = figure.cone(position_camera_km)
    return HorizonArc(
        points_px=pixels[imaged],
        points_camera_km=points[imaged],
        normals_px=normals,
        design=design,
        along_px=places[imaged],
        spacing_px=perimeter / count,
        perimeter_px=perimeter,
        complete=bool(np.isfinite(corners).all()),
        directions=rays.directions,
        by_pixel=rays.by_pixel,
        curvature=curvatures(rays.directions, rays.by_pixel, normals, conic),
        body=PlacedFigure(figure=figure, position_camera_km=position_camera_km),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ProfileTable(Value):
    """Brightness across a horizon, by powers of the cosine of emission, tabulated on distances from it.

    values: brightness at the knots and m distances, for p powers and q profiles that may be mixed in: other laws, and
        the wings of the point spread function. Then its derivatives by distance, 1/px, and at last the second
        derivatives of the powers, 1/px^2.
    """

    knots_px: Float  # (k,); places along the horizon, as of ``HorizonArc.along_px``
    first_px: float  # first_px, step_px: the distances are ``first + i step``, positive outward
    step_px: float
    values: Float
    powers: int  # the number p

    def at(self, along_px: Float, outward_px: Float) -> tuple[Float, Float, Float]:
        """Interpolate the table.

        ``along_px``, ``outward_px`` (n,); returns ``value`` (n, p + q) and ``slope``, ``curve`` (n, p).
        """
        return _interpolate(self.knots_px, self.first_px, self.step_px, self.values, self.powers, along_px, outward_px)


@compiled
def _interpolate(
    knots_px: Float, first_px: float, step_px: float, values: Float, powers: int, along_px: Float, outward_px: Float
) -> tuple[Float, Float, Float]:
    """Interpolate a table at n places, with its fields and with results as of :class:`ProfileTable`.

    Linearly along the horizon, and by cubics with the tabulated slopes across it.
    """
    n, count, width = len(along_px), values.shape[1], values.shape[2]
    half, last = (width - powers) // 2, len(knots_px) - 1
    value, slope, curve = np.empty((n, half)), np.empty((n, powers)), np.empty((n, powers))
    before, after = np.empty(width), np.empty(width)
    for k in range(n):
        place = (outward_px[k] - first_px) / step_px
        index = min(max(math.floor(place), 0), count - 2)
        t = place - index
        s = 1.0 - t
        knot = min(max(np.searchsorted(knots_px, along_px[k]) - 1, 0), max(last - 1, 0))
        after_knot = min(knot + 1, last)
        apart = max(knots_px[after_knot] - knots_px[knot], _TINY)
        share = min(max((along_px[k] - knots_px[knot]) / apart, 0.0), 1.0)
        for i in range(width):
            here, there = values[knot, index, i], values[after_knot, index, i]
            before[i] = here + share * (there - here)
            here, there = values[knot, index + 1, i], values[after_knot, index + 1, i]
            after[i] = here + share * (there - here)
        a, b = s * s * (1.0 + 2.0 * t), step_px * s * s * t  # of value and slope before, and after
        c, d = t * t * (3.0 - 2.0 * t), -step_px * t * t * s
        for i in range(half):
            value[k, i] = a * before[i] + b * before[half + i] + c * after[i] + d * after[half + i]
        for i in range(powers):
            here, there = before[2 * half + i], after[2 * half + i]
            slope[k, i] = a * before[half + i] + b * here + c * after[half + i] + d * there
            curve[k, i] = here + t * (there - here)
    return value, slope, curve


def profile_table(
    arc: HorizonArc,
    sun_direction_camera: Float,
    law: Reflectance | None,
    *,
    width_px: float,
    window_px: float,
    powers: int,
    others: tuple[Reflectance, ...] = (),
    wings_px: tuple[float, ...] = (),
) -> ProfileTable:
    r"""Tabulate the brightness that a blurred image of an ellipsoid has across its horizon.

    ``sun_direction_camera``: unit vector from body to Sun; ``powers``: ``law mu^j`` is tabulated for j from 0 up to
    this, not included.

    At the depth t inside the horizon, in px along its normal, a ray x meets the ellipsoid where the discriminant
    ``x.M.x`` says, which is quadratic in t and zero at t = 0; so the cosine of emission mu grows as the square root
    of t, and every reflectance law that is smooth in the cosines is smooth in ``sqrt(t)``. With ``t = v^2`` the
    convolution with the blur is a Gauss-Legendre sum over v. A round blur of width w also averages along the
    horizon: that adds ``w^2 / 2`` times slope times curvature, ``c / (1 - c t)`` at the depth t under a horizon of
    curvature c; this is the first term of a series, whose next one counts only for disks of few widths.
    """
    step = _TABLE_STEP * width_px
    count = math.ceil((window_px + 1.0) / step)
    offsets = np.asarray(np.arange(-count, count + 1) * step, dtype=np.float64)
    knots = select_rows(arc, _knots(arc, sun_direction_camera, law))
    blurs = [
        DepthBlur.from_width(width_px, offsets, _DEPTHS),
        *(DepthBlur.from_width(wing_px, offsets, _WING_DEPTHS) for wing_px in wings_px),
    ]
    surface = _surface(knots, np.concatenate([blur.depths_px for blur in blurs]), sun_direction_camera)
    own = surface.to_depth(_DEPTHS)
    light = surface.brightness(law)
    first, *wings = np.split(light, np.cumsum([blur.depths_px.size for blur in blurs[:-1]]), axis=1)
    bases = [
        np.stack([*(first * own.emission**power for power in range(powers)), *(own.brightness(law) for law in others)]),
        *(wing[None] for wing in wings),
    ]
    parts = [blur.apply(basis, knots.curvature, knots.normals_px) for blur, basis in zip(blurs, bases, strict=True)]
    values = [*(part[:, :, 0] for part in parts), *(part[:, :, 1] for part in parts), parts[0][:powers, :, 2]]
    return ProfileTable(
        knots_px=knots.along_px,
        first_px=float(offsets[0]),
        step_px=step,
        values=np.ascontiguousarray(np.moveaxis(np.concatenate(values), 0, -1)),
        powers=powers,
    )


def _knots(arc: HorizonArc, sun: Float, law: Reflectance | None) -> Mask:
    """Points (k,) of an arc between which brightness may be interpolated: its ends, and more of them where it bends."""
    light = _surface(arc, _KNOT_DEPTHS_PX, sun).brightness(law)
    bend = np.zeros(len(light))
    bend[1:-1] = np.abs(light[2:] - 2.0 * light[1:-1] + light[:-2]).max(axis=1) / max(float(light.max()), 1e-300)
    around = maximum_filter1d(bend, 2 * _KNOT_REACH + 1, mode="wrap")
    number = np.cumsum(np.clip(np.sqrt(around / (8.0 * _KNOT_ERROR)), 1.0 / _KNOT_REACH, 1.0)).astype(np.int64)
    apart = np.diff(arc.along_px) > 1.5 * arc.spacing_px
    ends: Mask = np.append(apart, True) | np.insert(apart, 0, True)
    return ends | np.insert(np.diff(number) > 0, 0, True)


def brightness_inside(arc: HorizonArc, sun_direction_camera: Float, law: Reflectance) -> Float:
    """Mean brightness of the first pixels inside a horizon.

    On the horizon itself the cosine of incidence says little: with the Sun behind the camera it is zero all around,
    however bright the limb.

    ``sun_direction_camera``: unit vector from body to Sun; returns (k,), in the unit of the law.
    """
    light = _surface(arc, _LIT_DEPTHS_PX, sun_direction_camera).brightness(law)
    return np.asarray(light.mean(axis=1), dtype=np.float64)


def blur_width_px(psf_variance_px2: float) -> float:
    """Standard deviation, px, of a point spread function of some variance, px^2, and the pixel together."""
    return math.sqrt(psf_variance_px2 + PIXEL_VARIANCE_PX2)


def _surface(arc: HorizonArc, depths_px: Float, sun: Float) -> HorizonSurface:
    """The surface at depths (q,) inside points of the horizon."""
    figure, position_km = arc.body.figure, arc.body.position_camera_km
    _, conic = figure.cone(position_km)
    meets, incidence, emission, phase_rad = trace_rays(
        arc.directions, arc.inward, depths_px, position_km, figure.shape_matrix, conic, sun
    )
    return HorizonSurface(meets=meets, incidence=incidence, emission=emission, phase_rad=phase_rad, air=figure.air)
