"""Templates for a fit: a body rendered at trial geometries into a fixed box of the image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.ray_tracing import (
    Body,
    FocalPlane,
    Hapke,
    Lambert,
    LommelSeeliger,
    Minnaert,
    Reflectance,
    RenderOptions,
    Template,
    render,
    trace_body,
)
from giantlike.relative.estimator import apparent_radius_px
from giantlike.relative.template.state import FIT_BORDER_PX, Synthesis, TemplateImages, TemplateState, warped

UNKNOWN_BLUR_SIGMA_PX2 = 1.0
"""A priori standard deviation, px^2, of the variance of a point spread function that the camera does not know."""
KNOWN_BLUR_SIGMA_PX2 = 0.15
"""The same where the camera knows it: a tenth of a usual width, and the blur by the sampling of renders."""

_POINT_PX = 1e-3  # px: smaller bodies, and points, take no more rays
_MAX_RAYS_PER_PIXEL_SIDE = 24  # bounds the cost of small bodies; ``min_rays_across`` samples them finely enough
_NARROW_SIDE = 0.5  # rays over the narrow side of a body over those across it: bodies are rarely more elongated
_NEAR_PX, _NEAR_BLUR = 1.0, 0.1
"""Motion of center or limb, px, and share of the blur up to which derivatives are moved along."""
ROUGH = 2.0
"""Times the distance between rays: on the way to the solution, which needs no fine edges."""
_FINE = 0.5
"""Times the distance between rays in the last renders: crescents of 120 px are then right to 0.007 px, not 0.02."""
_COARSE_RADIUS_PX = 20.0  # px, from which renders on the way are rough; smaller bodies are all edge
_FINE_RAYS = 2  # along the side of a pixel, at least: one a pixel leaves 0.02 px of a 300 px body, two 0.003
_OTHER_LAWS: tuple[Reflectance, ...] = (Hapke(w=0.9), Minnaert(k=0.6))
"""Laws that are mixed in besides the one that contrasts: light scattered many times, and a limb brighter than that of
any mixture of the others. Against truths of Hapke (w = 0.3 and 0.8) and Minnaert (k = 0.6) these two keep errors at
those of an exact law; without them they reach 0.4 and 2 px of a body of 200 px."""
_UNTRIED_LAW: Reflectance = Minnaert(k=0.8)
"""Law that is not mixed in: what it would change says how much laws outside of the mixture matter. Its limb lies
between those of the others, where sums of laws follow a power law worst."""
_SMALL_RADIUS_PX = 10.0
"""Radius, px, below which derivatives are those of renders, see TemplateImages, and only one other law is mixed in."""
_STEP_PX, _LOG_RANGE_STEP, _BLUR_STEP_PX2 = 0.125, 0.04, 0.1
"""Steps to both sides for these derivatives: of the center, px, of the logarithm of the range and of the blur, px^2."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateRenderer(Value):
    """Renders a body at trial geometries.

    Parameters
    ----------
    target : Body
        At the predicted position.
    plane : FocalPlane
        With a point spread function.
    sun_direction_camera : (3,) float64, unitless, camera axes
        Unit vector from body to Sun.
    rays_across : int
        Rays across the body, about: small bodies get more to a pixel.
    """

    target: Body
    plane: FocalPlane
    sun_direction_camera: Float
    rays_across: int = 240

    @property
    def start(self) -> TemplateState:
        """The predicted geometry."""
        center_px = self.target.center_px(self.plane.model)
        return TemplateState(center_px=center_px, psf_variance_px2=self.plane.psf_sigma_px**2)

    @property
    def radius_px(self) -> float:
        """Apparent mean radius of the body at the predicted geometry, px."""
        range_km = float(np.linalg.norm(self.target.position_camera_km))
        center_px = self.target.center_px(self.plane.model)
        return apparent_radius_px(self.plane, center_px, self.target.shape.mean_radius_km, range_km)

    def body(self, state: TemplateState) -> Body:
        """Return the target at the place of a state, its attitude in camera axes unchanged."""
        range_km = float(np.linalg.norm(self.target.position_camera_km)) * math.exp(state.log_range)
        return self.target.at(range_km * self.plane.model.unproject(state.center_px))

    def render(self, state: TemplateState, options: RenderOptions) -> Template | Failure:
        """Render a state."""
        return render(
            self.body(state),
            self.plane.model,
            sun_direction_camera=self.sun_direction_camera,
            psf=GaussianPsf(sigma_px=math.sqrt(state.psf_variance_px2)),
            columns=self.plane.columns,
            rows=self.plane.rows,
            options=options,
        )

    def sampling(self, margin_px: int, *, spacing: float = 1.0, min_rays: int = 1) -> RenderOptions:
        """Return options for renders that reach over the frame.

        Parameters
        ----------
        margin_px : int, px
        spacing : float
            Distance between rays over that of ``rays_across``.
        min_rays : int
            Rays along the side of a pixel, at least.

        Returns
        -------
        RenderOptions
        """
        rays_across = self.rays_across / spacing
        rays = math.ceil(rays_across / max(2.0 * self.radius_px, _POINT_PX))
        return RenderOptions(
            rays_per_pixel_side=max(min(rays, _MAX_RAYS_PER_PIXEL_SIDE), min_rays),
            min_rays_across=math.ceil(_NARROW_SIDE * rays_across),
            margin_px=margin_px,
        )

    def box(self, low_px: Float, high_px: Float, margin_px: int) -> PixelBox:
        """Return the box from pixel ``low_px`` (2,) to ``high_px`` (2,) and a margin, limited to what can be fitted."""
        box = PixelBox.spanning(low_px, high_px, margin_px)
        return box.limited(self.plane.columns, self.plane.rows, FIT_BORDER_PX)

    def synthesis(self, box: PixelBox, *, other_law: bool, most_laws: int | None = None) -> Synthesis:
        """Return the function that renders states into a box, optionally under other reflectance laws as well.

        All laws are shaded on the same rays: what differs between two of their images is the law and nothing else. The
        derivatives of small bodies are rendered anew only where the geometry has moved by a pixel, and moved along with
        it up to there.

        Parameters
        ----------
        box : PixelBox
        other_law : bool
        most_laws : int, optional
            Other laws at most; by default as many as a body of that size can show.

        Returns
        -------
        callable
        """
        most = most_laws if self.radius_px >= _SMALL_RADIUS_PX else 1
        others = contrasting_laws(self.target.reflectance)[:most] if other_law else ()
        laws = (self.target.reflectance, *others)
        untried = other_law and self.radius_px >= _SMALL_RADIUS_PX
        latest: list[tuple[TemplateState, Float]] = []

        def images(state: TemplateState, fine: bool) -> TemplateImages | Failure:
            sampling = self.sampling(FIT_BORDER_PX, spacing=self._spacing(fine), min_rays=_FINE_RAYS if fine else 1)
            extra = (_UNTRIED_LAW,) if fine and untried else ()
            lights = self._lights(box, state, laws + extra, sampling)
            if isinstance(lights, Failure):
                return lights
            light, *differing = lights[: len(laws)]
            if self.radius_px >= _SMALL_RADIUS_PX:
                untested = lights[-1] if extra else None
                return TemplateImages(light=light, others=differing, winged=fine, untried=untested)
            if not (latest and self._near(latest[0][0], state)):
                made = self._derivatives(box, state)
                if isinstance(made, Failure):
                    return made
                latest[:] = [(state, made)]
            there, derivatives = latest[0]
            if there is not state:
                derivatives = np.stack([warped(one, box.corner_px, there, state) for one in derivatives])
            return TemplateImages(light=light, others=differing, derivatives=derivatives)

        return images

    def _spacing(self, fine: bool) -> float:
        """Distance between rays over that of ``rays_across``, on the way of a fit or in its last renders."""
        if fine:
            return _FINE if self.radius_px >= _SMALL_RADIUS_PX else 1.0
        return ROUGH if self.radius_px >= _COARSE_RADIUS_PX else 1.0

    def _lights(
        self, box: PixelBox, state: TemplateState, laws: tuple[Reflectance, ...], sampling: RenderOptions
    ) -> list[Float] | Failure:
        """Light (h, w) predicted for a state under each law, on the pixels of a box, all from the same rays."""
        trace = trace_body(
            self.body(state),
            self.plane.model,
            sun_direction_camera=self.sun_direction_camera,
            psf=GaussianPsf(sigma_px=math.sqrt(state.psf_variance_px2)),
            columns=self.plane.columns,
            rows=self.plane.rows,
            options=sampling,
        )
        if isinstance(trace, Failure):
            return trace
        lights = []
        for law in laws:
            template = trace.with_reflectance(law).template()
            if isinstance(template, Failure):
                return template
            lights.append(placed(template, box))
        return lights

    def _derivatives(self, box: PixelBox, state: TemplateState) -> Float | Failure:
        """Derivatives (4, h, w) of the light at a state, from renders to both sides of it."""
        blur = min(_BLUR_STEP_PX2, state.psf_variance_px2)
        derivatives = []
        for number, step in enumerate((_STEP_PX, _STEP_PX, _LOG_RANGE_STEP, blur)):
            sides = []
            for change in (-step, step):
                x, y, log_range, variance = change * np.eye(4)[number]
                there = TemplateState(
                    center_px=state.center_px + np.array([x, y]),
                    log_range=state.log_range + float(log_range),
                    psf_variance_px2=state.psf_variance_px2 + float(variance),
                )
                template = self.render(there, self.sampling(FIT_BORDER_PX))
                if isinstance(template, Failure):
                    return template
                sides.append(placed(template, box))
            derivatives.append((sides[1] - sides[0]) / (2.0 * max(step, 1e-6)))
        return np.stack(derivatives)

    def _near(self, first: TemplateState, second: TemplateState) -> bool:
        """Return True if derivatives can be moved from one state to another."""
        shift_px = float(np.abs(first.center_px - second.center_px).max())
        limb_px = abs(first.log_range - second.log_range) * self.radius_px
        blur_px2 = abs(first.psf_variance_px2 - second.psf_variance_px2)
        return max(shift_px, limb_px) < _NEAR_PX and blur_px2 < _NEAR_BLUR * (0.1 + first.psf_variance_px2)


def contrasting_laws(law: Reflectance) -> tuple[Reflectance, ...]:
    """Return laws that a fit mixes into that of the target, so that a wrong law does not pull the center.

    Parameters
    ----------
    law : Reflectance
        Of the target.

    Returns
    -------
    tuple of Reflectance
        The one that differs most first: Lambert, or Lommel-Seeliger for a target with Lambert's law. A small body shows
        no more than that.
    """
    first: Reflectance = LommelSeeliger() if isinstance(law, Lambert) else Lambert()
    return first, *_OTHER_LAWS


def placed(template: Template, box: PixelBox, shift_px: NDArray[np.int64] | None = None) -> Float:
    """Return the light (h, w) of a template, shifted by whole pixels (2,), in a box; zero around it."""
    x, y = template.corner_px if shift_px is None else template.corner_px + shift_px
    return box.cut(template.brightness, (int(x), int(y)))
