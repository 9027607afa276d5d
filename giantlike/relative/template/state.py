"""States and images of a template: its geometry, its renders, and motion of an image."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.findings import Smear
from giantlike.core.outcomes import Failure
from giantlike.core.values import Value

FIT_BORDER_PX = 4  # pixels over the frame that a fitted box should reach: derivatives take that many neighbors


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateState(Value):
    """Geometry and blur that a template is rendered for."""

    center_px: Float  # center of the body in the image
    log_range: float = 0.0  # natural logarithm of the range over the a priori range
    psf_variance_px2: float
    smear: Smear | None = None  # motion of the body in the image during the exposure


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TemplateImages(Value):
    """A body rendered into the box that is fitted.

    untried: (h, w); brightness under a law that the fit does not mix in; its effect enters the covariance.
    veiled: returns the brightness (3, h, w) under the laws of :func:`~giantlike.relative.template.haze.haze_laws`.
    turned: returns the derivatives (3, h, w) of ``light`` by a rotation of the body about the camera axes, per rad;
        None of an ellipsoid without markings, whose image hardly changes.
    derivatives: takes weights (1 + k,) and returns the derivatives (4, h, w) of the sum of ``light`` and ``others``
        with these, by x and y of the center in px, the logarithm of the range and the variance of the point spread
        function in px^2; None takes them from differences of pixels. Those are off by a tenth where an image is as
        sharp as a point spread function. With such errors shift, range, blur and law, which do nearly the same to the
        image of a small body, seem to be distinguishable, and steps on coarse pixels end beside the solution.
    by_smear: (2, h, w); derivatives of ``light`` by the two variances of the motion that smears it, per px^2; None
        where none does.
    """

    light: Float  # (h, w); brightness under the reflectance law of the target
    others: Sequence[Float] = ()  # (k, h, w); brightness under k other laws, which the fit may mix in; none by default
    winged: bool = False  # estimate the share of the light that lies in wings of the point spread function
    untried: Float | None = None
    veiled: Callable[[], Float] | None = None
    turned: Callable[[], Float] | None = None
    derivatives: Callable[[Float], Float] | None = None
    by_smear: Float | None = None


Synthesis = Callable[[TemplateState, bool], TemplateImages | Failure]
"""Renders the body for a state into the fitted box; finely (True) at the end of the fit, roughly on the way."""


def warp(light: Float, corner_px: tuple[int, int], rendered: TemplateState, to: TemplateState) -> Float:
    """Move and scale a template to another state within the same box.

    ``light`` (h, w); ``corner_px``: column and row of its first element; returns (h, w).
    """
    scale = math.exp(to.log_range - rendered.log_range)
    corner = np.asarray(corner_px, dtype=np.float64)
    shift = rendered.center_px - corner - scale * (to.center_px - corner)
    matrix = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    size = (light.shape[1], light.shape[0])
    return np.asarray(cv2.warpAffine(light, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.float64)
