"""Alignment: a rough start of a fit is improved by moving and scaling one render, on images reduced in size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.blocks import block_sums
from giantlike.core.pixel_box import BoxPixels
from giantlike.relative.template.linear import LinearProblem
from giantlike.relative.template.state import TemplateImages, TemplateState, warp

_RADII_PX = (12.0, 40.0)
"""Radii, px, of the body in the reduced images: errors of half of it are still found, then refined."""
_STEPS = 5  # in each reduced image; the best state on the way is taken
_STEP_PX = 2.0  # px of the reduced image: the reach of its slopes after _BLUR_PX
_STILL_PX = 0.02  # px of the reduced image: shorter steps end the alignment, whose result the fit moves by more
_BLUR_PX = 0.6  # px of the reduced image: block means alias without it
_WARPED_OVER = 4  # pixels averaged after an image was moved: the errors of the interpolation average with them


def align_template(
    pixels: BoxPixels, lights: Sequence[Float], rendered: TemplateState, start: TemplateState, *, radius_px: float
) -> TemplateState:
    """Improve a rough start from one render by moving and scaling it, on images reduced in size and then less so.

    ``lights`` (k, h, w).
    """
    state = start
    for radius in _RADII_PX:
        factor = max(round(radius_px / radius), 1)
        last = min(factor, _WARPED_OVER)  # part of the reduction comes before the light is moved, part hides that
        first = round(factor / last)
        factor = first * last
        known = pixels.usable if pixels.censored is None else pixels.usable | pixels.censored
        share = _mean_over(known.astype(np.float64), factor)
        summed = _mean_over(np.where(known, pixels.values_dn, 0.0), factor)
        limits = None if pixels.censored is None else _mean_over(pixels.censored.astype(np.float64), factor) > 0.0
        small = BoxPixels(
            values_dn=_soften(summed) / np.maximum(_soften(share), 1e-6),
            usable=(share > 0.5) if limits is None else (share > 0.5) & ~limits,
            censored=limits,
            corner_px=(0, 0),
            noise_variance_dn2=pixels.noise_variance_dn2,
        )
        parts = [_mean_over(light, first) for light in lights]
        tried: list[tuple[float, TemplateState]] = []
        for _ in range(_STEPS):
            ends = _reduce_state(rendered, pixels.corner_px, first), _reduce_state(state, pixels.corner_px, first)
            rows, columns = small.usable.shape
            moved = [_soften(_mean_over(warp(part, (0, 0), *ends), last))[:rows, :columns] for part in parts]
            if not float(moved[0].sum()) > 0.0:
                break
            images = TemplateImages(light=moved[0], others=moved[1:])
            problem = LinearProblem(small, images, _reduce_state(state, pixels.corner_px, factor), None)
            tried.append((problem.misfit_dn2(), state))
            step = problem.plain_step(_STEP_PX)
            if problem.motion_px(step) < _STILL_PX:
                break
            x, y, growth = step.tolist()
            center_px = state.center_px + factor * np.array([x, y])
            state = replace(state, center_px=center_px, log_range=state.log_range + growth)
        if not tried:
            return start
        state = min(tried, key=lambda entry: entry[0])[1]
    return state


def _reduce_state(state: TemplateState, corner_px: tuple[int, int], factor: int) -> TemplateState:
    """Return a state in the pixels of a box that was reduced in size."""
    center = (state.center_px - corner_px + 0.5) / factor - 0.5
    return replace(state, center_px=center, psf_variance_px2=_BLUR_PX**2)


def _mean_over(image: Float, factor: int) -> Float:
    """Mean over squares of ``factor`` pixels; what does not fill a square at the end is left out."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    if height == 0 or width == 0:
        return np.zeros((1, 1))
    return block_sums(image, factor) / factor**2


def _soften(image: Float) -> Float:
    """An image blurred a little, so that its slopes can be taken."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _BLUR_PX, borderType=cv2.BORDER_REPLICATE), np.float64)
