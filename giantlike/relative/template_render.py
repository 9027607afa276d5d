"""Templates for a fit: a body rendered at trial geometries into a fixed box of the image."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Scalar
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.ray_tracing import Body, Lambert, LommelSeeliger, Reflectance, RenderOptions, Template, render
from giantlike.relative.estimator import EstimatorInputs
from giantlike.relative.template_fit import FIT_BORDER_PX, Synthesis, TemplateImages, TemplateState, warped

UNKNOWN_PSF_SIGMA_PX = 0.7
"""Point spread function to start from where the camera does not know its own."""
UNKNOWN_BLUR_SIGMA_PX2 = 1.0
"""How far its variance may be from the true one."""
KNOWN_BLUR_SIGMA_PX2 = 0.15
"""The same where the camera knows: a tenth of a usual width, and what the sampling of renders adds."""

_POINT_PX = 1e-3  # smaller bodies, and points, take no more rays
_MAX_RAYS_PER_PIXEL_SIDE = 24
_NARROW_SIDE = 0.5  # rays over the narrow side of a body over those across it
_NEAR_PX, _NEAR_BLUR = 1.0, 0.1
_OTHER_COARSENESS = 2.0  # changes need no fine edges; the other law only shades ...
_COARSE_RADIUS_PX = 20.0  # ... but where a body is all edge
_SMALL_RADIUS_PX = 10.0  # below, the derivative with respect to the range is that of renders
_LOG_RANGE_STEP = 0.04


@dataclass(frozen=True, slots=True, kw_only=True)
class FitBox:
    """A box of pixels, which may reach over the frame by a few.

    Parameters
    ----------
    x, y : int, px
        Column and row of its first pixel.
    width, height : int, px
    """

    x: int
    y: int
    width: int
    height: int

    @classmethod
    def around(cls, template: Template, shift_px: NDArray[np.int64], margin_px: int, inputs: EstimatorInputs) -> FitBox:
        """The box of a shifted template and a margin, cut where it reaches farther over the frame than derivatives."""
        size = np.array(template.brightness.shape[::-1])
        low = template.corner_px + shift_px - margin_px
        high = template.corner_px + shift_px + size + margin_px
        frame = np.array([inputs.camera.columns, inputs.camera.rows])
        low = np.clip(low, -FIT_BORDER_PX, frame)
        high = np.clip(high, low + 1, np.maximum(frame + FIT_BORDER_PX, low + 1))
        (x, y), (width, height) = low.tolist(), (high - low).tolist()
        return cls(x=x, y=y, width=width, height=height)

    @property
    def corner_px(self) -> tuple[int, int]:
        """Column and row of its first pixel."""
        return self.x, self.y

    def cut(self, frame: NDArray[Scalar], outside: Any = 0) -> NDArray[Scalar]:
        """The part of an image (rows, columns) in the box, ``outside`` where the box reaches over it."""
        return _pasted(frame, (0, 0), (self.x, self.y), (self.height, self.width), outside)

    def place(self, patch: NDArray[Scalar], corner_px: NDArray[np.int64]) -> NDArray[Scalar]:
        """A patch whose first pixel is image pixel ``corner_px``, in the box; zero around it."""
        corner = int(corner_px[0]), int(corner_px[1])
        return _pasted(patch, corner, (self.x, self.y), (self.height, self.width), 0)


@dataclass(frozen=True, slots=True, eq=False)
class _Changes:
    """Changes (h, w) of the light by another law, beside a share of the light itself, and per logarithm of range."""

    share: float
    difference: Float | None
    per_log_range: Float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateRenderer:
    """Renders the target of an estimate.

    Parameters
    ----------
    inputs : EstimatorInputs
    rays_across : int
        Rays across the body, about: small bodies get more to a pixel.
    """

    inputs: EstimatorInputs
    rays_across: int = 240

    @property
    def start(self) -> TemplateState:
        """The predicted geometry."""
        sigma = self.inputs.psf_sigma_px
        return TemplateState(
            center_px=self.inputs.predicted_px,
            psf_variance_px2=(UNKNOWN_PSF_SIGMA_PX if sigma is None else sigma) ** 2,
        )

    def body(self, state: TemplateState) -> Body:
        """The target where a state puts it, its attitude in camera axes unchanged."""
        geometry = self.inputs.geometry
        range_km = geometry.range_km * math.exp(state.log_range)
        return geometry.body(range_km * self.inputs.camera.model.unproject(state.center_px))

    def render(
        self, state: TemplateState, *, margin_px: int = 0, law: Reflectance | None = None, coarseness: float = 1.0
    ) -> Template | Failure:
        """Render a state into the frame, widened by a margin.

        Parameters
        ----------
        state : TemplateState
        margin_px : int, px
        law : Reflectance, optional
            Another law than the target's own.
        coarseness : float
            Factor on the distance between rays.
        """
        body, inputs = self.body(state), self.inputs
        if law is not None:
            body = Body(
                shape=body.shape,
                camera_from_body=body.camera_from_body,
                position_camera_km=body.position_camera_km,
                reflectance=law,
            )
        rays_across = self.rays_across / coarseness
        rays = math.ceil(rays_across / max(2.0 * inputs.radius_px, _POINT_PX))
        return render(
            body,
            inputs.camera.model,
            sun_direction_camera=inputs.geometry.sun_direction_camera,
            psf=GaussianPsf(sigma_px=math.sqrt(state.psf_variance_px2)),
            columns=inputs.camera.columns,
            rows=inputs.camera.rows,
            options=RenderOptions(
                rays_per_pixel_side=min(rays, _MAX_RAYS_PER_PIXEL_SIDE),
                min_rays_across=math.ceil(_NARROW_SIDE * rays_across),
                margin_px=margin_px,
            ),
        )

    def synthesis(self, box: FitBox, *, other_law: bool) -> Synthesis:
        """Return what renders states into a box, optionally under another reflectance law as well.

        The differences that the other law and another range make are rendered anew only where the geometry has moved by
        a pixel, and moved along with it up to there.
        """
        own = self.inputs.geometry.target.reflectance
        other = LommelSeeliger() if isinstance(own, Lambert) else Lambert()

        latest: list[tuple[TemplateState, _Changes]] = []

        def images(state: TemplateState) -> TemplateImages | Failure:
            template = self.render(state, margin_px=FIT_BORDER_PX)
            if isinstance(template, Failure):
                return template
            light = box.place(template.brightness, template.corner_px)
            if not (latest and self._near(latest[0][0], state)):
                changes = self._changes(box, state, light, other if other_law else None)
                if isinstance(changes, Failure):
                    return changes
                latest[:] = [(state, changes)]
            rendered, changes = latest[0]

            def moved(image: Float) -> Float:
                return warped(image, box.corner_px, rendered, state)

            return TemplateImages(
                light=light,
                other=None if changes.difference is None else changes.share * light + moved(changes.difference),
                per_log_range=None if changes.per_log_range is None else moved(changes.per_log_range),
            )

        return images

    def _changes(self, box: FitBox, state: TemplateState, light: Float, law: Reflectance | None) -> _Changes | Failure:
        """What another law and, on a small body, another range make of the light at a state."""
        share, difference, per_log_range = 1.0, None, None
        if law is not None:
            coarseness = 1.0 if self.inputs.radius_px < _COARSE_RADIUS_PX else _OTHER_COARSENESS
            second = self.render(state, margin_px=FIT_BORDER_PX, law=law, coarseness=coarseness)
            if isinstance(second, Failure):
                return second
            shaded = box.place(second.brightness, second.corner_px)
            share = float(shaded.sum()) / max(float(light.sum()), 1e-300)
            difference = shaded - share * light
        if self.inputs.radius_px < _SMALL_RADIUS_PX:
            sides = []
            for step in (-_LOG_RANGE_STEP, _LOG_RANGE_STEP):
                beside = replace(state, log_range=state.log_range + step)
                side = self.render(beside, margin_px=FIT_BORDER_PX, coarseness=_OTHER_COARSENESS)
                if isinstance(side, Failure):
                    return side
                sides.append(box.place(side.brightness, side.corner_px))
            per_log_range = (sides[1] - sides[0]) / (2.0 * _LOG_RANGE_STEP)
        return _Changes(share, difference, per_log_range)

    def _near(self, first: TemplateState, second: TemplateState) -> bool:
        """Whether the difference between two laws can be moved from one state to another."""
        shift_px = float(np.abs(first.center_px - second.center_px).max())
        limb_px = abs(first.log_range - second.log_range) * self.inputs.radius_px
        blur_px2 = abs(first.psf_variance_px2 - second.psf_variance_px2)
        return max(shift_px, limb_px) < _NEAR_PX and blur_px2 < _NEAR_BLUR * (0.1 + first.psf_variance_px2)


def _pasted(
    source: NDArray[Scalar], source_at: tuple[int, int], at: tuple[int, int], shape: tuple[int, int], outside: Any
) -> NDArray[Scalar]:
    """Window of ``shape`` at image pixel ``at`` filled from an array whose first pixel is ``source_at``; (x, y)."""
    window = np.full(shape, outside, dtype=source.dtype)
    x, y = at[0] - source_at[0], at[1] - source_at[1]
    y0, y1 = max(y, 0), min(y + shape[0], source.shape[0])
    x0, x1 = max(x, 0), min(x + shape[1], source.shape[1])
    if x0 < x1 and y0 < y1:
        window[y0 - y : y1 - y, x0 - x : x1 - x] = source[y0:y1, x0:x1]
    return window
