"""Ellipsoid CRA: the full position of an ellipsoidal body from its lit horizon, by the Christian-Robinson algorithm."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from giantlike.camera import Camera
from giantlike.core.arrays import Float, require
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, PositionFix, Quality, Reason
from giantlike.image import Image
from giantlike.processing.correlated_fit import correlated_solution, generalized_solution
from giantlike.ray_tracing import Body
from giantlike.relative.estimator import EstimatorInputs, apparent_radius_px, gather
from giantlike.relative.horizon.fit import cell_points, fit_horizon
from giantlike.relative.horizon.geometry import (
    Altitude,
    CraMethod,
    Figure,
    altitude_design,
    christian_robinson,
    cone_weights,
    horizon_residuals,
)
from giantlike.relative.horizon.scan import HorizonScan, settle_horizon, settled_limb
from giantlike.relative.limb.fix import LimbSearch, SettledLimb, position_fix, settle_limb
from giantlike.relative.limb.observation import LimbScanOptions
from giantlike.scene import Scene
from giantlike.shapes import Ellipsoid, LevelsOfDetail, PlacedEllipsoid, Shape, TriangleMesh

RELIEF_LENGTH = 0.3
"""Correlation length of relief along the limb over the radius; measured on asteroid models and on made-up bodies."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EllipsoidCRAOptions:
    """How horizons are turned into positions.

    Parameters
    ----------
    method : CraMethod
    search_px : float, px
        Largest error of the predicted center, in both coordinates.
    search_range : float
        Largest relative error of the predicted range.
    max_relief : float
        Meshes that depart from their best-fit ellipsoid by more than this (root mean square over mean radius) are
        refused.
    max_iterations : int
        Times that the template is rendered and the limb measured.
    tolerance_px : float, px
        The limb is measured well enough when it would move less than this in another iteration.
    outlier_mad : float
        Limb points beyond so many robust sigmas are left out.
    max_rms_px : float, px
        Larger residuals, beyond what relief explains, are a failure.
    large_rms_px : float, px
        Larger residuals, beyond what relief explains, get a flag.
    limb_altitude_km : float, km
        What is seen as the limb stands so high above the shape: haze, an atmosphere.
    altitude_sigma_km : float, km
        Standard deviation of that; where it is not zero the altitude is estimated with the position.
    horizon : HorizonScan
        How the horizon of an ellipsoid is measured.
    scan : LimbScanOptions
        How the limb of a mesh is measured.
    """

    method: CraMethod = CraMethod.MAXIMUM_LIKELIHOOD
    search_px: float = 40.0
    search_range: float = 0.03
    max_relief: float = 0.08
    max_iterations: int = 8
    tolerance_px: float = 0.01
    outlier_mad: float = 4.0
    max_rms_px: float = 5.0
    large_rms_px: float = 1.0
    limb_altitude_km: float = 0.0
    altitude_sigma_km: float = 0.0
    horizon: HorizonScan = field(default_factory=HorizonScan)
    scan: LimbScanOptions = field(default_factory=LimbScanOptions)

    def __post_init__(self) -> None:
        require(self.method in list(CraMethod), f"method must be one of {', '.join(CraMethod)}, got {self.method!r}")
        object.__setattr__(self, "method", CraMethod(self.method))
        require(
            math.isfinite(self.max_relief) and self.max_relief > 0, f"max_relief must be > 0, got {self.max_relief}"
        )
        self.search(0.0)  # checks the values
        self.altitude()

    def altitude(self) -> Altitude:
        """What is known of the altitude of the limb."""
        return Altitude(self.limb_altitude_km, self.altitude_sigma_km)

    def search(self, relief_px: float) -> LimbSearch:
        """The part of the options that every estimator on limbs has, for a body of some relief."""
        return LimbSearch(
            search_px=self.search_px,
            search_range=self.search_range,
            max_iterations=self.max_iterations,
            tolerance_px=self.tolerance_px,
            outlier_mad=self.outlier_mad,
            max_rms_px=self.max_rms_px,
            large_rms_px=self.large_rms_px,
            relief_px=relief_px,
        )


class EllipsoidCRA:
    """Full position of a body from the horizon of its ellipsoid.

    The lit horizon is measured in short cells, by the profile that the ellipsoid has across it in closed form, its
    brightness free in every cell (with ``horizon.edges`` a step no reflectance law is needed); its points then go
    through the Christian-Robinson algorithm. A mesh is replaced by its best-fit ellipsoid, flagged
    ``SHAPE_APPROXIMATED``, and its limb measured as in limb matching (``scan``); its relief is then in the covariance,
    as errors that neighbors on the limb share.

    ``score`` of the fix is the root mean square of the residuals in px; ``residuals`` are those across the limb, px,
    positive where the limb in the image lies outside the horizon.

    Parameters
    ----------
    options : EllipsoidCRAOptions

    References
    ----------
    .. [1] Inman et al., Artemis I optical navigation system performance, section III.A.
    .. [2] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation, eqs. 8-20.
    """

    name: ClassVar[str] = "ellipsoid_cra"

    def __init__(self, options: EllipsoidCRAOptions | None = None) -> None:
        self.options = options or EllipsoidCRAOptions()

    def estimate(self, image: Image, camera: Camera, scene: Scene, target: str | None = None) -> PositionFix | Failure:
        """Find a target of ``scene`` in ``image``.

        Parameters
        ----------
        image : Image
        camera : Camera
            Without a psf, its width is measured on the limb.
        scene : Scene
        target : str, optional
            May be left out when there is only one.

        Returns
        -------
        PositionFix or Failure
            ``WRONG_SHAPE`` for a body that is no ellipsoid; ``NO_LIMB``, ``NOT_LIT``, ``OUT_OF_FRAME``, ``SATURATED``,
            ``NOT_CONVERGED``, ``LARGE_RESIDUALS`` or ``DEGENERATE_GEOMETRY``, and what ``gather`` fails for.

        Raises
        ------
        InputError
            The image has another size than the camera, or there is no such target.
        DataError
            SPICE kernels do not cover the epoch.
        """
        inputs = gather(image, camera, scene, target, estimator=self.name, options=self.options)
        if isinstance(inputs, Failure):
            return inputs
        shape = inputs.geometry.target.shape
        if isinstance(shape, Ellipsoid):
            return _smooth_fix(inputs, shape, self.options)
        if not shape.mean_radius_km > 0.0:
            return inputs.fail(Reason.WRONG_SHAPE, "the target is a point: it has no limb")
        placed = shape.best_fit_ellipsoid
        relief_km = relief_of(shape, placed)
        relief = relief_km / shape.mean_radius_km
        if relief > self.options.max_relief:
            return inputs.fail(
                Reason.WRONG_SHAPE,
                f"the shape departs from its best-fit ellipsoid by {relief:.1%} of its radius (rms), allowed "
                f"{self.options.max_relief:.1%}: use limb_matching or raise max_relief",
            )
        body = _ellipsoid_body(inputs, placed, self.options.altitude())
        relief_px = apparent_radius_px(camera, inputs.predicted_px, relief_km, inputs.geometry.range_km)
        search = self.options.search(relief_px)
        limb = settle_limb(inputs, body, search=search, scan=self.options.scan)
        if isinstance(limb, Failure):
            return limb
        return _fix(inputs, limb, body, placed, search, self.options)


def relief_of(shape: Shape, placed: PlacedEllipsoid) -> float:
    """Root mean square distance, km, of a shape from its ellipsoid; 0 for an ellipsoid."""
    mesh = shape.finest if isinstance(shape, LevelsOfDetail) else shape
    return relief_sigma_km(mesh, placed) if isinstance(mesh, TriangleMesh) else 0.0


def relief_sigma_km(shape: TriangleMesh, placed: PlacedEllipsoid) -> float:
    """Root mean square distance, km, of a mesh from an ellipsoid, along its normals and over its area."""
    corners = shape.vertices_km[shape.faces]
    points = rotate(placed.body_from_axes.inv(), corners.mean(axis=1) - placed.center_body_km)
    radii = placed.ellipsoid.radii_km
    stretch = np.linalg.norm(points / radii, axis=1)
    distance = (stretch - 1.0) * stretch / np.linalg.norm(points / radii**2, axis=1)
    return float(np.sqrt(np.average(distance**2, weights=shape.areas_km2)))


def _smooth_fix(inputs: EstimatorInputs, shape: Ellipsoid, options: EllipsoidCRAOptions) -> PositionFix | Failure:
    """Position of a body that is an ellipsoid."""
    geometry, model, search, altitude = inputs.geometry, inputs.camera.model, options.search(0.0), options.altitude()
    figure = altitude.above(Figure(radii_km=shape.radii_km, camera_from_axes=geometry.camera_from_body))
    view = settle_horizon(inputs, figure, geometry.position_camera_km, search=search, scan=options.horizon)
    if isinstance(view, Failure):
        return view
    points_px, sigma_px = cell_points(view), view.fits.sigma_px[view.keep]
    center_km = christian_robinson(points_px, model, figure, method=options.method, sigma_px=sigma_px)
    if isinstance(center_km, Failure):
        return inputs.fail(center_km.reason, center_km.detail)
    weights = None
    if options.method is not CraMethod.MAXIMUM_LIKELIHOOD:
        weights = cone_weights(points_px, model, figure, center_km)
    fitted = fit_horizon(view, model, figure, center_km, altitude, weights=weights)
    fix = position_fix(
        inputs,
        settled_limb(inputs, view, options.horizon),
        position_camera_km=fitted.position_camera_km,
        covariance_camera_km2=fitted.covariance_camera_km2,
        residuals_px=fitted.residuals_px,
        search=search,
    )
    return fitted.told(fix) if isinstance(fix, PositionFix) else fix


def _ellipsoid_body(inputs: EstimatorInputs, placed: PlacedEllipsoid, altitude: Altitude) -> Body:
    """The ellipsoid in the place of the shape, as high as its limb."""
    geometry = inputs.geometry
    return Body(
        shape=Ellipsoid(radii_km=placed.ellipsoid.radii_km + altitude.altitude_km),
        reflectance=geometry.target.reflectance,
        camera_from_body=geometry.camera_from_body * placed.body_from_axes,
        position_camera_km=geometry.position_camera_km + _center_camera_km(inputs, placed),
    )


def _center_camera_km(inputs: EstimatorInputs, placed: PlacedEllipsoid) -> Float:
    """From the origin of the shape to the center of the ellipsoid (3,), km, camera axes."""
    offset: Float = rotate(inputs.geometry.camera_from_body, placed.center_body_km)
    return offset


def _fix(
    inputs: EstimatorInputs,
    limb: SettledLimb,
    body: Body,
    placed: PlacedEllipsoid,
    search: LimbSearch,
    options: EllipsoidCRAOptions,
) -> PositionFix | Failure:
    """The Christian-Robinson algorithm on the limb as measured."""
    model = inputs.camera.model
    points_px, sigma_px = limb.observation.observed_px[limb.keep], limb.observation.sigma_px[limb.keep]
    seen = Figure(radii_km=placed.ellipsoid.radii_km, camera_from_axes=body.camera_from_body)
    figure = options.altitude().above(seen)
    center_km = christian_robinson(points_px, model, figure, method=options.method, sigma_px=sigma_px)
    if isinstance(center_km, Failure):
        return inputs.fail(center_km.reason, center_km.detail)
    residuals, design, _ = horizon_residuals(points_px, model, figure, center_km)
    scatter = _scatter_px2(residuals, design, sigma_px, points_px, search.relief_px, inputs.radius_px, options)
    lift = altitude_design(points_px, model, figure, center_km)
    scatter += options.altitude_sigma_km**2 * np.outer(lift, lift)
    weights = None
    if options.method is not CraMethod.MAXIMUM_LIKELIHOOD:
        weights = cone_weights(points_px, model, figure, center_km)
    step, covariance = generalized_solution(residuals, design, scatter, weights=weights)
    if weights is None:
        center_km, residuals = center_km + step, residuals - design @ step
    return position_fix(
        inputs,
        limb,
        position_camera_km=center_km - _center_camera_km(inputs, placed),
        covariance_camera_km2=covariance,
        residuals_px=residuals,
        search=search,
        flags=Quality.SHAPE_APPROXIMATED if search.relief_px > 0 else Quality.NONE,
    )


def _scatter_px2(
    residuals_px: Float,
    design: Float,
    sigma_px: Float,
    points_px: Float,
    relief_px: float,
    radius_px: float,
    options: EllipsoidCRAOptions,
) -> Float:
    """Covariance (n, n) of the limb points across the limb: as the residuals show it, or relief where that is known."""
    if relief_px > 0.0:
        distances = np.linalg.norm(points_px[:, None] - points_px[None], axis=-1)
        sigma = max(relief_px, float(np.sqrt(np.mean(residuals_px**2))))
        result: Float = np.diag(sigma_px**2) + sigma**2 * np.exp(-distances / (RELIEF_LENGTH * radius_px))
        return result
    fit = correlated_solution(residuals_px, design, sigma_px, points_px, min_length=options.scan.spacing_px)
    return fit.residual_covariance(sigma_px, points_px)
