"""Haze that nobody told of, as the face of a body shows it behind a fix of its limb, and the altitude to expect."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from giantlike.atmosphere import Atmosphere
from giantlike.core.arrays import Float
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX
from giantlike.core.outcomes import CenterFix, Failure
from giantlike.ray_tracing import Trace
from giantlike.relative.quality import MISFIT, UNEXPLAINED
from giantlike.relative.template.haze import HAZE, VEIL_DEPTH, haze_laws
from giantlike.relative.verification.cells import Cells
from giantlike.relative.verification.coarse_fit import CoarseFit
from giantlike.relative.verification.proportion import Looked
from giantlike.shapes import Ellipsoid

if TYPE_CHECKING:
    from giantlike.relative.estimator import EstimatorInputs

LIMB_BLUR = "limb_blur_px2"
"""Key of the provenance of fixes from limbs: the variance of their blur beyond that of the camera, px^2."""
_BRIGHTNESS = (0.0, 0.5, 2.0)
"""Light that haze sends, over that of ground lit and seen along its normal: of dark to bright haze."""
_HAZY_SIGMAS = 3.5
"""Share of haze in the light over its standard deviation from which on there is haze: 4.2 to 11 with a depth of 0.05
and more around bodies of 120 and 300 px, and of 104 fixes without haze (``benchmarks/stress.md``) 4 have more and a
limb that is blurred."""
_OPTICS = 0.05
"""How well the width of the optics is known, relative: a blur within it may be haze too. As of the limb's lines."""

AnyFix = TypeVar("AnyFix", bound=CenterFix)
Coarse = TypeVar("Coarse", bound=Looked)


def veils(cells: Cells, trace: Trace, fix: CenterFix, inputs: EstimatorInputs) -> Float | None:
    """Images of what haze changes in the light of a body, to ask residuals about.

    Parameters
    ----------
    cells : Cells
    trace : Trace
        Of the body where it was found.
    fix : CenterFix or PositionFix
    inputs : EstimatorInputs

    Returns
    -------
    (3, n, n) float64 or None
        Of haze that is dark to bright. None where there is nothing to ask: the altitude of the limb is told, no limb
        was measured, or it is as sharp as the camera, which no limb in haze is.
    """
    target, blur = inputs.geometry.target, _limb_blur(fix)
    told = target.atmosphere is not None or target.terrain is not None
    if told or blur is None or not blur > 0.0 or not isinstance(target.shape, Ellipsoid):
        return None
    taken, sent = (cells.light(trace.with_reflectance(law)) for law in haze_laws(target.reflectance)[:2])
    return np.stack([brightness * sent - taken for brightness in _BRIGHTNESS])


def in_haze(
    fix: AnyFix,
    coarse: Coarse,
    inputs: EstimatorInputs,
    again: Callable[[EstimatorInputs], AnyFix | Failure],
    look: Callable[[AnyFix, EstimatorInputs], Coarse | None],
) -> tuple[AnyFix, Coarse, EstimatorInputs] | None:
    """Make a fix of a limb again with an altitude that is not known, where the face of the body shows haze.

    Parameters
    ----------
    fix : CenterFix or PositionFix
    coarse : Looked
        What the coarse render shows of it.
    inputs : EstimatorInputs
        Of the estimator.
    again : callable
        Runs the estimator on other inputs.
    look : callable
        Renders a fix coarsely where it lies.

    Returns
    -------
    (CenterFix or PositionFix, Looked, EstimatorInputs) or None
        The fix, its coarse render and its inputs; None where no haze is seen.
    """
    blur = _limb_blur(fix)
    depth = 0.0 if coarse.fit is None else haze_depth(coarse.fit)
    if blur is None or depth == 0.0:
        return None
    geometry = inputs.geometry
    blur_px2 = blur + 2.0 * _OPTICS * (inputs.psf_sigma_px or UNKNOWN_PSF_SIGMA_PX) ** 2
    sigma_px = haze_altitude_px(depth, blur_px2, inputs.radius_px)
    sigma_km = sigma_px / inputs.radius_px * geometry.target.shape.mean_radius_km
    haze = Atmosphere.at(0.0, sigma_km=sigma_km)
    hazy = replace(
        inputs,
        geometry=replace(geometry, target=replace(geometry.target, atmosphere=haze)),
        provenance={**inputs.provenance, HAZE: f"{sigma_km:.6g}"},
    )
    found = again(hazy)
    seen = None if isinstance(found, Failure) else look(found, hazy)
    return None if isinstance(found, Failure) or seen is None else (found, seen, hazy)


def haze_depth(fit: CoarseFit) -> float:
    """Vertical optical depth of the haze that a coarse fit shows; 0 where it shows none, or light of something else.

    Parameters
    ----------
    fit : CoarseFit

    Returns
    -------
    float
    """
    if not len(fit.asked) or fit.misfit > MISFIT or fit.unexplained > UNEXPLAINED:
        return 0.0
    sigmas = fit.asked / np.maximum(fit.asked_sigma, 1e-300)
    clearest = int(np.argmax(sigmas))
    return VEIL_DEPTH * float(fit.asked[clearest]) if sigmas[clearest] > _HAZY_SIGMAS else 0.0


def haze_altitude_px(depth: float, blur_px2: float, radius_px: float) -> float:
    """Altitude at which a limb is seen in haze of some depth that blurs it by as much as is not explained otherwise.

    Parameters
    ----------
    depth : float
        Vertical optical depth.
    blur_px2 : float, px^2
    radius_px : float, px

    Returns
    -------
    float, px
    """
    unit = Atmosphere(scale_height_km=1.0, optical_depth=depth, sigma_km=0.0)
    height_px = math.sqrt(blur_px2) / unit.limb_width_km
    return replace(unit, scale_height_km=height_px).limb_altitude_km(radius_px)


def _limb_blur(fix: CenterFix) -> float | None:
    """Variance of the blur of a limb beyond that of the camera, px^2; None of other fixes."""
    told = fix.provenance.get(LIMB_BLUR)
    return None if told is None else float(told)
