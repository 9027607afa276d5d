"""Test of a limb fix for undeclared haze from the disk interior, and the limb altitude that haze implies."""

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
from giantlike.ray_tracing.cached_trace import Trace
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.template.haze import VEIL_DEPTH, haze_laws
from giantlike.relative.verification.cells import Cells
from giantlike.relative.verification.coarse_fit import CoarseFit
from giantlike.relative.verification.proportion import Looked
from giantlike.shapes import Ellipsoid

HAZE_CELLS_PER_RADIUS = 60
"""Cells per radius in which haze is tested for; cells are not smaller than pixels. On crescents of 120 px (125 degrees)
with a depth of 0.05 the share of haze is 2 to 8 sigmas in cells of 3 px and 7 to 9 in cells of 1 px; without haze, with
a point spread function declared 30 % too narrow, 6 and 1.5."""
_BRIGHTNESS = (0.0, 0.5, 2.0)
"""Ratio of the light scattered by haze to that of ground lit and seen along its normal: dark to bright haze."""
_DEPTHS = (VEIL_DEPTH, 0.3)  # vertical optical depths of the haze templates; other depths are scaled from these
_HINT_SIGMAS, _HAZY_SIGMAS = 1.0, 2.5
"""Significance of the share of haze, in standard deviations, above which finer cells are tested, and above which these
show haze. Measured: 4.0 to 14 with depths from 0.05 around bodies of 120 px (2.2 to 9 around 60 px), 1.8 to 4.4 with a
depth of 0.02, up to 1.8 with wrong laws and widths. With 3, squared errors of horizons at 60 px are 5 times the
covariance, not 0.9 (views 220 to 227)."""
_HINT_BLUR, _HINT_DEPTH = 0.2, 0.035
"""Ratio of the blur of a limb to the uncertainty of the optics, and depth of haze estimated in coarse cells: finer
cells are tested where either is exceeded. In haze of 0.3 px of scale height and a depth of 0.05 the blur is 0.9 to 2.3
around 120 px and 0.5 to 1.5 around 60; of exact bodies at most 0.16, and their depth 0.033 (32 fixes). Finer cells are
tested in 3 of 96 fixes without haze (30 to 300 px), in two thirds with the limit of one sigma alone. With 0.4 and 0.04
squared errors of limbs in haze of a depth of 0.02 rise from 1.5 to 6.2 times the covariance (views 220 to 227)."""
_LEAST_EXPLAINED = 0.25
"""Minimum fraction of the squared residuals beyond noise that haze explains: 0.2 to 1 in haze (120 px). With relief and
markings 3 of 15 fixes beyond 3 sigmas have 0.2 or more, at most 0.34."""
_OF_ALTITUDE = 0.5
"""Ratio of the standard deviation of the altitude to the altitude at which a sharp edge would be seen in such haze.
Squared errors of ``limb_matching`` and ``ellipsoid_cra`` in haze of a depth of 0.05 to 0.3 (views 400 to 419) are 0.5
to 2.5 of the covariance with it, 0.2 to 0.6 with 1: laws and free brightness of the limb absorb part of the
altitude."""
_OPTICS = 0.05  # relative standard deviation of the width of the optics, as for the lines of a limb

AnyFix = TypeVar("AnyFix", bound=CenterFix)
Coarse = TypeVar("Coarse", bound=Looked)


def may_be_hazy(fix: CenterFix, inputs: EstimatorInputs) -> bool:
    """Return True for fixes that are tested for haze."""
    target, blur = inputs.geometry.target, fix.corrections.limb_blur_px2
    told = target.airless or target.atmosphere is not None or target.terrain is not None
    return not told and blur is not None and blur > -_optics_px2(inputs) and isinstance(target.shape, Ellipsoid)


def veils(cells: Cells, trace: Trace) -> Float:
    """Haze templates: changes of the image of a body by haze, for a test of residuals.

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
    """Repeat a limb fix with an uncertain altitude where the disk interior shows haze.

    Returns None where no haze is detected.
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
    """Return True where coarse cells indicate some haze, so that finer ones are worth their cost."""
    blur = fix.corrections.limb_blur_px2
    if fit is None or blur is None or not np.any(_sigmas(fit) > _HINT_SIGMAS):
        return False
    return blur > _HINT_BLUR * _optics_px2(inputs) or _clearest_depth(fit, _sigmas(fit)) > _HINT_DEPTH


def haze_depth(fit: CoarseFit) -> float:
    """Vertical optical depth of the haze detected by a fit in fine cells; 0 where none is."""
    sigmas = np.where(fit.omitted.explains > _LEAST_EXPLAINED, _sigmas(fit), 0.0)
    if not np.any(sigmas > _HAZY_SIGMAS):
        return 0.0
    return _clearest_depth(fit, sigmas)


def _clearest_depth(fit: CoarseFit, sigmas: Float) -> float:
    """Depth of the haze template with the most significant share, ``sigmas`` (6,)."""
    clearest = int(np.argmax(sigmas))
    return _DEPTHS[clearest // len(_BRIGHTNESS)] * float(fit.omitted.values[clearest])


def _sigmas(fit: CoarseFit) -> Float:
    """Shares of haze divided by their standard deviations."""
    return np.asarray(fit.omitted.values / np.maximum(fit.omitted.sigma, 1e-300))


def haze_altitude_px(depth: float, blur_px2: float, radius_px: float) -> float:
    """Altitude at which a limb is seen in haze of some depth that causes the unexplained blur."""
    unit = Atmosphere(scale_height_km=1.0, optical_depth=depth, sigma_km=0.0)
    height_px = math.sqrt(blur_px2) / unit.limb_width_km
    return replace(unit, scale_height_km=height_px).limb_altitude_km(radius_px)


def _optics_px2(inputs: EstimatorInputs) -> float:
    """Standard deviation of the variance of the point spread function, px^2."""
    return 2.0 * _OPTICS * (inputs.psf_sigma_px or UNKNOWN_PSF_SIGMA_PX) ** 2
