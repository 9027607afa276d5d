"""Sigmoid limb: position of an ellipsoid by fitting its blurred horizon to all pixels along the lit limb at once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from giantlike.core.outcomes import Failure, PositionFix, Reason
from giantlike.relative.estimator import BodyEstimator
from giantlike.relative.horizon.cell_scan import measure_by_cells
from giantlike.relative.horizon.geometry import Figure, fit_horizon
from giantlike.relative.horizon.options import HorizonScan, HorizonSearch
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.limb.fix import limb_view
from giantlike.relative.limb.strain import fix_of_strained
from giantlike.relative.limb.terrain import CELL_SLOPE_ERROR, with_terrain
from giantlike.shapes import Ellipsoid


@dataclass(frozen=True, slots=True, kw_only=True)
class SigmoidLimbOptions(HorizonSearch):
    """Options of :class:`SigmoidLimb`.

    Parameters
    ----------
    search_px : float, px; largest error of the predicted center, in both coordinates
    search_range : float; largest relative error of the predicted range
    max_iterations : int; maximum number of fits of the horizon
    tolerance_px : float, px; the fit has converged when the horizon would move less than this in another iteration
    outlier_mad : float; cells beyond so many robust sigmas are left out
    max_rms_px : float, px; larger residuals are a failure
    large_rms_px : float, px; kept for files of earlier versions: residuals raise no flag
    limb_altitude_km : float, km
        Altitude of the apparent limb above the shape, by haze or an atmosphere. Where this and its sigma are 0, the
        altitude of the target's atmosphere is used.
    altitude_sigma_km : float, km
        Standard deviation of the altitude; where it is not zero the altitude is estimated with the position.
    scan : HorizonScan
    """

    max_iterations: int = 15
    tolerance_px: float = 0.005
    outlier_mad: float = 5.0
    max_rms_px: float = 3.0
    large_rms_px: float = 1.0
    scan: HorizonScan = field(default_factory=HorizonScan)


class SigmoidLimb(BodyEstimator[SigmoidLimbOptions, PositionFix]):
    """Full position of an ellipsoid by an iterative least-squares fit of its ellipsoidal sigmoid to the image.

    Where the Christian-Robinson algorithm first finds points on the horizon and then an ellipsoid through them, here
    the position moves one blurred horizon over all pixels near the lit limb. The brightness inside is free in short
    cells along the limb (gain, growth along and inward), background too; the width of the blur and a smooth error of
    the reflectance law are common to all cells, with priors from the options. The start is the contrast of the whole
    outline.

    ``score`` of the fix is the root mean square of the residuals in px: the shift of the horizon by each cell alone,
    positive outward.

    Failures are ``NO_LIMB``, ``NOT_LIT``, ``OUT_OF_FRAME``, ``SATURATED``, ``NOT_CONVERGED``, ``LARGE_RESIDUALS`` and
    ``DEGENERATE_GEOMETRY``, and ``WRONG_SHAPE`` for a body that is not an ellipsoid. The width of
    an unknown point spread function is estimated with the position.

    Parameters
    ----------
    options : SigmoidLimbOptions

    References
    ----------
    .. [1] Inman et al., Artemis I optical navigation system performance, section III.B: the fit "minimizing the
       residual between the image gradient around the lit limb with that of an ellipsoidal sigmoid function", iterated
       until the update falls below a threshold. Its source (Mortari, D'Souza and Zanetti 2016) was not at hand; here
       the brightness itself is fitted rather than its gradient, which is the same model with independent noise.
    """

    name: ClassVar[str] = "sigmoid_limb"
    by_outline: ClassVar[bool] = True
    options_type = SigmoidLimbOptions

    def _estimate(self, inputs: EstimatorInputs) -> PositionFix | Failure:
        shape = inputs.geometry.target.shape
        if not isinstance(shape, Ellipsoid):
            return Failure(
                Reason.WRONG_SHAPE,
                f"the fit needs an ellipsoid, got a {type(shape).__name__}: use ellipsoid_cra or limb_matching",
                not_applicable=True,
            )
        geometry = inputs.geometry
        altitude = self.options.altitude(geometry)
        view = limb_view(inputs, altitude.sigma_km)
        axes = geometry.camera_from_body
        figure = altitude.above(Figure(radii_km=shape.radii_km, camera_from_axes=axes, air=geometry.air))
        law, start_km = geometry.target.reflectance, geometry.position_camera_km
        measured = measure_by_cells(
            view, figure, law, start_km, self.options, self.options.scan.about(inputs.geometry.target)
        )
        if isinstance(measured, Failure):
            return measured
        measured = with_terrain(measured, inputs, self.options.outlier_mad, slope_error=CELL_SLOPE_ERROR)
        solution = fit_horizon(
            measured,
            view.model,
            figure,
            measured.position_camera_km,
            altitude,
            sun_direction_camera=view.sun_direction_camera,
        )
        return fix_of_strained(inputs, measured, solution, self.options)
