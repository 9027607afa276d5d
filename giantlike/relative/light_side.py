"""Does light lie on the side of the Sun? A body at the place found, lit from other sides, against the image."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float, Mask, unit
from giantlike.core.frames import rotate
from giantlike.core.outcomes import CenterFix, PositionFix
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.ray_tracing import Body, RenderOptions, Template, render
from giantlike.relative.quality import QualityChecks
from giantlike.scene import TargetGeometry

AnyFix = TypeVar("AnyFix", bound=CenterFix)

_CELLS = 20
"""Cells to a radius of the body: 5 % of it is far less than light moves from one side to the other."""
_MARGIN = 1.3
"""Half width of the region over the largest radius: some sky tells outline from face."""
_SHIFT = 1.0
"""Largest motion of the body over its radius: a center that is found by light taken from the wrong side is off by 0.85
radii at a phase angle of 60 deg."""
_LEAST_RADIUS_PX = 5.0
"""Radius, px, below which the point spread function takes the sides away."""
_LEAST_SHARE = 0.3
"""Share of the body that must lie in the frame."""
_OTHER_SIDES_RAD = (0.5 * math.pi, math.pi, 1.5 * math.pi)
"""Angles by which the Sun is turned about the line of sight."""
_EXACT = 1e-9
"""Share of the variance that rounding leaves of an exact model."""
_BLOCK = 0.25
"""Size over the radius of the parts of a disk whose departures from a model are alike: markings, errors of the law,
as in ``relative/light/moment.py``. They set how much a better match means, which noise of pixels does not."""


_ODDS = "light_log_odds"
"""Key of the provenance of fixes: logarithm of the odds that light comes from another side than the Sun's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LightSide:
    """How well an image matches a body lit from the side of the Sun, and from the best of three others.

    Parameters
    ----------
    unexplained, unexplained_by_other : float
        Share of the variance of the pixels that the body lit so leaves, at the shift that leaves least.
    log_odds : float
        Logarithm of the likelihood under the other side over that under the side of the Sun.
    """

    unexplained: float
    unexplained_by_other: float
    log_odds: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Cells(Value):
    """The image around a body in cells, with room for shifts."""

    values: Float
    good: Mask
    camera: Camera
    box: PixelBox
    shift: int
    radius: float

    @property
    def inner(self) -> PixelBox:
        """The box without the room for shifts."""
        side = self.box.width - 2 * self.shift
        return PixelBox(x=self.box.x + self.shift, y=self.box.y + self.shift, width=side, height=side)

    def render(self, body: Body, sun: Float) -> Template | None:
        """Render a body into the cells; None where nothing of it is seen or lit."""
        camera = self.camera
        template = render(
            body,
            camera.model,
            sun_direction_camera=sun,
            psf=camera.psf,
            columns=camera.columns,
            rows=camera.rows,
            options=RenderOptions(rays_per_pixel_side=1, min_rays_across=2 * _CELLS, margin_px=self.box.width),
        )
        return template if isinstance(template, Template) else None

    def parts(self, template: Template) -> float:
        """Parts of the body in the frame whose departures from a model are independent; 0 where too little shows."""
        x, y = template.corner_px.tolist()
        coverage = self.box.cut(template.coverage, (x, y))
        covered = float(coverage.sum())
        seen = float(coverage[self.good].sum())
        return seen / (_BLOCK * self.radius) ** 2 if seen > _LEAST_SHARE * covered else 0.0

    def unexplained(self, template: Template) -> float:
        """Share of the variance of the cells that a template leaves at its best shift."""
        x, y = template.corner_px.tolist()
        model = self.inner.cut(template.brightness, (x, y))
        good, values = self.good.astype(np.float64), np.where(self.good, self.values, 0.0)
        ones = np.ones(model.shape)
        number, total, squares = (_at_shifts(one, ones) for one in (good, values, values**2))
        light, light_squares = (_at_shifts(good, one) for one in (model, model**2))
        product = _at_shifts(values, model)
        number = np.maximum(number, 1.0)
        variance, light_variance = squares - total**2 / number, light_squares - light**2 / number
        covariance = product - total * light / number
        seen = (variance > _EXACT * squares.max()) & (light_variance > _EXACT * light_squares.max())
        explained = np.maximum(covariance[seen], 0.0) ** 2 / (variance[seen] * light_variance[seen])
        return float(1.0 - explained.max(initial=0.0))


def with_light_checked(fix: AnyFix, pixels_dn: Float, good: Mask, camera: Camera, geometry: TargetGeometry) -> AnyFix:
    """Return a fix that says on which side of the body its light lies; unchanged where it says so already.

    Parameters
    ----------
    fix : CenterFix or PositionFix
    pixels_dn : (rows, columns) float64, DN
        Bias subtracted.
    good : (rows, columns) bool
        Pixels that are not bad.
    camera : Camera
    geometry : TargetGeometry
        A priori geometry.

    Returns
    -------
    CenterFix or PositionFix
        With ``light_log_odds`` in its provenance, and the flag ``WRONG_LIGHT`` where they are high.
    """
    if _ODDS in fix.provenance:
        return fix
    range_km = fix.range_km if isinstance(fix, PositionFix) else geometry.range_km
    body = geometry.body(range_km * camera.model.unproject(fix.center_px))
    found = light_side(pixels_dn, good, camera, body, geometry.sun_direction_camera)
    if found is None:
        return fix
    checks = QualityChecks(off_px=np.zeros(2), search_px=math.inf, light_log_odds=found.log_odds)
    return replace(fix, flags=fix.flags | checks.flags, provenance={**fix.provenance, _ODDS: f"{found.log_odds:.3g}"})


def light_side(
    pixels_dn: Float, good: Mask, camera: Camera, body: Body, sun_direction_camera: Float
) -> LightSide | None:
    """Compare an image with a body that is lit from the side of the Sun, and from the others.

    Parameters
    ----------
    pixels_dn : (rows, columns) float64, DN
    good : (rows, columns) bool
        Pixels that are not bad; saturated ones still say that it is bright there.
    camera : Camera
    body : Body
        At the place found.
    sun_direction_camera : (3,) float64, unitless, camera axes
        Unit vector from body to Sun.

    Returns
    -------
    LightSide or None
        None where the body is too small, or too little of it lies in the frame.

    Notes
    -----
    Residuals of a body are errors of its law and of its markings: alike over a quarter of a radius, independent beyond.
    With n such parts the likelihood goes with the unexplained variance to the power of -n / 2. At small phase angles
    all sides match alike, and the odds are even.
    """
    cells = _cells(pixels_dn, good, camera, body)
    if cells is None:
        return None
    sight = unit(body.position_camera_km)
    own = cells.render(body, sun_direction_camera)
    parts = 0.0 if own is None else cells.parts(own)
    if own is None or parts == 0.0:
        return None
    turned = [rotate(Rotation.from_rotvec(angle * sight), sun_direction_camera) for angle in _OTHER_SIDES_RAD]
    others = [one for one in (cells.render(body, sun) for sun in turned) if one is not None]
    left = max(cells.unexplained(own), _EXACT)
    left_by_other = max(min((cells.unexplained(one) for one in others), default=1.0), _EXACT)
    odds = 0.5 * parts * math.log(left / left_by_other)
    return LightSide(unexplained=left, unexplained_by_other=left_by_other, log_odds=odds)


def _at_shifts(values: Float, model: Float) -> Float:
    """Sums of products of cells and a model at all shifts of it that stay within the cells."""
    from scipy.signal import correlate

    return np.asarray(correlate(values, model, mode="valid", method="fft"))


def _cells(pixels_dn: Float, good: Mask, camera: Camera, body: Body) -> _Cells | None:
    """Means of blocks of pixels around a body; None where it is too small or too little of it is in the frame."""
    center_px = body.center_px(camera.model)
    if not np.isfinite(center_px).all():
        return None
    inside = np.clip(center_px, -0.5, [camera.columns - 0.5, camera.rows - 0.5])
    range_km = float(np.linalg.norm(body.position_camera_km))
    scale = 1.0 / range_km / float(camera.ifov_rad(inside))
    radius_px = body.shape.mean_radius_km * scale
    size = max(1, round(radius_px / _CELLS))
    rows, columns = (length // size for length in good.shape)
    if radius_px < _LEAST_RADIUS_PX or min(rows, columns) < 2:
        return None
    shift = math.ceil(_SHIFT * radius_px / size)
    half = math.ceil(_MARGIN * body.shape.circumscribing_radius_km * scale / size) + shift
    binned = camera.binned(size, detector=camera.detector)
    x, y = np.rint(body.center_px(binned.model)).astype(int).tolist()
    box = PixelBox(x=x - half, y=y - half, width=2 * half + 1, height=2 * half + 1)
    counts = _summed(good.astype(np.float64), size)
    values = _summed(np.where(good, pixels_dn, 0.0), size) / np.maximum(counts, 1.0)
    kept = box.cut(np.asarray(counts > 0.5 * size**2), (0, 0))
    return _Cells(
        values=box.cut(values, (0, 0)), good=kept, camera=binned, box=box, shift=shift, radius=radius_px / size
    )


def _summed(values: Float, size: int) -> Float:
    """Sums (rows // size, columns // size) of blocks."""
    rows, columns = (length // size for length in values.shape)
    blocks = values[: rows * size, : columns * size].reshape(rows, size, columns, size)
    return np.asarray(blocks.sum(axis=(1, 3)))
