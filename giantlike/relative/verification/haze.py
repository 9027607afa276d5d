"""Haze that nobody told of, as the face of a body shows it behind a fix of its limb, and the altitude to expect."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from giantlike.atmosphere import Atmosphere
from giantlike.core.arrays import Float
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX
from giantlike.core.findings import Corrections
from giantlike.core.outcomes import CenterFix, Failure
from giantlike.ray_tracing import Trace
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.template.haze import VEIL_DEPTH, haze_laws
from giantlike.relative.verification.cells import Cells
from giantlike.relative.verification.coarse_fit import CoarseFit
from giantlike.relative.verification.proportion import Looked
from giantlike.shapes import Ellipsoid

HAZE_CELLS_PER_RADIUS = 60
"""Cells to a radius of the body in which haze is looked for, as far as pixels are not larger. Of crescents of 120 px
(125 degrees) with a depth of 0.05 shares come to 2 to 8 sigmas in cells of 3 px and to 7 to 9 in cells of 1 px, of
right bodies whose point spread function is told 30 % narrow to 6 and to 1.5."""
_BRIGHTNESS = (0.0, 0.5, 2.0)
"""Light that haze sends, over that of ground lit and seen along its normal: of dark to bright haze."""
_DEPTHS = (VEIL_DEPTH, 0.3)
"""Vertical optical depths of the haze that is looked for; others are shares of it."""
_HINT_SIGMAS, _HAZY_SIGMAS = 1.0, 2.5
"""Share of haze in the light over its standard deviation from which on finer cells are looked at, and from which on
there is haze in these: 4.0 to 14 with a depth of 0.05 and more around bodies of 120 px (2.2 to 9 around 60 px), 1.8 to
4.4 with a depth of 0.02; wrong laws and widths come to 1.8. With 3 squared errors at 60 px are 5 times the covariance
of horizons, not 0.9 (views 220 to 227)."""
_HINT_BLUR, _HINT_DEPTH = 0.2, 0.035
"""Blur of a limb over what is not known of the optics, and depth of haze as coarse cells ask for it: finer cells are
looked at where either is exceeded. In haze of 0.3 px of scale height and a depth of 0.05 the blur is 0.9 to 2.3 around
120 px, 0.5 to 1.5 around 60, of exact bodies 0.16 at most, and their depth 0.033 (32 fixes). Of 96 fixes of bodies of
30 to 300 px without haze 3 are looked at finely, with the hint of one sigma alone two thirds. Haze that hardly blurs
shows where it is thick; with 0.4 and 0.04 limbs in haze of a depth of 0.02 go from 1.5 to 6.2 times their covariance
(views 220 to 227).
"""
_LEAST_EXPLAINED = 0.25
"""Of the squared residuals that noise does not explain, those that haze does: 0.2 to all of them in haze (120 px). With
relief and markings 3 of 15 fixes beyond 3 sigmas have 0.2 or more, 0.34 at most."""
_OF_ALTITUDE = 0.5
"""Standard deviation of the altitude over the one at which a sharp edge would be seen in such haze. Squared errors of
``limb_matching`` and ``ellipsoid_cra`` in haze of a depth of 0.05 to 0.3 (views 400 to 419) come to 0.5 to 2.5 of the
covariance with it, to 0.2 to 0.6 with all of the altitude: laws and free brightness of the limb take part of it."""
_OPTICS = 0.05
"""How well the width of the optics is known, relative: a blur within it may be haze too. As of the limb's lines."""

AnyFix = TypeVar("AnyFix", bound=CenterFix)
Coarse = TypeVar("Coarse", bound=Looked)


def may_be_hazy(fix: CenterFix, inputs: EstimatorInputs) -> bool:
    """Return True for fixes behind which haze is looked for."""
    target, blur = inputs.geometry.target, fix.corrections.limb_blur_px2
    told = target.airless or target.atmosphere is not None or target.terrain is not None
    return not told and blur is not None and blur > -_optics_px2(inputs) and isinstance(target.shape, Ellipsoid)


def veils(cells: Cells, trace: Trace) -> Float:
    """Images of what haze changes in the light of a body, to ask residuals about.

    Returns (6, n, n), of thin haze that is dark to bright, and of thick.
    """
    images = []
    for depth in _DEPTHS:
        taken, sent = (
            cells.light(trace.with_reflectance(law)) for law in haze_laws(trace.body.reflectance, depth=depth)[:2]
        )
        images += [brightness * sent - taken for brightness in _BRIGHTNESS]
    return np.stack(images)


def in_haze(
    fix: AnyFix,
    fine: Looked | None,
    inputs: EstimatorInputs,
    again: Callable[[EstimatorInputs], AnyFix | Failure],
    look: Callable[[AnyFix, EstimatorInputs], Coarse | None],
) -> tuple[AnyFix, Coarse, EstimatorInputs] | None:
    """Make a fix of a limb again with an altitude that is not known, where the face of the body shows haze.

    Returns None where no haze is seen.
    """
    blur = fix.corrections.limb_blur_px2
    depth = 0.0 if fine is None or fine.fit is None else haze_depth(fine.fit)
    if blur is None or depth == 0.0:
        return None
    geometry = inputs.geometry
    blur_px2 = math.hypot(max(blur, 0.0), _optics_px2(inputs))
    sigma_px = _OF_ALTITUDE * haze_altitude_px(depth, blur_px2, inputs.radius_px)
    sigma_km = sigma_px / inputs.radius_px * geometry.target.shape.mean_radius_km
    haze = Atmosphere.at(0.0, sigma_km=sigma_km)
    hazy = replace(
        inputs,
        geometry=replace(geometry, target=replace(geometry.target, atmosphere=haze)),
        corrections=inputs.corrections | Corrections(altitude_sigma_km=sigma_km),
    )
    found = again(hazy)
    seen = None if isinstance(found, Failure) else look(found, hazy)
    return None if isinstance(found, Failure) or seen is None else (found, seen, hazy)


def hint_of_haze(fix: CenterFix, fit: CoarseFit | None, inputs: EstimatorInputs) -> bool:
    """Return True where cells of a face ask for some haze, so that finer ones are worth their cost."""
    blur = fix.corrections.limb_blur_px2
    if fit is None or blur is None or not np.any(_sigmas(fit) > _HINT_SIGMAS):
        return False
    return blur > _HINT_BLUR * _optics_px2(inputs) or _clearest_depth(fit, _sigmas(fit)) > _HINT_DEPTH


def haze_depth(fit: CoarseFit) -> float:
    """Vertical optical depth of the haze that a fit in fine cells shows; 0 where it shows none, or something else."""
    sigmas = np.where(fit.omitted.explains > _LEAST_EXPLAINED, _sigmas(fit), 0.0)
    if not np.any(sigmas > _HAZY_SIGMAS):
        return 0.0
    return _clearest_depth(fit, sigmas)


def _clearest_depth(fit: CoarseFit, sigmas: Float) -> float:
    """Depth of the haze whose share has the most ``sigmas`` (6,)."""
    clearest = int(np.argmax(sigmas))
    return _DEPTHS[clearest // len(_BRIGHTNESS)] * float(fit.omitted.values[clearest])


def _sigmas(fit: CoarseFit) -> Float:
    """Shares of haze over their standard deviations."""
    return np.asarray(fit.omitted.values / np.maximum(fit.omitted.sigma, 1e-300))


def haze_altitude_px(depth: float, blur_px2: float, radius_px: float) -> float:
    """Altitude at which a limb is seen in haze of some depth that blurs it by as much as is not explained otherwise."""
    unit = Atmosphere(scale_height_km=1.0, optical_depth=depth, sigma_km=0.0)
    height_px = math.sqrt(blur_px2) / unit.limb_width_km
    return replace(unit, scale_height_km=height_px).limb_altitude_km(radius_px)


def _optics_px2(inputs: EstimatorInputs) -> float:
    """Standard deviation of the variance of the point spread function, px^2."""
    return 2.0 * _OPTICS * (inputs.psf_sigma_px or UNKNOWN_PSF_SIGMA_PX) ** 2
