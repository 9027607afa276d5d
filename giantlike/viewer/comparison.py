"""Comparison of an image with a fix: template, image minus template, correlation by shift, residuals of limb points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.campaign.store.records import ObservationRecord
from giantlike.core.arrays import Float, Mask
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.processing.correlate import normalized_correlation
from giantlike.ray_tracing import Template, render, trace_silhouette
from giantlike.viewer.session import Session, chosen_fix

_BORDER_PX = 20
"""Pixels around a template whose mean is its background: wider than a psf, nearer than most other bodies."""
_OUTLINE_ANGLES = 720
"""Points of the outline that limb points are compared with: every half degree, 1 px apart on a disk of 230 px."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderedMatch(Value):
    """A body rendered at a fix of it, in the units of the image."""

    target: str  # target, estimator: estimator is empty for the prediction
    estimator: str
    model_dn: Float  # (rows, columns); rendered body, scaled to the image by least squares, on its background
    image_dn: Float  # (rows, columns)
    region: Mask  # (rows, columns); good pixels of the template and its border
    template: Template

    @property
    def difference_dn(self) -> Float:
        """Image minus template, 0 outside of the region."""
        return np.where(self.region, self.image_dn - self.model_dn, 0.0)

    def correlation(self, *, half_px: int = 12) -> Float:
        """Normalized correlation of image and template for shifts around the fix, (2 half + 1,) * 2; NaN where none."""
        height, width = self.template.brightness.shape
        x, y = self.template.corner_px.tolist()
        rows, columns = self.image_dn.shape
        wide = np.full((height + 2 * half_px, width + 2 * half_px), np.nan)
        top, left = y - half_px, x - half_px
        ys = slice(max(top, 0), min(top + wide.shape[0], rows))
        xs = slice(max(left, 0), min(left + wide.shape[1], columns))
        wide[ys.start - top : ys.stop - top, xs.start - left : xs.stop - left] = self.image_dn[ys, xs]
        usable = np.isfinite(wide)
        return normalized_correlation(np.where(usable, wide, 0.0), self.template.brightness, image_usable=usable)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbResiduals(Value):
    """Limb points of a fix, relative to the outline of the body there."""

    points: Float  # (n, 2) px
    angle_deg: Float  # (n,); around the center of the fix, from +x towards +y
    distance_px: Float  # (n,); from the outline, positive outward


def match_of(session: Session, file: str, target: str, estimator: str | None = None) -> RenderedMatch:
    """Render a body where a fix has it, and scale it to the image."""
    image = session.image(file)
    fix = chosen_fix(session.seen(file), target, estimator)
    template = _render_template(session, image, file, target, fix)
    pixels = image.pixels.astype(np.float64)
    light = template.placed(image.columns, image.rows)
    region = _region(template, image)
    design = np.stack([light[region], np.ones(int(region.sum()))], axis=1)
    (gain, background), *_ = np.linalg.lstsq(design, pixels[region], rcond=None)
    return RenderedMatch(
        target=target,
        estimator="" if fix is None else fix.estimator,
        model_dn=gain * light + background,
        image_dn=pixels,
        region=region,
        template=template,
    )


def limb_residuals(session: Session, file: str, fix: ObservationRecord, *, rejected: bool = False) -> LimbResiduals:
    """Distances of the limb points of a fix from the outline of the body at the fix."""
    kept = session.seen(file).points.get(fix.subject, {}).get("limb_rejected_px" if rejected else "limb_px", [])
    points = np.asarray(kept, dtype=np.float64).reshape(-1, 2)
    known = session.geometry(file).get(fix.target)
    if not len(points) or known is None or fix.center_px is None:
        raise InputError(f"{file}: {fix.estimator} has no limb points of {fix.target}, or its geometry is not known")
    body = known.body(session.position_camera_km(known, fix))
    angles = np.linspace(0.0, 2.0 * np.pi, _OUTLINE_ANGLES, endpoint=False)
    outline = trace_silhouette(body, session.camera.model, angles, sun_direction_camera=known.sun_direction_camera)
    edge = outline.points_px[outline.valid]
    distance = _signed_distance(points, edge, np.array(fix.center_px))
    arms = points - np.array(fix.center_px)
    return LimbResiduals(points=points, angle_deg=np.degrees(np.arctan2(arms[:, 1], arms[:, 0])), distance_px=distance)


def _render_template(session: Session, image: Image, file: str, target: str, fix: ObservationRecord | None) -> Template:
    known = session.geometry(file, image=image).get(target)
    if known is None:
        raise InputError(f"{file}: the geometry of {target} is not known in this image")
    template = render(
        known.body(session.position_camera_km(known, fix)),
        session.camera.model,
        sun_direction_camera=known.sun_direction_camera,
        psf=session.camera.psf,
        columns=image.columns,
        rows=image.rows,
    )
    if isinstance(template, Failure):
        raise InputError(f"{file}: {target} cannot be rendered: {template.reason}: {template.detail}")
    return template


def _region(template: Template, image: Image) -> Mask:
    """Pixels of a template with a border, without bad ones."""
    region = np.zeros(image.pixels.shape, dtype=bool)
    (x, y), (height, width) = template.corner_px.tolist(), template.brightness.shape
    top, left = max(y - _BORDER_PX, 0), max(x - _BORDER_PX, 0)
    region[top : max(y + height + _BORDER_PX, 0), left : max(x + width + _BORDER_PX, 0)] = True
    return region & ~image.mask


def _signed_distance(points: Float, outline: Float, center: Float) -> Float:
    """Distances (n,) of points from a closed polygon, positive where they lie farther from its center."""
    start, stop = outline, np.roll(outline, -1, axis=0)
    along = stop - start
    share = np.einsum("nki,ki->nk", points[:, None] - start, along) / np.maximum((along**2).sum(axis=1), 1e-12)
    nearest = start + np.clip(share, 0.0, 1.0)[..., None] * along
    off = points[:, None] - nearest
    best = np.argmin((off**2).sum(axis=2), axis=1)
    rows = np.arange(len(points))
    outward = np.einsum("ni,ni->n", off[rows, best], nearest[rows, best] - center)
    distance: Float = np.sign(outward) * np.linalg.norm(off[rows, best], axis=1)
    return distance
