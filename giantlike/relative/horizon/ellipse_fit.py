"""Ellipse fit: center and apparent diameter of a body from the edge of its lit limb, and its position from both."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, unit
from giantlike.core.outcomes import Failure, PositionFix, Quality, Reason
from giantlike.core.statistics import robust_sigma
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.processing.correlated_fit import generalized_solution, robust_solution
from giantlike.processing.geometry.conic_fit import ConicFit, conic_matrix, fit_ellipse
from giantlike.relative.estimator import EstimatorInputs, apparent_radius_px, center_of_position, gather
from giantlike.relative.horizon.ellipse_edges import EllipseFitOptions, LimbEdges, figure_of, limb_edges
from giantlike.relative.horizon.ellipsoid_cra import RELIEF_LENGTH, relief_of
from giantlike.relative.horizon.geometry import Figure, horizon_residuals
from giantlike.relative.quality import QualityChecks
from giantlike.scene import Scene
from giantlike.shapes import PlacedEllipsoid

__all__ = ["EllipseFit", "EllipseFitOptions", "position_of_cone"]


_ROUNDS = 3
_CORRELATION_PX = 2.0  # windows of neighboring edges share pixels
_GROWTH_ERROR = 0.4  # of what was taken off for changing brightness
_MAX_RANGE_SIGMA = 0.25
_STEP = 1e-4


class EllipseFit:
    """Position of a body from an ellipse through the edges of its lit limb.

    Edges are found by a scan along the sunlight, measured by Zernike moments, and taken through the camera model to the
    plane that touches the sphere of directions at the predicted place, where the horizon of an ellipsoid is an ellipse
    whatever the distortion. The ellipse is free in all its five parameters: neither the size nor the flattening is put
    in. Direction and range then follow from the cone over it and the known axes of the body. No reflectance law is
    used, and no law's error enters: what a brightness that changes inside the limb does to edges is told by windows of
    two sizes, and its uncertainty is in the covariance. In return the fit is several times less certain than that of
    ``ellipsoid_cra``, which knows the shape from the start.

    ``score`` of the fix is the root mean square of the residuals in px; ``residuals`` are distances across the ellipse,
    px, positive outside.

    Parameters
    ----------
    options : EllipseFitOptions

    References
    ----------
    .. [1] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation, "OpNav Target
       Identification" (center of a resolved body by an ellipse through its horizon points) and eqs. 8-13.
    .. [2] Inman et al., Artemis I optical navigation system performance, section III.A (scan, then moments).
    """

    name: ClassVar[str] = "ellipse_fit"

    def __init__(self, options: EllipseFitOptions | None = None) -> None:
        self.options = options or EllipseFitOptions()

    def estimate(self, image: Image, camera: Camera, scene: Scene, target: str | None = None) -> PositionFix | Failure:
        """Find a target of ``scene`` in ``image``; ``target`` may be left out when there is only one.

        Returns
        -------
        PositionFix or Failure
            ``WRONG_SHAPE`` for a body that is no ellipsoid; ``NO_LIMB``, ``OUT_OF_FRAME``, ``SATURATED``,
            ``DEGENERATE_GEOMETRY`` where the arc does not fix an ellipse, and what ``gather`` fails for.

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
        if not shape.mean_radius_km > 0.0:
            return inputs.fail(Reason.WRONG_SHAPE, "the target is a point: it has no limb")
        placed = shape.best_fit_ellipsoid
        relief_km = relief_of(shape, placed)
        if relief_km > self.options.max_relief * shape.mean_radius_km:
            return inputs.fail(
                Reason.WRONG_SHAPE,
                f"the shape departs from its best-fit ellipsoid by {relief_km / shape.mean_radius_km:.1%} of its "
                f"radius (rms), allowed {self.options.max_relief:.1%}",
            )
        limb = limb_edges(inputs, placed, self.options)
        if isinstance(limb, Failure):
            return limb
        relief_px = apparent_radius_px(camera, inputs.predicted_px, relief_km, inputs.geometry.range_km)
        return _fix(inputs, placed, limb, relief_px, self.options)


def position_of_cone(cone: Float, figure: Figure) -> Float | None:
    """Position of an ellipsoid whose horizon lies on a cone of directions.

    Parameters
    ----------
    cone : (3, 3) float64
        Symmetric, ``x . cone . x = 0`` for directions x of the horizon, positive inside.
    figure : Figure

    Returns
    -------
    (3,) float64, km, camera axes, or None
        None where the cone is none around an ellipsoid.

    Notes
    -----
    With the body as unit sphere the cone is ``n n^T - I``, up to scale: its eigenvalue of the other sign belongs to n,
    and over the mean of the two that are equal but for noise it is ``1 - n.n``; from there as in
    :func:`~giantlike.relative.horizon.geometry.christian_robinson`.
    """
    back = np.linalg.inv(figure.to_sphere)
    values, vectors = np.linalg.eigh(back.T @ cone @ back)
    across = 0.5 * float(values[0] + values[1])
    if not (values[2] > 0.0 > values[1]):
        return None
    axis = vectors[:, 2] * math.copysign(1.0, float((back @ vectors[:, 2])[2]))
    excess = -float(values[2]) / across
    result: Float = back @ axis * math.sqrt((1.0 + excess) / excess)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Plane(Value):
    """The plane that touches the sphere of directions at one of them."""

    camera_from_plane: Float

    @classmethod
    def touching(cls, direction: Float) -> _Plane:
        turn, _ = Rotation.align_vectors(direction[None], np.array([[0.0, 0.0, 1.0]]))
        return cls(np.asarray(turn.as_matrix(), dtype=np.float64))

    def points(self, model: CameraModel, points_px: Float) -> Float:
        """Pixels (n, 2) in the plane (n, 2), unit: the distance of the plane."""
        turned = model.unproject(points_px) @ self.camera_from_plane
        result: Float = turned[:, :2] / turned[:, 2:]
        return result

    def scale(self, model: CameraModel, points_px: Float, normals_px: Float) -> Float:
        """How far (n,) a step of one pixel along normals goes."""
        sides = [self.points(model, points_px + side * normals_px) for side in (0.5, -0.5)]
        result: Float = np.linalg.norm(sides[0] - sides[1], axis=1)
        return result

    def cone(self, coefficients: Float) -> Float:
        """The cone (3, 3) over a conic in the plane, camera axes."""
        result: Float = self.camera_from_plane @ conic_matrix(coefficients) @ self.camera_from_plane.T
        return result


def _fix(
    inputs: EstimatorInputs, placed: PlacedEllipsoid, limb: LimbEdges, relief_px: float, options: EllipseFitOptions
) -> PositionFix | Failure:
    """Fit the ellipse, take it to a position, and judge it."""
    model, edges = inputs.camera.model, limb.edges
    figure, center_km = figure_of(inputs, placed)
    plane = _Plane.touching(unit(center_km))
    points = plane.points(model, limb.points_px)
    scale = plane.scale(model, limb.points_px, edges.normals_px)
    kept = _agreeing(points, np.hypot(edges.sigma_px, relief_px) * scale, options)
    if isinstance(kept, Failure):
        return inputs.fail(kept.reason, kept.detail)
    step = math.ceil(np.count_nonzero(kept) / options.max_edges)
    order = np.argsort(np.arctan2(*(points[kept] - points[kept].mean(axis=0)).T))
    used = np.flatnonzero(kept)[order][::step]
    typical = float(np.median(scale))
    fit = fit_ellipse(points[used], sigma=(edges.sigma_px * scale)[used], correlation_length=_CORRELATION_PX * typical)
    if isinstance(fit, Failure):
        return inputs.fail(fit.reason, fit.detail)
    solved = _position(fit, plane, figure)
    if isinstance(solved, Failure):
        return inputs.fail(solved.reason, solved.detail)
    position_km, covariance_km2 = solved
    covariance_km2 = covariance_km2 + _systematic(
        inputs, limb.points_px[used], limb.correction_px[used], edges.sigma_px[used], figure, position_km, relief_px
    )
    return _judged(
        inputs,
        limb,
        used,
        n_used=int(kept.sum()),
        position_km=position_km - (center_km - inputs.geometry.position_camera_km),
        covariance_km2=covariance_km2,
        residuals_px=fit.residuals / scale[used],
        relief_px=relief_px,
        options=options,
    )


def _agreeing(points: Float, sigma: Float, options: EllipseFitOptions) -> Mask | Failure:
    """Points that lie on one ellipse, but for their noise and the scatter of all."""
    middle = points.mean(axis=0)
    size = float(np.sqrt(points.var(axis=0).sum()))
    x, y = ((points - middle) / size).T
    design = np.stack([x * x + y * y, x, y, x * x - y * y, 2 * x * y], axis=-1)
    keep: Mask = robust_solution(np.ones(len(x)), design, sigma / size, outlier_mad=options.outlier_mad)[1]
    for _ in range(_ROUNDS):
        if np.count_nonzero(keep) < options.min_edges:
            return Failure(
                Reason.NO_LIMB, f"{int(keep.sum())} of {len(x)} edges lie on one ellipse, needed {options.min_edges}"
            )
        fit = fit_ellipse(points[keep], sigma=sigma[keep])
        if isinstance(fit, Failure):
            return fit
        away = _distances(points, fit)
        scatter = robust_sigma(away[keep], 0.0)
        keep = np.abs(away) <= options.outlier_mad * np.hypot(sigma, scatter)
    return keep


def _distances(points: Float, fit: ConicFit) -> Float:
    """Distances (n,) of points from an ellipse, to first order."""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    gradient = 2.0 * homogeneous @ fit.matrix
    result: Float = -0.5 * np.einsum("ij,ij->i", gradient, homogeneous) / np.linalg.norm(gradient[:, :2], axis=1)
    return result


def _position(fit: ConicFit, plane: _Plane, figure: Figure) -> tuple[Float, Float] | Failure:
    """Position of the ellipsoid (3,), km, and covariance (3, 3) by the scatter of the points."""
    position = position_of_cone(plane.cone(fit.coefficients), figure)
    values, vectors = np.linalg.eigh(fit.covariance)
    moves = []
    for value, vector in zip(values, vectors.T, strict=True):
        arm = math.sqrt(max(float(value), 0.0)) * vector
        sides = [position_of_cone(plane.cone(fit.coefficients + side * _STEP * arm), figure) for side in (1.0, -1.0)]
        if sides[0] is None or sides[1] is None or position is None:
            return Failure(Reason.DEGENERATE_GEOMETRY, "the ellipse is not the horizon of the body: too short an arc")
        moves.append((sides[0] - sides[1]) / (2.0 * _STEP))
    if position is None:
        return Failure(Reason.DEGENERATE_GEOMETRY, "the ellipse is not the horizon of the body: too short an arc")
    spread = np.array(moves)
    return position, spread.T @ spread


def _systematic(
    inputs: EstimatorInputs,
    points_px: Float,
    correction_px: Float,
    sigma_px: Float,
    figure: Figure,
    position_km: Float,
    relief_px: float,
) -> Float:
    """Covariance (3, 3), km^2, by relief, and by what the correction for changing brightness leaves along a radian."""
    _, design, normals = horizon_residuals(points_px, inputs.camera.model, figure, position_km)
    by_ellipse = np.concatenate([design, _free_shape(normals)], axis=1)
    apart = np.linalg.norm(points_px[:, None] - points_px[None], axis=-1)
    left = _GROWTH_ERROR * float(np.sqrt(np.mean(correction_px**2)))
    shared = left**2 * np.exp(-apart / inputs.radius_px)
    shared += relief_px**2 * np.exp(-apart / (RELIEF_LENGTH * inputs.radius_px))
    covariance = generalized_solution(np.zeros(len(points_px)), by_ellipse, shared, weights=1.0 / sigma_px**2)[1]
    result: Float = covariance[:3, :3]
    return result


def _free_shape(normals: Float) -> Float:
    """The two ways (n, 2) in which the outline is free besides center and size: flattening along two directions."""
    x, y = normals.T
    return np.stack([x * x - y * y, 2 * x * y], axis=-1)


def _judged(
    inputs: EstimatorInputs,
    limb: LimbEdges,
    used: NDArray[np.intp],
    *,
    n_used: int,
    position_km: Float,
    covariance_km2: Float,
    residuals_px: Float,
    relief_px: float,
    options: EllipseFitOptions,
) -> PositionFix | Failure:
    """The fix with its flags, or why there is none."""
    center_px, covariance_px2 = center_of_position(inputs.camera.model, position_km, covariance_km2)
    range_km = float(np.linalg.norm(position_km))
    sight = position_km / range_km
    sigma_range = math.sqrt(float(sight @ covariance_km2 @ sight)) / range_km
    sigma_px = math.sqrt(float(np.linalg.eigvalsh(covariance_px2)[-1]))
    if not (sigma_range < _MAX_RANGE_SIGMA and sigma_px < inputs.radius_px):
        return inputs.fail(
            Reason.DEGENERATE_GEOMETRY,
            f"{n_used} edges do not fix an ellipse: sigma {sigma_px:.1f} px across and {sigma_range:.1%} of range",
        )
    area = np.zeros(inputs.usable.shape, dtype=bool)
    area[limb.edges.pixels_px[:, 1], limb.edges.pixels_px[:, 0]] = True
    rms_px = float(np.sqrt(np.mean(residuals_px**2)))
    checks = QualityChecks(
        off_px=center_px - inputs.predicted_px,
        search_px=options.search_px,
        range_ratio=inputs.geometry.range_km / range_km,
        search_range=options.search_range,
        n_used=n_used,
        n_offered=len(limb.edges),
        residuals=rms_px / (options.large_rms_px + 1.5 * relief_px),
        outline_share=n_used / (2.0 * math.pi * inputs.radius_px),
    )
    flags = inputs.flags_at(area) | checks.flags
    if relief_px > 0.0:
        flags |= Quality.SHAPE_APPROXIMATED
    return PositionFix(
        estimator=inputs.estimator,
        target=inputs.target_name,
        center_px=center_px,
        covariance_px2=covariance_px2,
        predicted_px=inputs.predicted_px,
        residuals=residuals_px,
        n_used=n_used,
        n_rejected=limb.n_found - n_used,
        score=rms_px,
        flags=flags,
        provenance=inputs.provenance,
        position_camera_km=position_km,
        covariance_camera_km2=covariance_km2,
        limb_px=limb.points_px[used],
    )
