"""Wings of the point spread function: the light that a body has around it, measured in the image."""

from __future__ import annotations

import math

import cv2
import numpy as np

from giantlike.core.arrays import Float
from giantlike.ray_tracing import Template
from giantlike.relative.light.law_mixture import LawMixture
from giantlike.relative.light.separation import SeparatedLight

WING_UNKNOWN = 0.5
"""Share of the effect of the wings that is one sigma: wings half or twice as wide change it by a third to a half."""
_WIDTHS = 5.0  # ratio of the widths of wings and core; scattered light of real optics follows a power law instead
_DARK = 1e-4  # share of the brightest pixel below which a template without wings has no light
_BRIGHT = 0.5  # share of the brightest light of the wings there that pixels need to be looked at
_LIMB, _LIMB_PX = 0.02, 1
"""Margin around the light of the core, of the radius and px: errors of the range and of the width of the core."""
_LEAST_PX, _LEAST_SIGMAS = 50, 5.0
"""Pixels that are needed, and standard errors of the share below which there are no wings."""


def wing_share(light: SeparatedLight, template: Template, *, psf_sigma_px: float, radius_px: float) -> float:
    """Share of the light of a body that lies in wings of the point spread function.

    Returns 0 where the sky around the body shows none.
    """
    expected = light.expected_dn(template.brightness)
    wings = _blur(expected, _WIDTHS * psf_sigma_px)
    margin = _LIMB_PX + math.ceil(_LIMB * radius_px)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    lit = cv2.dilate((expected > _DARK * float(expected.max())).astype(np.uint8), disk) > 0
    rows, columns = np.nonzero(~lit & (wings > _BRIGHT * float(wings[~lit].max(initial=0.0))))
    places = np.stack([columns, rows], axis=1) + template.corner_px + light.shift_px
    inside = ((places >= 0) & (places < light.region.shape[::-1])).all(axis=1)
    if np.count_nonzero(inside) < _LEAST_PX:
        return 0.0
    x, y = places[inside].T
    model = wings[rows[inside], columns[inside]]
    share = float(np.median(light.signal_dn[y, x] / model))
    error = 1.2533 * light.sky.sigma_dn / float(model.mean()) / math.sqrt(len(model))  # of a median
    return min(share, 0.5) if share > _LEAST_SIGMAS * error else 0.0


def with_wings(laws: LawMixture, share: float, psf_sigma_px: float) -> LawMixture:
    """Return the body with a share of its light in wings."""

    def spread(brightness: Float) -> Float:
        return (1.0 - share) * brightness + share * _blur(brightness, _WIDTHS * psf_sigma_px)

    return laws.map_images(spread)


def _blur(image: Float, sigma_px: float) -> Float:
    """Blur an image (h, w) by a round Gaussian; black outside."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_CONSTANT), dtype=np.float64)
