"""Limb fixes in undeclared haze that the disk interior shows, and the limb altitude that haze implies."""

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
from giantlike.relative.template.haze import haze_laws
from giantlike.relative.verification.cells import Cells
from giantlike.relative.verification.proportion import Looked
from giantlike.shapes import Ellipsoid

_OF_ALTITUDE = 0.5
"""Ratio of the standard deviation of the altitude to the altitude at which a sharp edge would be seen in such haze.
Squared errors of ``limb_matching`` and ``ellipsoid_cra`` in haze of a depth of 0.05 to 0.3 (views 400 to 419) are 0.5
to 2.5 of the covariance with it, 0.2 to 0.6 with 1: laws and free brightness of the limb absorb part of the
altitude."""
_LEAST_BLUR = 0.2
"""Minimum ratio of the blur of a limb to the uncertainty of the optics: 0.5 to 2.3 in haze of 0.3 px of scale height
and a depth of 0.05 around 60 and 120 px, at most 0.16 of exact bodies (32 fixes). Other laws look like haze at
opposition, but blur no limb."""
_OPTICS = 0.05  # relative standard deviation of the width of the optics, as for the lines of a limb

AnyFix = TypeVar("AnyFix", bound=CenterFix)
Coarse = TypeVar("Coarse", bound=Looked)


def may_be_hazy(fix: CenterFix, inputs: EstimatorInputs) -> bool:
    """Return True for fixes that are tested for haze."""
    target, blur = inputs.geometry.target, fix.corrections.limb_blur_px2
    told = target.airless or target.atmosphere is not None or target.terrain is not None
    return not told and blur is not None and blur > -_optics_px2(inputs) and isinstance(target.shape, Ellipsoid)


def veils(cells: Cells, trace: Trace) -> Float:
    """Return the images (3, n, n) of haze, as :func:`~giantlike.relative.template.haze.haze_block` takes them."""
    taken, sent, even = (cells.light(trace.with_reflectance(law)) for law in haze_laws(trace.body.reflectance))
    rows, columns = np.indices(even.shape)
    x, y = (float(np.vdot(even, each)) / float(even.sum()) for each in (columns, rows))
    by_row, by_column = np.gradient(even)
    return np.stack([taken, sent, -(columns - x) * by_column - (rows - y) * by_row])


def in_haze(
    fix: AnyFix,
    coarse: Coarse,
    inputs: EstimatorInputs,
    again: Callable[[EstimatorInputs], AnyFix | Failure],
    look: Callable[[AnyFix, EstimatorInputs], Coarse | None],
) -> tuple[AnyFix, Coarse, EstimatorInputs] | None:
    """Repeat a limb fix with an uncertain altitude where the coarse render shows haze.

    Returns None where haze is improbable.
    """
    blur, fit = fix.corrections.limb_blur_px2, coarse.fit
    if blur is None or fit is None or not fit.haze_chance > 0.5 or fit.haze_depth == 0.0:
        return None
    if not blur > _LEAST_BLUR * _optics_px2(inputs):
        return None
    geometry = inputs.geometry
    blur_px2 = math.hypot(max(blur, 0.0), _optics_px2(inputs))
    sigma_px = math.sqrt(fit.haze_chance) * _OF_ALTITUDE * haze_altitude_px(fit.haze_depth, blur_px2, inputs.radius_px)
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


def haze_altitude_px(depth: float, blur_px2: float, radius_px: float) -> float:
    """Altitude at which a limb is seen in haze of some depth that causes the unexplained blur."""
    unit = Atmosphere(scale_height_km=1.0, optical_depth=depth, sigma_km=0.0)
    height_px = math.sqrt(blur_px2) / unit.limb_width_km
    return replace(unit, scale_height_km=height_px).limb_altitude_km(radius_px)


def _optics_px2(inputs: EstimatorInputs) -> float:
    """Standard deviation of the variance of the point spread function, px^2."""
    return 2.0 * _OPTICS * (inputs.psf_sigma_px or UNKNOWN_PSF_SIGMA_PX) ** 2
