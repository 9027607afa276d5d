"""Several bodies in one image: they hide each other and cast shadows on each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_floats
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body, suns_of
from giantlike.ray_tracing.footprint import FocalPlane
from giantlike.ray_tracing.neighbors import neighbors_of
from giantlike.ray_tracing.options import DEFAULT_OPTIONS, RenderOptions
from giantlike.ray_tracing.render import rendered
from giantlike.ray_tracing.shade import Template


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneRender(Value):
    """Several bodies, rendered.

    Parameters
    ----------
    columns, rows : int, px
        Size of the frame.
    templates : tuple of Template or Failure
        One for each body, in the order they were given: what is seen of it, shadows of the others in. A body that
        is seen but wholly in the dark is a black template with a NaN photocenter, not a failure.
        Failures: ``OUT_OF_FRAME``, ``NO_SIGNAL`` for a body behind others, and ``DEGENERATE_GEOMETRY`` for one around
        the camera, which hides nothing.
    """

    columns: int
    rows: int
    templates: tuple[Template | Failure, ...]

    @property
    def brightness(self) -> Float:
        """Sum of all bodies in the whole frame (rows, columns), relative: 1 is a surface lit and seen along its normal.

        It is computed at each access.
        """
        return self.weighted(np.ones(len(self.templates)))

    def weighted(self, weights: ArrayLike) -> Float:
        """Return the sum of all bodies, each times its own weight: irradiance, say, or albedo.

        Parameters
        ----------
        weights : (n,)

        Returns
        -------
        (rows, columns) float64
        """
        factors = as_floats(weights, (len(self.templates),), "weights")
        frame = np.zeros((self.rows, self.columns))
        for factor, template in zip(factors, self.templates, strict=True):
            if isinstance(template, Template):
                frame += factor * template.placed(self.columns, self.rows)
        return frame

    def coverage(self, number: int) -> Float:
        """Return the fraction of each pixel of the frame that a body covers, others before it cut out.

        Parameters
        ----------
        number : int
            Of the body, in the order they were given.

        Returns
        -------
        (rows, columns) float64
        """
        template = self.templates[number]
        if isinstance(template, Failure):
            return np.zeros((self.rows, self.columns))
        return replace(template, brightness=template.coverage).placed(self.columns, self.rows)


def render_scene(
    bodies: Sequence[Body],
    model: CameraModel,
    *,
    sun_direction_camera: ArrayLike,
    psf: GaussianPsf | None = None,
    columns: int,
    rows: int,
    options: RenderOptions = DEFAULT_OPTIONS,
) -> SceneRender:
    """Render bodies that hide each other and shade each other.

    Parameters
    ----------
    bodies : sequence of Body
        In any order, none inside another.
    model : CameraModel
    sun_direction_camera : (3,) or (n, 3), unitless, camera axes
        Unit vector to the Sun, for all bodies or for each.
    psf : GaussianPsf, optional
    columns, rows : int, px
    options : RenderOptions
        For every body; each is sampled as finely as its size in the image asks for.

    Returns
    -------
    SceneRender
        Always; a body that is not seen is a ``Failure`` in its ``templates``. The Sun shines on all bodies alike:
        differences in distance are the caller's ``weights``.

    Raises
    ------
    InputError
        A size is not positive, or a direction is not a unit vector or not one for each body.

    Notes
    -----
    Every body is rendered as :func:`~giantlike.ray_tracing.render` does, but rays that meet another body first are
    dropped, and shadow rays are tested against all bodies. Light that one body casts on another is left out.
    """
    plane = FocalPlane(model=model, columns=columns, rows=rows, psf=psf)
    bodies = [body.seen_by(model) for body in bodies]
    templates = tuple(
        rendered(body, plane, sun, options, tuple(neighbors_of(bodies, number, sun, options.sun_radius_rad)))
        for number, (body, sun) in enumerate(zip(bodies, suns_of(bodies, sun_direction_camera), strict=True))
    )
    return SceneRender(columns=columns, rows=rows, templates=templates)
