"""Limb matching: the full position of a body of any shape from its lit limb."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, require_number, unit
from giantlike.core.causes import Cause
from giantlike.core.findings import Corrections
from giantlike.core.frames import rotate
from giantlike.core.outcomes import BodyTurn, Failure, PositionFix, Reason
from giantlike.processing.limb.altitude import lift_points
from giantlike.processing.limb.measurement import LimbMeasurement
from giantlike.processing.limb.view import LimbView
from giantlike.ray_tracing import Body
from giantlike.relative.estimator import BodyEstimator
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.limb.fix import IteratedSearch, limb_view
from giantlike.relative.limb.line_scan import LineMeasurement, measure_by_lines, measure_once
from giantlike.relative.limb.profiles import OTHER_LAWS, LimbScanOptions
from giantlike.relative.limb.solution import solve_limb
from giantlike.relative.limb.strain import fix_of_strained
from giantlike.relative.limb.terrain import with_terrain
from giantlike.relative.limb.turn import limb_turn
from giantlike.relative.template.haze import haze_laws
from giantlike.shapes import TriangleMesh


@dataclass(frozen=True, slots=True, kw_only=True)
class LimbMatchingOptions(IteratedSearch):
    """Options of :class:`LimbMatching`.

    Parameters
    ----------
    search_px : float, px; largest error of the predicted center, in both coordinates
    search_range : float; largest relative error of the predicted range
    max_iterations : int; maximum number of renders and measurements
    tolerance_px : float, px; the fit has converged when the limb would move less than this in another iteration
    outlier_mad : float; limb points beyond so many robust sigmas are left out
    max_rms_px : float, px; larger residuals are a failure
    large_rms_px : float, px; kept for files of earlier versions: residuals raise no flag
    min_diameter_px : float, px
        Smaller bodies (by the predicted size of the sphere of the same volume) are a failure: ``cross_correlation`` and
        ``unresolved``, which use all of the light, are more accurate. Lower it to measure such limbs nevertheless.
        Squared errors of 32 views each of 14 cases of correct and wrong models (``benchmarks/stress.py``, 15 to 125
        degrees of phase) are 0.5 to 1.7 of the covariance at 30 px and 0.7 to 1.3 at 24 px, where two dead columns
        leave 8 limbs of 32, with 3.0 (29 at 30 px); of 11 cases at 20 px up to 1.7, of 4 at 12 px up to 2.1. There was
        no undetected failure.
    scan : LimbScanOptions
    """

    min_diameter_px: float = 25.0
    scan: LimbScanOptions = field(default_factory=LimbScanOptions)

    def __post_init__(self) -> None:
        IteratedSearch.__post_init__(self)
        require_number(self.min_diameter_px, "min_diameter_px", least=0.0)


class LimbMatching(BodyEstimator[LimbMatchingOptions, PositionFix]):
    """Full position of a body from its lit limb.

    The outline is located as a whole. Then the body is rendered at the current position, compared with the image line
    by line across the limb, and its position improved by least squares, until convergence. The covariance comes from
    the scatter of the residuals and their correlation along the limb. A wrong reflectance law, and width and wings of
    the point spread function, leave no residuals along the limb but change the profile across it: they are estimated
    with it and are in the covariance, as ``reflectance`` and ``psf`` of the fix's ``parts``. So is the attenuation by
    haze toward the limb, where the target has an atmosphere of uncertain altitude. For saturated disks the template is
    clipped like the detector.

    The ``turn`` of the fix is the rotation of the body about the line of sight, estimated together with a separate
    position; the fix itself uses the declared orientation of the body.

    ``score`` of the fix is the root mean square of the residuals in px; ``residuals`` are those across the limb, px,
    positive where the limb in the image lies outside that of the body.

    Failures are ``NO_LIMB``, ``NOT_LIT``, ``OUT_OF_FRAME``, ``SATURATED``, ``NOT_CONVERGED``, ``LARGE_RESIDUALS`` and
    ``DEGENERATE_GEOMETRY``. The width of an unknown point spread function is measured on the limb.

    Parameters
    ----------
    options : LimbMatchingOptions

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Limb Matching".
    """

    name: ClassVar[str] = "limb_matching"
    options_type = LimbMatchingOptions

    def _estimate(self, inputs: EstimatorInputs) -> PositionFix | Failure:
        diameter_px, least_px = 2.0 * inputs.radius_px, self.options.min_diameter_px
        if diameter_px < least_px:
            advice = "use cross_correlation or unresolved, or lower min_diameter_px"
            return Failure(
                Reason.NO_LIMB,
                f"the body is {diameter_px:.1f} px across, min_diameter_px is {least_px:g}: {advice}",
                not_applicable=True,
            )
        body, (altitude_km, sigma_km) = inputs.geometry.seen_body(), inputs.geometry.limb_altitude_km
        view = limb_view(inputs, sigma_km)
        lines = self._lines(view, body, in_haze=altitude_km != 0.0 and sigma_km > 0.0)
        if isinstance(lines, Failure):
            return lines
        measured = with_terrain(lines, inputs, self.options.outlier_mad)
        if isinstance(body.shape, TriangleMesh):
            measured = _with_facets(measured, body.shape)
        if sigma_km > 0.0:
            sights, sun = view.model.unproject(measured.predicted_px), view.sun_direction_camera
            lift_px = sigma_km * np.linalg.norm(measured.design, axis=1)
            lift = {Cause.ALTITUDE: lift_points(lift_px, sights, measured.position_camera_km, sun)}
            measured = replace(measured, common_px={**measured.common_px, **lift})
        solution = solve_limb(measured, view.radius_px, min_length_px=self.options.scan.spacing_px)
        if altitude_km:
            solution = replace(solution, corrections=Corrections(limb_altitude_km=altitude_km))
        unknown = inputs.geometry.target.uncertainty.pole_unknown  # no turn from it then
        if not (inputs.place_alone or measured.terrain or sigma_km or unknown):  # relief and haze: not in the outline
            solution = replace(solution, turn=self._turn(lines, view, body, inputs))
        return fix_of_strained(inputs, measured, solution, self.options)

    def _lines(self, view: LimbView, body: Body, *, in_haze: bool) -> LineMeasurement | Failure:
        """Measure the limb, in haze with its attenuation; without that where lines do not converge with it.

        Squared errors of 25 unseen views of ``benchmarks/stress.py`` in declared haze go from 2.0 to 0.9 of the
        covariance with it; in 25 others, with scattered light in addition, to 1.1. Haze that is detected after a fix
        has no altitude, and no law here; the two errors partly cancel.
        """
        if in_haze:
            laws = (*OTHER_LAWS, *haze_laws(body.reflectance)[:1])
            lines = measure_by_lines(view, body, self.options, self.options.scan, other_laws=laws)
            if not isinstance(lines, Failure):
                return lines
        return measure_by_lines(view, body, self.options, self.options.scan)

    def _turn(self, measured: LineMeasurement, view: LimbView, body: Body, inputs: EstimatorInputs) -> BodyTurn | None:
        options, scan = self.options, self.options.scan
        share = _attitude_share(inputs, unit(measured.position_camera_km))

        def measure_turned(position_camera_km: Float, turn_rad: Float) -> LimbMeasurement | Failure:
            turned = replace(body, camera_from_body=Rotation.from_rotvec(turn_rad) * body.camera_from_body)
            sun = rotate(Rotation.from_rotvec(share * turn_rad), view.sun_direction_camera)
            lit = replace(view, sun_direction_camera=sun)
            return measure_once(lit, turned.at(position_camera_km), options, scan, psf_px2=measured.psf_px2)

        return limb_turn(
            measured, measure_turned, inputs.camera, view.radius_px, search=options, min_length_px=scan.spacing_px
        )


def _with_facets(measured: LimbMeasurement, mesh: TriangleMesh) -> LimbMeasurement:
    """Limb of a mesh with the common error of all points by flat facets.

    The outline of a mesh whose vertices lie on the body is a polygon: its sides leave out ``L^2 / (12 R)`` on average,
    and its corners, which lie before or behind the limb, ``L^2 / (24 R)``, with sides L and radius R.
    """
    square_km2 = 4.0 / math.sqrt(3.0) * mesh.area_km2 / len(mesh.faces)  # of a side of equilateral facets
    gap_px = square_km2 / (8.0 * mesh.mean_radius_km) * np.linalg.norm(measured.design, axis=1)
    known_px = measured.common_px.get(Cause.RELIEF, np.empty((len(gap_px), 0)))
    common_px = {**measured.common_px, Cause.RELIEF: np.column_stack([known_px, gap_px])}
    return replace(measured, common_px=common_px)


def _attitude_share(inputs: EstimatorInputs, sight: Float) -> float:
    """Fraction of a turn about the line of sight (3,) attributed to the camera, which turns the Sun too."""
    known, covariance_rad2 = inputs.geometry.target.uncertainty, inputs.image.attitude_covariance_rad2
    if covariance_rad2 is None:
        return 1.0
    axis = rotate(inputs.geometry.camera_from_body.inv(), sight)
    of_body = float(axis**2 @ [known.pole_rad**2, known.pole_rad**2, known.spin_rad**2])
    of_camera = float(sight @ covariance_rad2 @ sight)
    return of_camera / (of_camera + of_body) if of_camera > 0.0 else 0.0
