"""From cells along a horizon to a position with a covariance that knows what the cells have in common."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float
from giantlike.core.outcomes import PositionFix
from giantlike.core.values import Value
from giantlike.processing.correlated_fit import correlated_solution, generalized_solution
from giantlike.relative.horizon.geometry import Altitude, Figure, altitude_design, horizon_residuals
from giantlike.relative.horizon.scan import HorizonView

_EXPLAINED_SIGMAS = 2.5
"""Scatter of cells, and the product of neighbors, that pixel noise reaches once in a hundred times."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HorizonFit(Value):
    """A position from a horizon.

    Parameters
    ----------
    position_camera_km : (3,) float64, km, camera axes
        Of the ellipsoid's center.
    covariance_camera_km2 : (3, 3) float64, km^2
    residuals_px : (n,) float64, px
        Outward, of the cells kept.
    altitude_km, altitude_sigma_km : float, km
        Of the limb over the shape, after the fit.
    """

    position_camera_km: Float
    covariance_camera_km2: Float
    residuals_px: Float
    altitude_km: float
    altitude_sigma_km: float

    def told(self, fix: PositionFix) -> PositionFix:
        """The fix with the altitude of the limb in its provenance, where there is one."""
        if self.altitude_km == 0.0 and self.altitude_sigma_km == 0.0:
            return fix
        altitude = {
            "limb_altitude_km": f"{self.altitude_km:.6g}",
            "altitude_sigma_km": f"{self.altitude_sigma_km:.6g}",
        }
        return replace(fix, provenance={**fix.provenance, **altitude})


def cell_points(view: HorizonView) -> Float:
    """Points (n, 2) of the horizon in the image, px, one for each cell kept."""
    shared, _ = view.shared()
    shift = view.fits.raw_shift_px - view.fits.shared @ shared
    result: Float = (view.points_px + shift[:, None] * view.normals_px)[view.keep]
    return result


def fit_horizon(
    view: HorizonView,
    model: CameraModel,
    figure: Figure,
    position_camera_km: Float,
    altitude: Altitude,
    *,
    weights: Float | None = None,
) -> HorizonFit:
    """Move a position to where the cells of a view want it, all of them together.

    Parameters
    ----------
    view : HorizonView
    model : CameraModel
    figure : Figure
        As seen: with the altitude on its radii.
    position_camera_km : (3,) float64, km, camera axes
        Near that of the view.
    altitude : Altitude
    weights : (n,) float64, optional
        With these the position is taken as it is, and its covariance is that of a solution so weighted.

    Notes
    -----
    The cells err by pixel noise; by what neighbors share (albedo, relief), found from their scatter where noise does
    not explain that; by the blur and the law, which all of them share and whose covariance the profiles give; and by
    the altitude.
    """
    points = cell_points(view)
    residuals, design, _ = horizon_residuals(points, model, figure, position_camera_km)
    sigma = view.fits.sigma_px[view.keep]
    common = view.fits.shared[view.keep]
    covariance = _scatter_px2(residuals, design, sigma, points) + common @ view.shared()[1] @ common.T
    lift = altitude_design(points, model, figure, position_camera_km)
    covariance += altitude.sigma_km**2 * np.outer(lift, lift)
    step, position_covariance = generalized_solution(residuals, design, covariance, weights=weights)
    if weights is not None:
        step = np.zeros(3)
    left = residuals - design @ step
    raised, sigma_km = _altitude(left, design, covariance, lift, altitude)
    return HorizonFit(
        position_camera_km=position_camera_km + step,
        covariance_camera_km2=position_covariance,
        residuals_px=left,
        altitude_km=raised,
        altitude_sigma_km=sigma_km,
    )


def _scatter_px2(residuals: Float, design: Float, sigma: Float, points: Float) -> Float:
    """Covariance (n, n) of the cells' own errors: pixel noise, and more where their scatter or its waves show it."""
    whitened = design / sigma[:, None]
    scale = np.linalg.norm(whitened, axis=0)
    basis, _ = np.linalg.qr(whitened / scale)
    left = residuals / sigma
    left = left - basis @ (basis.T @ left)
    freedom = left.size - 3
    scatter = (float(left @ left) / freedom - 1.0) / np.sqrt(2.0 / freedom)
    waves = float(left[1:] @ left[:-1]) / np.sqrt(left.size)
    if max(scatter, waves) < _EXPLAINED_SIGMAS:
        return np.diag(sigma**2)
    fit = correlated_solution(residuals, design, sigma, points, min_length=_spacing_px(points))
    return fit.residual_covariance(sigma, points)


def _altitude(left: Float, design: Float, covariance: Float, lift: Float, altitude: Altitude) -> tuple[float, float]:
    """Altitude and its standard deviation, km, after the fit: as before it where the range takes up all of it."""
    variance = altitude.sigma_km**2
    if variance == 0.0:
        return altitude.altitude_km, 0.0
    weighted = np.linalg.solve(covariance, np.column_stack([lift, design]))
    gain = weighted[:, 0] - weighted[:, 1:] @ np.linalg.solve(design.T @ weighted[:, 1:], weighted[:, 1:].T @ lift)
    known = variance - variance**2 * float(gain @ lift)
    return altitude.altitude_km + variance * float(gain @ left), float(np.sqrt(max(known, 0.0)))


def _spacing_px(points: Float) -> float:
    return float(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1)))
