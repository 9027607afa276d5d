"""Ellipsoid CRA: the full position of an ellipsoidal body from its lit horizon, by the Christian-Robinson algorithm."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from giantlike.core.arrays import Float, require, require_number
from giantlike.core.causes import Cause
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, PositionFix, Reason
from giantlike.core.values import Value
from giantlike.processing.limb.measurement import LimbMeasurement, SmoothError
from giantlike.ray_tracing import Body
from giantlike.relative.estimator import BodyEstimator
from giantlike.relative.horizon.cell_scan import measure_by_cells
from giantlike.relative.horizon.geometry import CraMethod, Figure, christian_robinson, fit_horizon
from giantlike.relative.horizon.options import HorizonScan, HorizonSearch
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.limb.fix import LimbSolution, limb_view
from giantlike.relative.limb.line_scan import measure_by_lines
from giantlike.relative.limb.profiles import LimbScanOptions
from giantlike.relative.limb.strain import fix_of_strained
from giantlike.relative.limb.terrain import with_terrain
from giantlike.relative.place import apparent_radius_px
from giantlike.shapes import Ellipsoid, PlacedEllipsoid, TriangleMesh
from giantlike.shapes.detail import LevelsOfDetail

RELIEF_LENGTH = 0.3
"""Correlation length of relief along the limb, radii; measured on asteroid models and on synthetic bodies."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EllipsoidCRAOptions(HorizonSearch):
    """Options of :class:`EllipsoidCRA`.

    Parameters
    ----------
    method : CraMethod
    search_px : float, px; largest error of the predicted center, in both coordinates
    search_range : float; largest relative error of the predicted range
    max_relief : float
        Meshes that depart from their best-fit ellipsoid by more than this (root mean square over mean radius) are
        refused.
    max_iterations : int; maximum number of renders of the template
    tolerance_px : float, px; the limb is measured well enough when it would move less than this in another iteration
    outlier_mad : float; limb points beyond so many robust sigmas are left out
    max_rms_px : float, px; larger residuals, beyond what relief explains, are a failure
    large_rms_px : float, px; kept for files of earlier versions: residuals raise no flag
    limb_altitude_km : float, km
        Altitude of the apparent limb above the shape, by haze or an atmosphere. Where this and its sigma are 0, the
        altitude of the target's atmosphere is used.
    altitude_sigma_km : float, km
        Standard deviation of the altitude; where it is not zero the altitude is estimated with the position.
    horizon : HorizonScan; options for the horizon of an ellipsoid
    scan : LimbScanOptions; options for the limb of a mesh
    """

    method: CraMethod = CraMethod.MAXIMUM_LIKELIHOOD
    tolerance_px: float = 0.005
    max_relief: float = 0.08
    horizon: HorizonScan = field(default_factory=HorizonScan)
    scan: LimbScanOptions = field(default_factory=LimbScanOptions)

    def __post_init__(self) -> None:
        HorizonSearch.__post_init__(self)
        require(self.method in list(CraMethod), f"method must be one of {', '.join(CraMethod)}, got {self.method!r}")
        object.__setattr__(self, "method", CraMethod(self.method))
        require_number(self.max_relief, "max_relief", above=0.0)


class EllipsoidCRA(BodyEstimator[EllipsoidCRAOptions, PositionFix]):
    """Full position of a body from the horizon of its ellipsoid.

    The lit horizon is measured in short cells, by the profile that the ellipsoid has across it in closed form, its
    brightness free in every cell (with ``horizon.edges`` a step no reflectance law is needed); its points then go
    through the Christian-Robinson algorithm. A mesh is replaced by its best-fit ellipsoid, flagged
    ``SHAPE_APPROXIMATED``, and its limb measured as in limb matching (``scan``); its relief is then in the covariance,
    as errors correlated along the limb. So is the limb of an ellipsoid with a height map, whose relief is subtracted
    from its points.

    ``score`` of the fix is the root mean square of the residuals in px; ``residuals`` are those across the limb, px,
    positive where the limb in the image lies outside the horizon.

    Failures are ``NO_LIMB``, ``NOT_LIT``, ``OUT_OF_FRAME``, ``SATURATED``, ``NOT_CONVERGED``, ``LARGE_RESIDUALS`` and
    ``DEGENERATE_GEOMETRY``, and ``WRONG_SHAPE`` for a body that is not an ellipsoid. The width of
    an unknown point spread function is measured on the limb.

    Parameters
    ----------
    options : EllipsoidCRAOptions

    References
    ----------
    .. [1] Inman et al., Artemis I optical navigation system performance, section III.A.
    .. [2] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation, eqs. 8-20.
    """

    name: ClassVar[str] = "ellipsoid_cra"
    by_outline: ClassVar[bool] = True
    options_type = EllipsoidCRAOptions

    def _estimate(self, inputs: EstimatorInputs) -> PositionFix | Failure:
        stand_in = EllipsoidStandIn.from_inputs(inputs, self.options.max_relief)
        if isinstance(stand_in, Failure):
            return stand_in
        outcome = _fit_position(inputs, stand_in, self.options)
        if isinstance(outcome, Failure):
            return outcome
        measured, solution = outcome
        return fix_of_strained(inputs, measured, solution, self.options)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EllipsoidStandIn(Value):
    """Ellipsoid that represents a body.

    relief: departure of the outline from the outline of the ellipsoid; None for a body that is an ellipsoid.
    """

    figure: Figure
    offset_camera_km: Float  # from the origin of the shape to the center of the ellipsoid
    position_camera_km: Float  # predicted position of that center
    relief: SmoothError | None

    @classmethod
    def from_inputs(cls, inputs: EstimatorInputs, max_relief: float) -> EllipsoidStandIn | Failure:
        """Replace a body by its best-fit ellipsoid; ``WRONG_SHAPE`` if the body departs from it too far."""
        geometry, shape = inputs.geometry, inputs.geometry.target.shape
        if not shape.mean_radius_km > 0.0:
            return Failure(Reason.WRONG_SHAPE, "the target is a point: it has no limb", not_applicable=True)
        placed, turn = shape.best_fit_ellipsoid, geometry.camera_from_body
        mesh = shape.finest if isinstance(shape, LevelsOfDetail) else shape
        relief_km = relief_sigma_km(mesh, placed) if isinstance(mesh, TriangleMesh) else 0.0
        if relief_km > max_relief * shape.mean_radius_km:
            return Failure(
                Reason.WRONG_SHAPE,
                f"the shape departs from its best-fit ellipsoid by {relief_km / shape.mean_radius_km:.1%} of its "
                f"radius (rms), allowed {max_relief:.1%}: use limb_matching or raise max_relief",
                not_applicable=True,
            )
        relief = None
        if relief_km > 0.0:
            relief_px = apparent_radius_px(inputs.camera, inputs.predicted_px, relief_km, geometry.range_km)
            relief = SmoothError(cause=Cause.RELIEF, sigma_px=relief_px, length_px=RELIEF_LENGTH * inputs.radius_px)
        offset: Float = rotate(turn, placed.center_body_km)
        return cls(
            figure=Figure(
                radii_km=placed.ellipsoid.radii_km,
                camera_from_axes=turn * placed.body_from_axes,
                air=geometry.air,
            ),
            offset_camera_km=offset,
            position_camera_km=geometry.position_camera_km + offset,
            relief=relief,
        )


def relief_sigma_km(shape: TriangleMesh, placed: PlacedEllipsoid) -> float:
    """Root mean square distance, km, of a mesh from an ellipsoid, along its normals and over its area."""
    corners = shape.vertices_km[shape.faces]
    points = rotate(placed.body_from_axes.inv(), corners.mean(axis=1) - placed.center_body_km)
    radii = placed.ellipsoid.radii_km
    stretch = np.linalg.norm(points / radii, axis=1)
    distance = (stretch - 1.0) * stretch / np.linalg.norm(points / radii**2, axis=1)
    return float(np.sqrt(np.average(distance**2, weights=shape.areas_km2)))


def _fit_position(
    inputs: EstimatorInputs, stand_in: EllipsoidStandIn, options: EllipsoidCRAOptions
) -> tuple[LimbMeasurement, LimbSolution] | Failure:
    """The limb as measured, and the position by the Christian-Robinson algorithm."""
    altitude, law = options.altitude(inputs.geometry), inputs.geometry.target.reflectance
    view = limb_view(inputs, altitude.sigma_km)
    figure, start_km = altitude.above(stand_in.figure), stand_in.position_camera_km
    if isinstance(inputs.geometry.target.shape, Ellipsoid) and inputs.geometry.target.terrain is None:
        measured = measure_by_cells(view, figure, law, start_km, options, options.horizon.about(inputs.geometry.target))
    else:
        body = Body(
            shape=Ellipsoid(radii_km=figure.radii_km),
            reflectance=law,
            camera_from_body=figure.camera_from_axes,
            position_camera_km=start_km,
        )
        measured = measure_by_lines(view, body, options, options.scan, relief=stand_in.relief)
    if isinstance(measured, Failure):
        return measured
    measured = with_terrain(measured, inputs, options.outlier_mad)
    model, points_px = view.model, measured.observed_px[measured.keep]
    sigma_px = measured.sigma_px[measured.keep]
    center_km = christian_robinson(points_px, model, figure, method=options.method, sigma_px=sigma_px)
    if isinstance(center_km, Failure):
        return center_km
    sun, method = view.sun_direction_camera, options.method
    solution = fit_horizon(measured, model, figure, center_km, altitude, sun_direction_camera=sun, method=method)
    return measured, replace(solution, position_camera_km=solution.position_camera_km - stand_in.offset_camera_km)
