"""Templates for a fit: a body rendered at trial geometries into a fixed box of the image."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.image_model.turn import TURN_SIGMA_RAD
from giantlike.ray_tracing import (
    Body,
    FocalPlane,
    Hapke,
    Lambert,
    LommelSeeliger,
    McEwen,
    Minnaert,
    Reflectance,
    RenderOptions,
    Template,
    render,
)
from giantlike.ray_tracing.air import Black
from giantlike.ray_tracing.cached_trace import Trace, trace_body
from giantlike.ray_tracing.daylight import Daylight
from giantlike.ray_tracing.refined import refine_trace
from giantlike.relative.place import apparent_radius_px
from giantlike.relative.template.haze import haze_laws
from giantlike.relative.template.moved_body import MovedBody, ShadedRays
from giantlike.relative.template.state import FIT_BORDER_PX, Synthesis, TemplateImages, TemplateState
from giantlike.shapes import Ellipsoid

UNKNOWN_BLUR_SIGMA_PX2 = 1.0
"""A priori standard deviation, px^2, of the variance of a point spread function that the camera does not know."""
KNOWN_BLUR_SIGMA_PX2 = 0.15
"""As above, for a declared point spread function: a tenth of a usual width, and the blur by the sampling of renders."""

_TURN_STEP_PX = 0.5  # px, motion of the surface in derivatives by a rotation
_POINT_PX = 1e-3  # px: smaller bodies, and points, take no more rays
_MAX_RAYS_PER_PIXEL_SIDE = 24  # bounds the cost of small bodies; ``min_rays_across`` samples them finely enough
_NARROW_SIDE = 0.5  # ratio of rays over the narrow side of a body to rays across it: few bodies are more elongated
_LIMB_PX, _TURNED_PX = 1.0, (0.006, 0.1)
"""Maximum motion, px, of the limb, and of the surface by a change of perspective (in the last renders and before), up
to which a body is not retraced. Its light moves at most a third as far, a fifth of the noise of small bright bodies."""
_TOLD_PX = 0.5
"""As above, up to which a rough trace shows where a body is lit; its cells also use their neighbors, 1 px away."""
_CUT_PX = 2.0
"""Maximum motion, px, of a body cut by the frame up to which it is not retraced. The trace reaches as far beyond the
frame, in addition to the point spread function."""
_AROUND = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
ROUGH = 2.0  # factor of the distance between rays before the last renders, which alone need fine edges
_PARTS = 2
"""Parts along the side of a cell in the last renders, where light is not uniform. Errors of crescents of 120 px are
0.007
px with it and 0.02 px without, of rocks of 300 px on blocks of 2 px 0.009 and 0.02 px."""
_SMOOTH_PARTS = 3
"""As above, for ellipsoids, whose errors come from the sampling of the limb alone: 0.006 px rms with 3 and 0.010 with 2
in 28 views of 300 px, for a fifth more time. Rocks gain a sixth by it, but are then overconfident."""
_FINE_RAYS = 2  # along the side of a pixel, at least, before uneven ones get more
_COARSE_RADIUS_PX = 20.0  # px, from which renders on the way are rough; smaller bodies are all edge
_OTHER_LAWS: tuple[Reflectance, ...] = (Hapke(w=0.9), Minnaert(k=0.6))
"""Laws mixed in besides the contrasting one: multiple scattering, and a limb brighter than in any mixture of the
others.
For true laws of Hapke (w = 0.3 and 0.8) and Minnaert (k = 0.6) errors are as with the exact law; without these two they
reach 0.4 and 2 px on a body of 200 px."""
_UNTRIED_LAW: Reflectance = Minnaert(k=0.8)
"""Law that is not mixed in; its change of the image measures the error by laws outside of the mixture. Its limb lies
between the others, where sums of laws approximate a power law worst."""
_SMALL_RADIUS_PX = 10.0
"""Radius, px, below which a body has one sampling for all of a fit, and only one other law is mixed in."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateRenderer(Value):
    """Renders a body at trial geometries."""

    target: Body  # at the predicted position
    plane: FocalPlane  # with a point spread function
    sun_direction_camera: Float  # unit vector from body to Sun
    rays_across: int = 240  # rays across the body, about: small bodies get more to a pixel
    airless: bool = False  # True where no residual can be haze

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
        """Return the target at the position of a state, its attitude in camera axes unchanged."""
        range_km = float(np.linalg.norm(self.target.position_camera_km)) * math.exp(state.log_range)
        return self.target.at(range_km * self.plane.model.unproject(state.center_px))

    def sun_across(self, state: TemplateState) -> tuple[float, float, float]:
        """Unit vector from body to Sun, along columns, rows and the line of sight to the body of a state."""
        sight, sun = self.plane.model.unproject(state.center_px), self.sun_direction_camera
        along = float(sun @ sight)
        x, y, _ = (sun - along * sight).tolist()
        return x, y, along

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

    def trace(self, state: TemplateState, options: RenderOptions, daylight: Daylight | None = None) -> Trace | Failure:
        """Trace a state, with fewer rays where a rough trace is all lit or all dark."""
        return trace_body(
            self.body(state),
            self.plane.model,
            sun_direction_camera=self.sun_direction_camera,
            psf=GaussianPsf(sigma_px=math.sqrt(state.psf_variance_px2)),
            columns=self.plane.columns,
            rows=self.plane.rows,
            options=options,
            daylight=daylight,
        )

    def light(self, box: PixelBox, state: TemplateState) -> Float | Failure:
        """Brightness (h, w) in a box."""
        law = self.target.reflectance
        made = self._trace(state, (law,), fine=True, daylight=None)
        return made if isinstance(made, Failure) else made[0].lights(box, state, made[1])[0][0]

    def sampling(self, margin_px: int, *, spacing: float = 1.0, min_rays: int = 1) -> RenderOptions:
        """Return options for renders that reach over the frame.

        ``spacing``: distance between rays over that of ``rays_across``.
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
        return box.clip(self.plane.columns, self.plane.rows, FIT_BORDER_PX)

    def synthesis(
        self, box: PixelBox, *, other_law: bool, most_laws: int | None = None, traced: MovedBody | None = None
    ) -> Synthesis:
        """Return the function that renders states into a box, optionally under other reflectance laws as well.

        All laws are shaded on the same rays, so that their images differ by the law alone. Under air, one of the others
        is black ground, which leaves the light of the air; it is mixed in from the first. The body is traced once
        roughly and once finely, and again only where the perspective changes. The change of brightness with the phase
        angle over the disk is mixed in last, in fine renders.
        """
        small = self.radius_px < _SMALL_RADIUS_PX
        air, shape = self.target.air, self.target.shape
        smooth = isinstance(shape, Ellipsoid) and shape.albedo is None
        airy = not self.airless and air is None and isinstance(shape, Ellipsoid)
        others = contrasting_laws(self.target.reflectance)[: 1 if small else most_laws] if other_law else ()
        if other_law and air is not None:
            others = (*others[:1], Black(), *others[1:])
        laws = (self.target.reflectance, *others)
        every = (*laws, _law_of_phase(laws[0])) if other_law and most_laws is None and not small else laws
        # Rough renders exclude them: without the field of markings, which fine renders allow, shares would diverge.
        few = laws[: 2 if air is None else 3]
        kept: dict[bool, tuple[MovedBody, ShadedRays]] = {}
        if traced is not None:
            kept[False] = traced, traced.shade(few)

        def images(state: TemplateState, fine: bool) -> TemplateImages | Failure:
            fine = fine and not small
            untried, mixed = fine and other_law, every if fine else few
            if fine not in kept or not self._near(kept[fine][0].state, state, fine=fine or small):
                known = self._daylight(kept[False][0], state) if False in kept and not small else None
                made = self._trace(state, (*mixed, _UNTRIED_LAW) if untried else mixed, fine=fine, daylight=known)
                if isinstance(made, Failure):
                    return made
                kept[fine] = made
            body, rays = kept[fine]
            lights, derivatives = body.lights(box, state, rays)

            def render_veil() -> Float:
                return body.lights(box, state, body.shade(haze_laws(laws[0])))[0]

            return TemplateImages(
                light=lights[0],
                others=list(lights[1 : len(mixed)]),
                winged=fine,
                untried=lights[-1] if untried else None,
                veiled=render_veil if untried and airy else None,
                turned=None if smooth or not untried else lambda: self._turns(box, state),
                derivatives=derivatives,
            )

        return images

    def _trace(
        self, state: TemplateState, laws: tuple[Reflectance, ...], *, fine: bool, daylight: Daylight | None
    ) -> tuple[MovedBody, ShadedRays] | Failure:
        """Trace the body at a state, and shade it under some laws."""
        radius_px = self.radius_px
        margin_px = FIT_BORDER_PX + (math.ceil(2.0 * radius_px) if radius_px < _SMALL_RADIUS_PX else 0)
        rough = not fine and radius_px >= _COARSE_RADIUS_PX
        sampling = self.sampling(margin_px, spacing=ROUGH if rough else 1.0, min_rays=_FINE_RAYS if fine else 1)
        trace = self.trace(state, sampling, daylight)
        if isinstance(trace, Failure):
            return trace
        if not trace.lit:
            return Failure(Reason.NOT_LIT, "no part of the body that the camera sees is lit by the Sun")
        parts = _SMOOTH_PARTS if isinstance(self.target.shape, Ellipsoid) else _PARTS
        body = MovedBody(trace=refine_trace(trace, parts) if fine else trace, state=state)
        return body, body.shade(laws)

    def _turns(self, box: PixelBox, state: TemplateState) -> Float:
        """Derivatives (3, h, w) of the light by a rotation of the body about the camera axes; zero where unseen."""
        step_rad = min(_TURN_STEP_PX / self.radius_px, TURN_SIGMA_RAD)
        turns = [Rotation.from_rotvec(step_rad * axis) for axis in (np.zeros(3), *np.eye(3))]
        bodies = [replace(self.target, camera_from_body=turn * self.target.camera_from_body) for turn in turns]
        light, *turned = (replace(self, target=body).light(box, state) for body in bodies)
        if isinstance(light, Failure):
            return np.zeros((3, box.height, box.width))
        return np.stack(
            [np.zeros_like(light) if isinstance(each, Failure) else (each - light) / step_rad for each in turned]
        )

    def _daylight(self, rough: MovedBody, state: TemplateState) -> Daylight | None:
        """Light and dark parts of the body at a state; None where the perspective of a rough trace differs."""
        return rough.daylight(state) if self._turned_px(rough.state, state) < _TOLD_PX else None

    def _turned_px(self, first: TemplateState, second: TemplateState) -> float:
        """Motion, px, of the surface between two states by the change of perspective."""
        sights = self.plane.model.unproject(np.stack([first.center_px, second.center_px]))
        return float(np.linalg.norm(sights[1] - sights[0])) * self.radius_px

    def _near(self, first: TemplateState, second: TemplateState, *, fine: bool) -> bool:
        """Return True if the rays of a state can be reused for another: the same surface in the same perspective."""
        size, radius_px = np.array([self.plane.columns, self.plane.rows]), self.radius_px
        growth = first.log_range - second.log_range
        ends = np.clip(first.center_px + radius_px * _AROUND, 0.0, size - 1.0) - first.center_px
        moved_px = float(np.abs(second.center_px - first.center_px + growth * ends).max())
        past_px = float(np.max(np.abs(first.center_px - 0.5 * (size - 1)) + radius_px - 0.5 * size))
        turned_px = self._turned_px(first, second)
        untraced = past_px > 0.0 and moved_px > _CUT_PX
        return not untraced and abs(growth) * radius_px < _LIMB_PX and turned_px < _TURNED_PX[not fine]


def contrasting_laws(law: Reflectance) -> tuple[Reflectance, ...]:
    """Return laws that a fit mixes into the law of the target, so that a wrong law does not bias the center."""
    first: Reflectance = LommelSeeliger() if isinstance(law, Lambert) else Lambert()
    return first, *_OTHER_LAWS


def _law_of_phase(law: Reflectance) -> Reflectance:
    """Return the law that models in a mixture the change of brightness with the phase angle over the disk.

    McEwen's law changes from Lommel and Seeliger's to Lambert's as the phase angle grows, by 0.5 % over a disk of 1.4
    degrees. With all three in the mixture the prior limits that change to 0 to 2 times McEwen's. With a free slope over
    the phase angle, a Moon seen through a wide lens had an error of 0.28 px with a formal sigma of 0.006 px.
    """
    return LommelSeeliger() if isinstance(law, McEwen) else McEwen()


def place_template(template: Template, box: PixelBox, shift_px: NDArray[np.int64] | None = None) -> Float:
    """Return the light (h, w) of a template, shifted by whole pixels (2,), in a box; zero around it."""
    x, y = template.corner_px if shift_px is None else template.corner_px + shift_px
    return box.cut(template.brightness, (int(x), int(y)))
