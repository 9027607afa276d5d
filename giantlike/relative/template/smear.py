"""Images smeared along one direction: a camera that turned, or a body that moved, while the shutter was open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.findings import Smear
from giantlike.core.outcomes import Failure
from giantlike.relative.template.state import Synthesis, TemplateImages, TemplateState

_STEP = 0.05
"""Relative step of numerical derivatives by the variances: beyond a tenth the fall of light along a line bends."""


def smeared_renders(synthesize: Synthesis) -> Synthesis:
    """Return a function that renders a body with the smear of its state."""

    def images(state: TemplateState, fine: bool) -> TemplateImages | Failure:
        made, smear = synthesize(state, fine), state.smear
        if isinstance(made, Failure) or smear is None:
            return made
        seen = [made.light, *made.others, *([] if made.untried is None else [made.untried])]
        light, *rest = smear.blur(np.stack(seen))
        others, last = rest[: len(made.others)], rest[len(made.others) :]
        sharp, veiled, turned = made.derivatives, made.veiled, made.turned
        return replace(
            made,
            light=light,
            others=others,
            untried=last[0] if last else None,
            veiled=None if veiled is None else lambda: smear.blur(veiled()),
            turned=None if turned is None else lambda: smear.blur(turned()),
            derivatives=None if sharp is None else lambda weights: smear.blur(sharp(weights)),
            by_smear=_changes(smear, made.light),
        )

    return images


def _changes(smear: Smear, image: Float) -> Float:
    """Derivatives (2, h, w) of an image (h, w), smeared, by both variances, from central differences."""
    step = _STEP * max(smear.size_px2, _STEP)
    high_x, low_x, high_y, low_y = (
        replace(smear, straight_px2=smear.straight_px2 + x, oblique_px2=smear.oblique_px2 + y).blur(image)
        for x, y in ((step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step))
    )
    return np.stack([high_x - low_x, high_y - low_y]) / (2.0 * step)
