"""What every estimator of a body is: one interface, and the gathering of inputs that all of them share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.camera import Camera
from giantlike.camera_models import CameraModel, ifov_rad
from giantlike.core.arrays import Float, Mask
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import CenterFix, Failure, PositionFix, Quality, Reason
from giantlike.core.values import Value
from giantlike.core.version import VERSION
from giantlike.image import AttitudeSource, Image
from giantlike.ray_tracing import FocalPlane
from giantlike.scene import Scene, TargetGeometry

_ATTITUDE_FLAGS = MappingProxyType(
    {
        AttitudeSource.NONE: Quality.NONE,
        AttitudeSource.A_PRIORI: Quality.APRIORI_ATTITUDE,
        AttitudeSource.STARS: Quality.NONE,
        AttitudeSource.INTERPOLATED: Quality.INTERPOLATED_ATTITUDE,
    }
)


@runtime_checkable
class Estimator(Protocol):
    """Finds one body in one image; an object that holds options and nothing else."""

    name: ClassVar[str]
    """Name in campaign files and tables."""

    @property
    def options(self) -> Any:
        """The frozen options dataclass of the estimator."""
        ...

    def estimate(
        self, image: Image, camera: Camera, scene: Scene, target: str | None = None
    ) -> CenterFix | PositionFix | Failure:
        """Find a target of ``scene`` in ``image``; ``target`` may be left out when there is only one."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EstimatorInputs(Value):
    """What an estimator works on, gathered from image, camera and scene.

    Parameters
    ----------
    estimator : str
        Name of the estimator.
    image_name : str
        For messages.
    geometry : TargetGeometry
        A priori.
    camera : Camera
    predicted_px : (2,) float64, px
        Where the a priori geometry puts the body's center; may lie outside the frame.
    pixels_dn : (rows, columns) float64, DN
        Bias taken off.
    usable : (rows, columns) bool
        Neither bad nor saturated.
    saturated : (rows, columns) bool
        At or above the saturation level of the detector, or the largest value that the pixel type holds.
    masked : (rows, columns) bool
        Bad pixels of the image.
    flags : Quality
        What is known before the measurement: the source of the attitude.
    provenance : mapping of str to str
    """

    estimator: str
    image_name: str
    geometry: TargetGeometry
    camera: Camera
    predicted_px: Float
    pixels_dn: Float
    usable: Mask
    saturated: Mask
    masked: Mask
    flags: Quality
    provenance: Mapping[str, str]

    @property
    def target_name(self) -> str:
        """Name of the target."""
        return self.geometry.target.name

    @property
    def psf_sigma_px(self) -> float | None:
        """Standard deviation of the point spread function, px; None when the camera does not know it."""
        return None if self.camera.psf is None else self.camera.psf.sigma_px

    @property
    def radius_px(self) -> float:
        """Apparent mean radius of the body, px: that of the sphere of its volume at the predicted place."""
        return apparent_radius_px(
            self.camera, self.predicted_px, self.geometry.target.shape.mean_radius_km, self.geometry.range_km
        )

    @property
    def reach_px(self) -> float:
        """Apparent radius of the sphere around the body, px: nothing of it is seen farther from its center."""
        return apparent_radius_px(
            self.camera, self.predicted_px, self.geometry.target.shape.circumscribing_radius_km, self.geometry.range_km
        )

    def focal_plane(self, psf_sigma_px: float) -> FocalPlane:
        """Return the camera as renders take it, with a point spread function of ``psf_sigma_px``."""
        camera = self.camera
        psf = GaussianPsf(sigma_px=psf_sigma_px)
        return FocalPlane(model=camera.model, columns=camera.columns, rows=camera.rows, psf=psf)

    def fail(self, reason: Reason, detail: str) -> Failure:
        """Return a failure whose text starts with the image, the target and the estimator."""
        return Failure(reason, f"{self.image_name}: {self.target_name}: {self.estimator}: {detail}")

    def flags_at(self, area: Mask) -> Quality:
        """Flags for a measurement on the pixels ``area`` (rows, columns) bool: the shared ones and bad pixels on it."""
        flags = self.flags
        if bool((self.saturated & area).any()):
            flags |= Quality.SATURATED
        if bool((self.masked & area).any()):
            flags |= Quality.MASKED
        return flags


def gather(
    image: Image, camera: Camera, scene: Scene, target: str | None, *, estimator: str, options: object
) -> EstimatorInputs | Failure:
    """Collect and check what an estimator needs.

    Parameters
    ----------
    image : Image
    camera : Camera
    scene : Scene
    target : str or None
        None where the scene has one target.
    estimator : str
        Name of the estimator that asks.
    options : object
        Its options; their text goes into the provenance.

    Returns
    -------
    EstimatorInputs or Failure
        Failure when the image has no attitude, epoch or signal, is saturated all over, or when the body is behind the
        camera or around it.

    Raises
    ------
    InputError
        The image has another size than the camera, or there is no such target.
    DataError
        SPICE kernels do not cover the epoch.
    """
    camera.require_image(image)
    geometry = scene.geometry(image, target)
    if isinstance(geometry, Failure):
        return geometry
    saturated = image.pixels >= min(camera.detector.saturation_dn, _type_limit(image.pixels))
    predicted_px = camera.model.project(geometry.position_camera_km)
    inputs = EstimatorInputs(
        estimator=estimator,
        image_name=image.name,
        geometry=geometry,
        camera=camera,
        predicted_px=predicted_px,
        pixels_dn=image.pixels.astype(np.float64) - camera.detector.bias_dn,
        usable=~(image.mask | saturated),
        saturated=saturated & ~image.mask,
        masked=image.mask,
        flags=_ATTITUDE_FLAGS[image.attitude_source],
        provenance=_provenance(image, camera, geometry, options),
    )
    problem = _problem(inputs)
    return inputs if problem is None else inputs.fail(*problem)


def apparent_radius_px(camera: Camera, center_px: ArrayLike, radius_km: float, range_km: float) -> float:
    """Apparent radius, px, of a sphere of ``radius_km`` at ``range_km`` seen at ``center_px`` (2,).

    Outside the image the scale of the nearest image point is taken.
    """
    inside = np.clip(center_px, -0.5, [camera.columns - 0.5, camera.rows - 0.5])
    angle = math.asin(min(radius_km / range_km, 1.0))
    return angle / float(ifov_rad(camera.model, inside))


def position_of_center(model: CameraModel, center_px: Float, range_km: float, covariance: Float) -> tuple[Float, Float]:
    """Position of a body from its center in the image and its range.

    Parameters
    ----------
    model : CameraModel
    center_px : (2,) float64, px
    range_km : float, km
    covariance : (3, 3) float64
        Of x, y in px and of the natural logarithm of the range.

    Returns
    -------
    position_camera_km : (3,) float64, km, camera axes
    covariance_camera_km2 : (3, 3) float64, km^2, camera axes
    """
    line_of_sight = model.unproject(center_px)
    jacobian = range_km * np.concatenate([model.unproject_jacobian(center_px), line_of_sight[:, None]], axis=1)
    return range_km * line_of_sight, jacobian @ covariance @ jacobian.T


def center_of_position(
    model: CameraModel, position_camera_km: Float, covariance_camera_km2: Float
) -> tuple[Float, Float]:
    """Center of a body in the image (2,), px, and its covariance (2, 2), px^2, from its position (3,), km."""
    jacobian = model.project_jacobian(position_camera_km)
    return model.project(position_camera_km), jacobian @ covariance_camera_km2 @ jacobian.T


def _problem(inputs: EstimatorInputs) -> tuple[Reason, str] | None:
    """Why no estimator can work on these inputs, if so."""
    geometry = inputs.geometry
    if not inputs.usable.any():
        if inputs.saturated.any():
            return Reason.SATURATED, "every good pixel of the image is saturated; use a shorter exposure"
        return Reason.NO_SIGNAL, "every pixel of the image is masked"
    values = inputs.pixels_dn[inputs.usable]
    if not inputs.saturated.any() and float(values.min()) == float(values.max()):
        return Reason.NO_SIGNAL, f"every good pixel of the image holds {values[0] + inputs.camera.detector.bias_dn:g}"
    if geometry.range_km <= geometry.target.shape.circumscribing_radius_km:
        return Reason.DEGENERATE_GEOMETRY, f"at a range of {geometry.range_km:g} km the camera is inside the body"
    if not np.isfinite(inputs.predicted_px).all():
        return Reason.OUT_OF_FRAME, "the predicted center lies behind the camera or where its model images nothing"
    return None


def _type_limit(pixels: NDArray[Any]) -> float:
    """Largest value that integer pixels can hold: what reaches it was clipped."""
    return float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "iu" else math.inf


def _provenance(image: Image, camera: Camera, geometry: TargetGeometry, options: object) -> Mapping[str, str]:
    shape = geometry.target.shape
    return {
        "giantlike": VERSION,
        "image": image.name,
        "image_sha256": image.sha256,
        "camera": camera.name,
        "shape": shape.name,
        "shape_sha256": shape.sha256,
        "reflectance": repr(geometry.target.reflectance),
        "attitude_source": str(image.attitude_source),
        "options": repr(options),
    }
