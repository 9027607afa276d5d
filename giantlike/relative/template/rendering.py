"""Templates for a fit: a body rendered at trial geometries into a fixed box of the image."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Scalar
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX, GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.core.values import Value
from giantlike.ray_tracing import (
    Body,
    Lambert,
    LommelSeeliger,
    Reflectance,
    RenderOptions,
    Template,
    Trace,
    render,
    trace_body,
)
from giantlike.relative.estimator import EstimatorInputs
from giantlike.relative.template.fit import FIT_BORDER_PX, Synthesis, TemplateImages, TemplateState, warped

UNKNOWN_BLUR_SIGMA_PX2 = 1.0
"""How far its variance may be from the true one."""
KNOWN_BLUR_SIGMA_PX2 = 0.15
"""The same where the camera knows: a tenth of a usual width, and what the sampling of renders adds."""

_POINT_PX = 1e-3  # smaller bodies, and points, take no more rays
_MAX_RAYS_PER_PIXEL_SIDE = 24
_NARROW_SIDE = 0.5  # rays over the narrow side of a body over those across it
_NEAR_PX, _NEAR_BLUR = 1.0, 0.1
_ROUGH = (
    2.0  # times the distance between rays: on the way to the solution, and for changes, which need no fine edges ...
)
_COARSE_RADIUS_PX = 20.0  # ... but where a body is all edge
_FINE_RAYS = 2  # along the side of a pixel, at least: one a pixel leaves 0.02 px of a 300 px body, two 0.003
_SMALL_RADIUS_PX = 10.0  # below, derivatives are those of renders
_STEP_PX, _BLUR_STEP_PX2 = 0.125, 0.1
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
        """The box of a shifted template and a margin."""
        low = template.corner_px + shift_px
        high = low + np.array(template.brightness.shape[::-1])
        return cls.spanning(low.astype(np.float64), high.astype(np.float64), margin_px, inputs)

    @classmethod
    def spanning(cls, low_px: Float, high_px: Float, margin_px: int, inputs: EstimatorInputs) -> FitBox:
        """The box from pixel ``low_px`` up to but without ``high_px`` (2,), and a margin.

        It is cut where it reaches farther over the frame than derivatives do.
        """
        frame = np.array([inputs.camera.columns, inputs.camera.rows])
        low = np.clip(np.floor(low_px).astype(np.int64) - margin_px, -FIT_BORDER_PX, frame)
        high = np.ceil(high_px).astype(np.int64) + margin_px
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
class _Changes(Value):
    """Changes (h, w) of the light by another law, beside a share of the light itself, and its derivatives (4, h, w)."""

    share: float
    difference: Float | None
    derivatives: Float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateRenderer(Value):
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
        self, state: TemplateState, *, margin_px: int = 0, rough: bool = False, min_rays_per_pixel_side: int = 1
    ) -> Template | Failure:
        """Render a state into the frame, widened by a margin.

        Parameters
        ----------
        state : TemplateState
        margin_px : int, px
        rough : bool
            Whether twice the distance between rays does.
        min_rays_per_pixel_side : int
        """
        options = self._options(margin_px, rough=rough, min_rays=min_rays_per_pixel_side)
        return render(self.body(state), self.inputs.camera.model, **self._shot(state), options=options)

    def trace(self, state: TemplateState, *, margin_px: int = 0, rough: bool = False) -> Trace | Failure:
        """Trace a state, to be shaded under several laws; parameters are those of :meth:`render`."""
        options = self._options(margin_px, rough=rough, min_rays=1)
        return trace_body(self.body(state), self.inputs.camera.model, **self._shot(state), options=options)

    def _shot(self, state: TemplateState) -> dict[str, Any]:
        """What a render and a trace of a state have in common."""
        return {
            "sun_direction_camera": self.inputs.geometry.sun_direction_camera,
            "psf": GaussianPsf(sigma_px=math.sqrt(state.psf_variance_px2)),
            "columns": self.inputs.camera.columns,
            "rows": self.inputs.camera.rows,
        }

    def _options(self, margin_px: int, *, rough: bool, min_rays: int) -> RenderOptions:
        """How finely to render."""
        rays_across = self.rays_across / (_ROUGH if rough else 1.0)
        rays = math.ceil(rays_across / max(2.0 * self.inputs.radius_px, _POINT_PX))
        return RenderOptions(
            rays_per_pixel_side=max(min(rays, _MAX_RAYS_PER_PIXEL_SIDE), min_rays),
            min_rays_across=math.ceil(_NARROW_SIDE * rays_across),
            margin_px=margin_px,
        )

    def synthesis(self, box: FitBox, *, other_law: bool) -> Synthesis:
        """Return what renders states into a box, optionally under another reflectance law as well.

        The differences that the other law and another range make are rendered anew only where the geometry has moved by
        a pixel, and moved along with it up to there.
        """
        own = self.inputs.geometry.target.reflectance
        other = (LommelSeeliger() if isinstance(own, Lambert) else Lambert()) if other_law else None
        latest: list[tuple[TemplateState, _Changes]] = []

        def images(state: TemplateState, fine: bool) -> TemplateImages | Failure:
            light: Float | None = None
            if not (latest and self._near(latest[0][0], state)):
                made = self._changes(box, state, other)
                if isinstance(made, Failure):
                    return made
                light, changes = made
                latest[:] = [(state, changes)]
            rendered, changes = latest[0]
            if fine or light is None:
                sides = _FINE_RAYS if fine else 1
                template = self.render(state, margin_px=FIT_BORDER_PX, rough=not fine, min_rays_per_pixel_side=sides)
                if isinstance(template, Failure):
                    return template
                light = box.place(template.brightness, template.corner_px)

            def moved(image: Float) -> Float:
                return image if rendered is state else warped(image, box.corner_px, rendered, state)

            return TemplateImages(
                light=light,
                other=None if changes.difference is None else changes.share * light + moved(changes.difference),
                derivatives=None if changes.derivatives is None else np.stack([moved(d) for d in changes.derivatives]),
            )

        return images

    def _changes(self, box: FitBox, state: TemplateState, law: Reflectance | None) -> tuple[Float, _Changes] | Failure:
        """The light at a state, and what another law and, on a small body, another range make of it."""
        rough = self.inputs.radius_px >= _COARSE_RADIUS_PX
        trace = self.trace(state, margin_px=FIT_BORDER_PX, rough=rough)
        if isinstance(trace, Failure):
            return trace
        template = trace.template()
        if isinstance(template, Failure):
            return template
        light = box.place(template.brightness, template.corner_px)
        share = 1.0
        difference: Float | None = None
        derivatives: Float | None = None
        if law is not None:
            second = trace.with_reflectance(law).template()
            if isinstance(second, Failure):
                return second
            shaded = box.place(second.brightness, second.corner_px)
            share = float(shaded.sum()) / max(float(light.sum()), 1e-300)
            difference = shaded - share * light
        if self.inputs.radius_px < _SMALL_RADIUS_PX:
            found = self._derivatives(box, state)
            if isinstance(found, Failure):
                return found
            derivatives = found
        return light, _Changes(share, difference, derivatives)

    def _derivatives(self, box: FitBox, state: TemplateState) -> Float | Failure:
        """Derivatives (4, h, w) of the light at a state, from renders to both sides of it."""
        across, down = np.array([_STEP_PX, 0.0]), np.array([0.0, _STEP_PX])
        blur = min(_BLUR_STEP_PX2, state.psf_variance_px2)

        def beside(sign: float) -> tuple[TemplateState, ...]:
            return (
                replace(state, center_px=state.center_px + sign * across),
                replace(state, center_px=state.center_px + sign * down),
                replace(state, log_range=state.log_range + sign * _LOG_RANGE_STEP),
                replace(state, psf_variance_px2=state.psf_variance_px2 + sign * blur),
            )

        derivatives = []
        steps = (_STEP_PX, _STEP_PX, _LOG_RANGE_STEP, blur)
        for low, high, step in zip(beside(-1.0), beside(1.0), steps, strict=True):
            sides = [self.render(side, margin_px=FIT_BORDER_PX) for side in (low, high)]
            failed = next((side for side in sides if isinstance(side, Failure)), None)
            if failed is not None:
                return failed
            below, above = (box.place(side.brightness, side.corner_px) for side in sides if isinstance(side, Template))
            derivatives.append((above - below) / (2.0 * max(step, 1e-6)))
        return np.stack(derivatives)

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
