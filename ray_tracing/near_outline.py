"""Renders near the outline of a body only: pixels along a limb, and the brightness just inside the outline."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask
from giantlike.core.compiled import compiled
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.drawn import PixelRays, drawn_sight
from giantlike.ray_tracing.embree import Int32
from giantlike.ray_tracing.footprint import FocalPlane, visible_box
from giantlike.ray_tracing.options import RenderOptions
from giantlike.ray_tracing.reflectance import Reflectance
from giantlike.ray_tracing.sampling import Cells
from giantlike.ray_tracing.trace import View, lit_rays, trace_rays, view_of

_SPLINE_PX = 2  # reach of the cubic B-spline that samples the image, from the nearest pixel
_UNEVEN = 0.1  # difference between neighboring rays over the brightest, from which a pixel gets all of its rays
_COARSER = 3.0  # rays along a pixel where light is uneven over those elsewhere; at 6, one ray where light falls off as
# the root of the depth puts a limb at 15 deg of phase 0.012 px too far in, at 3 or less 0.003 px
_EVEN = 0.02  # that difference, below which one ray is enough for a pixel
_EDGE_REACH_PX = 3
"""Distance of pixels from an edge within which uneven ones get all of their rays. Of 24 draws of rocks of 300 px errors
grew by 5 % with 3 px, by 11 % with 2, for 0.77 and 0.70 times the rays."""
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)  # golden ratio: fills an interval evenly whatever the number of points
_DEPTHS, _ASIDES = np.array([0.005, 0.015, 0.025, 0.035]), np.array([-0.015, 0.0, 0.015])
"""Where the brightness is averaged, inward and along the outline, as fractions of the radius of the body."""
_PSF_REACH_SIGMA = 3.5  # beyond and half a pixel lies a ten-thousandth of the light
_OPTIONS = RenderOptions(rays_per_pixel_side=1, min_rays_across=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NearRender(Value):
    """Part of a frame in which a body was rendered near some points.

    Parameters
    ----------
    images : (laws, h, w) float64
        Brightness under each reflectance law; the part may reach beyond the frame.
    corner_px : (2,) float64, px
        Column and row of the first pixel in the frame.
    """

    images: Float
    corner_px: Float


def render_near(
    points_px: Float,
    body: Body,
    plane: FocalPlane,
    *,
    sun_direction_camera: Float,
    rays_per_pixel_side: int,
    edges_px: Float | None = None,
    other_laws: Sequence[Reflectance] = (),
) -> NearRender | Failure:
    """Brightness of a body, rendered only near given points, under one or several reflectance laws.

    Parameters
    ----------
    points_px : (..., 2) float64, px
        Points at which the brightness is needed; pixels more than a few pixels away from all of them stay 0.
    body : Body
    plane : FocalPlane
        With a point spread function.
    sun_direction_camera : (3,) float64, unitless, camera axes
        Unit vector from body to Sun.
    rays_per_pixel_side : int
        At the edge; elsewhere a third of that is enough, and one ray where a pixel counts only by the wings of its
        light. Of rays that are traced one is enough where light is even, too.
    edges_px : (k, 2) float64, px, optional
        Points on the edge that the render is for, a pixel or two apart: far from it no pixel gets all rays. None for
        all pixels.
    other_laws : sequence of Reflectance
        The same rays are shaded under each of these too.

    Returns
    -------
    NearRender or Failure
        ``NOT_LIT`` or ``OUT_OF_FRAME`` when no light falls near any of the points, ``DEGENERATE_GEOMETRY`` when the
        camera lies inside the body.

    Raises
    ------
    InputError
        The direction is not a unit vector.

    Notes
    -----
    The light of a ray is spread over the pixels as that of its cell, cell, point spread and pixel together and exactly,
    as by :func:`giantlike.ray_tracing.render`. The place of a ray in its cell differs from row to row, so that an
    outline along the rows does not meet all of a row's rays at once.
    """
    view = view_of(body, plane.model, sun_direction_camera, _OPTIONS)
    box = visible_box(view.body, plane, plane.halo_px)
    if isinstance(box, Failure):
        return box
    size, sigma_px = (plane.columns, plane.rows), plane.psf_sigma_px
    reach = math.ceil(_PSF_REACH_SIGMA * sigma_px + 0.5)
    pixels, inner = _pixels_near(points_px.reshape(-1, 2), size, reach)
    if len(pixels) == 0:
        return Failure(Reason.OUT_OF_FRAME, "none of the points to render lies in the frame")
    sampled = _Sampled(
        pixels=pixels,
        inner=inner,
        near=np.ones(len(pixels), np.bool_) if edges_px is None else _about(edges_px, pixels),
        rays=rays_per_pixel_side,
    )
    laws = (body.reflectance, *other_laws)
    light = _drawn_light(view, plane.model, sampled, laws) or _traced_light(view, plane.model, sampled, laws)
    if not light.values[0].any():
        return Failure(Reason.NOT_LIT, "the body is dark at all points that were rendered")
    first = pixels.min(axis=0) - reach
    columns, rows = (pixels.max(axis=0) + reach + 1 - first).tolist()
    images = np.zeros((len(laws), rows, columns))
    most = int(light.sides.max())
    shares = np.zeros((most, most, 2 * reach + 1))
    for side in np.unique(light.sides).tolist():
        shares[side - 1, :side] = Cells(0, side, side).spread(-reach, 2 * reach + 1, sigma_px).toarray().T
    _spread(images, light.pixels - first - reach, light.sides, light.group, light.values, shares)
    return NearRender(images=images, corner_px=first.astype(np.float64))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sampled(Value):
    """Pixels (p, 2) that rays are sent through.

    ``rays`` along a side ``near`` (p,) an edge, fewer at ``inner`` (p,) others, and one at those that count only by the
    wings of their light.
    """

    pixels: NDArray[np.int64]
    inner: Mask
    near: Mask
    rays: int

    @property
    def fewer(self) -> int:
        """Rays along a side of inner pixels."""
        return math.ceil(self.rays / _COARSER)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _RayLight(Value):
    """Light of the rays of pixels (p, 2) with sides (p,): that of the group (r,) of each, of ``values`` (laws, groups).

    Rays of group -1 are dark.
    """

    pixels: NDArray[np.int64]
    sides: NDArray[np.int64]
    group: Int32
    values: Float


def _drawn_light(view: View, model: CameraModel, sampled: _Sampled, laws: Sequence[Reflectance]) -> _RayLight | None:
    """Light of rays for which facets are drawn; None where they are better traced."""
    sides = np.where(sampled.near, sampled.rays, np.where(sampled.inner, sampled.fewer, 1))
    patterns = np.zeros((sampled.rays, sampled.rays, sampled.rays, 2))
    for side in range(1, sampled.rays + 1):
        patterns[side - 1, :side, :side] = _pattern(side)
    seen = drawn_sight(view.body, model, PixelRays(pixels=sampled.pixels, sides=sides, patterns_px=patterns))
    if seen is None:
        return None
    traced = lit_rays(view, seen.sight, seen.directions)
    values = np.stack([traced.brightness(law) for law in laws])
    return _RayLight(pixels=sampled.pixels, sides=sides, group=seen.group, values=values)


def _traced_light(view: View, model: CameraModel, sampled: _Sampled, laws: Sequence[Reflectance]) -> _RayLight:
    """Light of rays that are traced, one to a pixel and more where these show that light is uneven."""
    axes = _ray_axes(model, sampled.pixels) @ view.body.camera_from_body.as_matrix()
    one = _light(view, axes, 1, laws)
    change = _change(sampled.pixels, one[0]) if one[0].any() else np.zeros(len(axes))
    sides = np.where((change > _EVEN) & sampled.inner, sampled.fewer, 1)
    sides[sampled.near & (change > _UNEVEN)] = sampled.rays
    order = np.argsort(sides, kind="stable")
    light = [
        one[:, sides == side] if side == 1 else _light(view, axes[sides == side], side, laws)
        for side in np.unique(sides).tolist()
    ]
    values = np.concatenate([rays.reshape(len(laws), -1) for rays in light], axis=1)
    group = np.arange(values.shape[1], dtype=np.int32)
    return _RayLight(pixels=sampled.pixels[order], sides=sides[order], group=group, values=values)


def outline_brightness(
    points_px: Float,
    normals_px: Float,
    body: Body,
    model: CameraModel,
    *,
    sun_direction_camera: Float,
    radius_px: float,
) -> Float:
    """Brightness of a body just inside its outline: mean over a square with sides near 1/25 of its radius.

    Parameters
    ----------
    points_px, normals_px : (n, 2) float64
        The outline and its outward normals; points that are not finite get 0.
    body : Body
    model : CameraModel
    sun_direction_camera : (3,) float64, unitless, camera axes
        Unit vector from body to Sun.
    radius_px : float, px
        Apparent radius of the body.

    Returns
    -------
    (n,) float64
        Over the largest of the values; 0 everywhere where none of the places is lit.

    Raises
    ------
    InputError
        The direction is not a unit vector.

    Notes
    -----
    On the outline itself the cosine of the incidence angle says little: with the Sun behind the camera it is zero all
    around, however bright the limb.
    """
    view = view_of(body, model, sun_direction_camera, _OPTIONS)
    across = np.stack([-normals_px[:, 1], normals_px[:, 0]], axis=-1)
    depth, aside = np.meshgrid(_DEPTHS, _ASIDES)
    steps = aside.ravel()[:, None] * across[:, None] - depth.ravel()[:, None] * normals_px[:, None]
    directions = np.zeros((len(points_px), depth.size, 4))
    directions[..., :3] = view.body.to_body(model.unproject(points_px[:, None] + radius_px * steps))
    traced = trace_rays(view, directions.reshape(-1, 4))
    light = np.mean(traced.brightness(view.body.reflectance).reshape(len(points_px), -1), axis=1)
    return np.asarray(light / max(float(light.max()), 1e-300))


def _pixels_near(places_px: Float, size_px: tuple[int, int], reach_px: int) -> tuple[NDArray[np.int64], Mask]:
    """Pixels (n, 2) whose light falls near places (k, 2): those in the frame, and as many beyond as it takes.

    And which of them (n,) lie near enough themselves.
    """
    margin = _SPLINE_PX + reach_px
    index = np.rint(places_px).astype(np.int64)
    index = index[np.all((index >= 0) & (index < size_px), axis=1)]
    if len(index) == 0:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.bool_)
    corner = index.min(axis=0) - margin
    width, height = (index.max(axis=0) + margin + 1 - corner).tolist()
    near = np.zeros((height, width), dtype=np.uint8)
    near[index[:, 1] - corner[1], index[:, 0] - corner[0]] = 1
    inner = cv2.dilate(near, np.ones((2 * _SPLINE_PX + 1, 2 * _SPLINE_PX + 1), np.uint8))
    rows, columns = np.nonzero(cv2.dilate(inner, np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)))
    pixels: NDArray[np.int64] = np.stack([columns, rows], axis=-1) + corner
    inside = np.all((pixels >= -reach_px) & (pixels < np.array(size_px) + reach_px), axis=1)
    return pixels[inside], inner[rows, columns][inside] > 0


def _change(pixels: NDArray[np.int64], light: Float) -> Float:
    """Difference (n,) between rays (n, k) in pixels (n, 2) and the pixels around them, over the brightest."""
    first = pixels.min(axis=0)
    x, y = (pixels - first).T
    shape = int(y.max()) + 1, int(x.max()) + 1
    most, least = np.zeros(shape, np.float32), np.full(shape, np.inf, np.float32)
    most[y, x], least[y, x] = light.max(axis=1), light.min(axis=1)
    around = np.ones((3, 3), np.uint8)
    change = cv2.dilate(most, around) - cv2.erode(least, around)
    return np.asarray(change[y, x] / float(light.max()), dtype=np.float64)


def _about(edges_px: Float, pixels: NDArray[np.int64]) -> Mask:
    """Return True (n,) for pixels (n, 2) near points (k, 2) of an edge."""
    first, last = pixels.min(axis=0), pixels.max(axis=0)
    index = np.rint(edges_px).astype(np.int64)
    index = index[np.all((index >= first) & (index <= last), axis=1)] - first
    near = np.zeros((last - first + 1)[::-1], np.uint8)
    near[index[:, 1], index[:, 0]] = 1
    side = 2 * _EDGE_REACH_PX + 1
    x, y = (pixels - first).T
    return np.asarray(cv2.dilate(near, np.ones((side, side), np.uint8))[y, x] > 0)


def _ray_axes(model: CameraModel, pixels: NDArray[np.int64]) -> Float:
    """Directions of pixels (n, 2), camera axes: the center's, and its derivatives along x and along y, (n, 3, 3)."""
    centers = pixels.astype(np.float64)
    return np.stack([model.unproject(centers), *np.moveaxis(model.unproject_jacobian(centers), -1, 0)], axis=1)


def _pattern(per_side: int) -> Float:
    """Places (rows, columns, 2) of the rays of a pixel, px from its middle."""
    place = (np.arange(per_side) + 0.5) / per_side - 0.5
    turn = (np.argsort(np.argsort(np.arange(per_side) * _GOLDEN % 1.0)) + 0.5) / per_side**2 - 0.5 / per_side
    return np.stack([place[None, :] + turn[:, None], place[:, None] + turn[None, :]], axis=-1)


def _light(view: View, axes: Float, per_side: int, laws: Sequence[Reflectance]) -> Float:
    """Brightness of ``per_side`` squared rays to each pixel, under each of the laws, (laws, n, rays).

    ``axes`` (n, 3, 3) are those of :func:`_ray_axes` in body axes. Rays count the cells of a pixel row by row.
    """
    x, y = _pattern(per_side).reshape(-1, 2).T
    steps = np.stack([np.ones(per_side**2), x, y], axis=-1)
    directions = np.zeros((len(axes), per_side**2, 4))
    length = np.zeros(directions.shape[:2])
    for axis in range(3):
        part = axes[:, :, axis] @ steps.T
        length += part**2
        directions[..., axis] = part
    scale = 1.0 / np.sqrt(length)
    for axis in range(3):  # in a fraction of the time of rows of four
        directions[..., axis] *= scale
    traced = trace_rays(view, directions.reshape(-1, 4))
    return np.stack([traced.brightness(law).reshape(-1, per_side**2) for law in laws])


@compiled
def _spread(
    images: Float,
    corners: NDArray[np.int64],
    sides: NDArray[np.int64],
    group: NDArray[np.int32],
    values: Float,
    shares: Float,
) -> None:
    """Add the light of rays to images.

    Parameters
    ----------
    images : (laws, rows, columns) float64
    corners : (p, 2) int64, px
        Column and row of the first pixel that light of each of p pixels falls on.
    sides : (p,) int64
        Rays along the sides of each of these.
    group : (r,) int32
        Of each ray, pixel by pixel and row by row; -1 for dark ones.
    values : (laws, g) float64
        Light of the groups.
    shares : (s, s, width) float64
        For each number of rays along a side, the shares of the light of each that fall on each pixel from the first on:
        down and across alike.
    """
    width = shares.shape[2]
    down, start = np.empty((shares.shape[1], width)), 0
    for p in range(len(corners)):
        x, y = corners[p]
        side = sides[p]
        share = shares[side - 1]
        for law in range(len(images)):
            dark = True
            for row in range(side):
                for column in range(side):
                    number = group[start + row * side + column]
                    if number < 0:
                        continue
                    ray = values[law, number]
                    if ray == 0.0:
                        continue
                    if dark:
                        down[:side] = 0.0
                        dark = False
                    for j in range(width):
                        down[column, j] += ray * share[row, j]
            if dark:
                continue
            for j in range(width):
                pixels = images[law, y + j, x : x + width]
                for column in range(side):
                    here = down[column, j]
                    for i in range(width):
                        pixels[i] += here * share[column, i]
        start += side * side
