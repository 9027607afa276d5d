"""Inputs of the estimators of a body, gathered from image, camera and scene."""

from __future__ import annotations

import functools
import math
import threading
import weakref
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from giantlike.camera import Camera
from giantlike.core.arrays import Float, Mask
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX, Detector, GaussianPsf
from giantlike.core.findings import Corrections, Response
from giantlike.core.outcomes import Failure, Quality, Reason
from giantlike.core.pixel_box import BoxPixels
from giantlike.core.values import Value
from giantlike.core.version import VERSION
from giantlike.image import AttitudeSource, Image
from giantlike.processing.detection.dead_lines import dead_lines
from giantlike.processing.detection.frame_lines import FrameLines
from giantlike.processing.detection.hot_lines import hot_lines
from giantlike.ray_tracing import FocalPlane
from giantlike.relative.place import apparent_radius_px
from giantlike.relative.response import DISPLAY_BEND_SIGMA
from giantlike.scene import Scene, TargetGeometry
from giantlike.shapes import Ellipsoid

ESTIMATED_NOISE = "estimated_noise"
"""Provenance key of fixes made without a declared detector: the noise estimated from the image."""
_PLATEAU_PIXELS = 20
"""Minimum number of pixels of exactly the largest value in a plateau: hot pixels are fewer, a saturated star has
more."""
_PLATEAU_SIGMAS, _PLATEAU_STEPS = 3.0, 3.0
"""Width of the band below the largest value, in standard deviations of the noise, and minimum, DN: without clipping the
noise distributes the brightest pixels over it."""

_IMPOSSIBLE_SIGMAS, _MOST_MISSING = 8.0, 0.5
"""Standard deviations of the noise below the bias from which a value common to many pixels was not received, and the
fraction of the frame from which rather the declared bias is wrong."""
_SPARSE = 16  # step along rows and columns between the pixels examined first

_ATTITUDE_FLAGS = MappingProxyType(
    {
        AttitudeSource.NONE: Quality.NONE,
        AttitudeSource.A_PRIORI: Quality.APRIORI_ATTITUDE,
        AttitudeSource.STARS: Quality.NONE,
        AttitudeSource.INTERPOLATED: Quality.INTERPOLATED_ATTITUDE,
    }
)


class FixIdentity(TypedDict):
    """Fields of a fix that follow from the inputs: keywords of :class:`~giantlike.core.outcomes.CenterFix`."""

    estimator: str
    target: str
    predicted_px: Float
    provenance: Mapping[str, str]
    corrections: Corrections


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EstimatorInputs(Value):
    """Inputs of an estimator, gathered from image, camera and scene.

    saturated: at or above the saturation level of the detector, the largest value that the pixel type holds, or the
        value at which clipping is detected in the image.
    masked: (rows, columns); bad pixels, detected lines without signal or with charge that is not light, and values that
        were not received.
    place_alone: True where only the position of the body is needed, for its derivative by declared values; the
        corrections of the fix are then kept.
    """

    estimator: str  # name of the estimator
    image: Image
    scene: Scene
    geometry: TargetGeometry  # A priori geometry of the target
    camera: Camera
    predicted_px: Float  # center of the body by the a priori geometry; may lie outside the frame
    pixels_dn: Float  # (rows, columns); bias subtracted
    usable: Mask  # pixels that are neither bad nor saturated
    saturated: Mask
    masked: Mask
    flags: Quality  # flags known before the measurement: the source of the attitude, and deficiencies of its star field
    provenance: Mapping[str, str]
    corrections: Corrections = field(default_factory=Corrections)  # known effects in the image
    place_alone: bool = False

    @property
    def target_name(self) -> str:
        """Name of the target."""
        return self.geometry.target.name

    @property
    def identity(self) -> FixIdentity:
        """Estimator, target, prediction, provenance and corrections, for the fix."""
        return FixIdentity(
            estimator=self.estimator,
            target=self.target_name,
            predicted_px=self.predicted_px,
            provenance=self.provenance,
            corrections=self.corrections,
        )

    @property
    def bend_sigma(self) -> float:
        """A priori standard deviation of the curvature of the response; 0 for values that are proportional to light.

        Values are where the camera declares its noise or its gamma, and where the format is not one for display.
        """
        unknown = self.image.eight_bit is not None and self.camera.detector.noise_of_image is not None
        return DISPLAY_BEND_SIGMA if unknown and self.corrections.response is None else 0.0

    @property
    def psf_sigma_px(self) -> float | None:
        """Standard deviation of the point spread function, px; None when the camera does not know it."""
        return None if self.camera.psf is None else self.camera.psf.sigma_px

    @property
    def pixels(self) -> BoxPixels:
        """The pixels of the image and their noise."""
        noise = self.camera.detector.variance_dn2
        censored = self.saturated if self.saturated.any() else None
        return BoxPixels(values_dn=self.pixels_dn, usable=self.usable, censored=censored, noise_variance_dn2=noise)

    @property
    def radius_px(self) -> float:
        """Apparent radius of the sphere of the body's volume at the predicted center, px."""
        return apparent_radius_px(
            self.camera, self.predicted_px, self.geometry.target.shape.mean_radius_km, self.geometry.range_km
        )

    @property
    def reach_px(self) -> float:
        """Apparent radius of the bounding sphere of the body, px."""
        return apparent_radius_px(
            self.camera, self.predicted_px, self.geometry.target.shape.circumscribing_radius_km, self.geometry.range_km
        )

    @property
    def seen_geometry(self) -> TargetGeometry:
        """The geometry, with the body in the orientation that was estimated from the image, if any."""
        turn, known = self.corrections.turn, self.geometry.camera_from_body
        return self.geometry if turn is None else replace(self.geometry, camera_from_body=turn.rotation * known)

    @property
    def turn_rad(self) -> float:
        """Declared standard deviation of the orientation of the body in the image, about any axis, rad."""
        known, attitude = self.geometry.target.uncertainty, self.image.attitude_covariance_rad2
        roll = 0.0 if attitude is None else float(attitude[2, 2])
        shape, unknown = self.geometry.target.shape, 0.0
        if known.pole_unknown and isinstance(shape, Ellipsoid):
            unknown = float(np.ptp(shape.radii_km)) / shape.mean_radius_km  # moves the outline as far as a turn by it
        return math.sqrt(known.pole_rad**2 + known.spin_rad**2 + roll + unknown**2)

    def focal_plane(self, psf_sigma_px: float | None = None) -> FocalPlane:
        """Return the focal plane for renders."""
        known = self.psf_sigma_px if psf_sigma_px is None else psf_sigma_px
        psf = GaussianPsf(sigma_px=UNKNOWN_PSF_SIGMA_PX if known is None else known)
        return FocalPlane(model=self.camera.model, columns=self.camera.columns, rows=self.camera.rows, psf=psf)

    def linearize(self, response: Response) -> EstimatorInputs:
        """Return the inputs with linearized values."""
        corrections = self.corrections | Corrections(response=response)
        return replace(self, pixels_dn=response.light_dn(self.pixels_dn), corrections=corrections)

    def straight_image(self, response: Response) -> Image:
        """Return the image with linearized values, and a detector with the corresponding saturation level."""
        detector, light_dn = self.camera.detector, response.light_dn(self.pixels_dn)
        if self.saturated.any():
            detector = replace(detector, saturation_dn=detector.bias_dn + float(light_dn[self.saturated].min()))
        return replace(self.image, pixels=light_dn + detector.bias_dn, detector=detector, eight_bit=None)

    def fail(self, reason: Reason, detail: str, *, not_applicable: bool = False) -> Failure:
        """Return a failure whose text starts with the image, the target and the estimator."""
        return Failure(reason, f"{self.image.name}: {self.target_name}: {self.estimator}: {detail}", not_applicable)

    def flags_at(self, area: Mask, corner_px: tuple[int, int] = (0, 0)) -> Quality:
        """Return the flags of the inputs for a measurement on some pixels.

        ``area`` (h, w); ``corner_px``: column and row of its first element.
        """
        flags, (x, y) = self.flags, corner_px
        part = slice(y, y + area.shape[0]), slice(x, x + area.shape[1])
        if bool((self.saturated[part] & area).any()):
            flags |= Quality.SATURATED
        if bool((self.masked[part] & area).any()):
            flags |= Quality.MASKED
        return flags


def gather(
    image: Image, camera: Camera, scene: Scene, target: str | None, *, estimator: str, options: object
) -> EstimatorInputs | Failure:
    """Collect and check the inputs of an estimator."""
    camera.require_image(image)
    geometry = scene.geometry(image, target)
    if isinstance(geometry, Failure):
        return geometry
    readout = _readout(image, image.detector or camera.detector)
    image, camera = readout.linear or image, replace(camera, detector=readout.detector)
    predicted_px = camera.model.project(geometry.position_camera_km)
    inputs = EstimatorInputs(
        estimator=estimator,
        image=image,
        scene=scene,
        geometry=geometry,
        camera=camera,
        predicted_px=predicted_px,
        pixels_dn=readout.pixels_dn,
        usable=readout.usable,
        saturated=readout.saturated,
        masked=readout.masked,
        flags=_ATTITUDE_FLAGS[image.attitude_source] | image.attitude_errors.flags,
        provenance=_provenance(image, camera, geometry, options),
    )
    problem = _problem(inputs)
    return inputs if problem is None else inputs.fail(*problem)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Readout(Value):
    """The pixels of an image as :class:`EstimatorInputs` has them, and the detector with all of its noise known."""

    detector: Detector
    pixels_dn: Float
    usable: Mask
    saturated: Mask
    masked: Mask
    linear: Image | None = None  # the image that these are of, where its values were linearized by a declared gamma

    @classmethod
    def from_image(cls, image: Image, detector: Detector) -> _Readout:
        """Readout of an image with the declared detector of its camera, or with the noise estimated from the image."""
        stored, image = image, image.linearized(detector)
        detector = image.detector or detector
        detector = detector.of_image(image.pixels, image.mask, step_dn=image.step_dn)
        frame = FrameLines.from_frame(image.pixels, detector.bias_dn)
        limit_dn = min(detector.saturation_dn, _type_limit(image.pixels), _plateau_dn(image, frame, detector))
        saturated = image.pixels >= limit_dn
        masked = _bad_pixels(image, frame, detector)
        usable = masked | saturated
        return cls(
            detector=detector,
            pixels_dn=frame.light_dn,
            usable=np.logical_not(usable, out=usable),
            saturated=saturated & ~masked if masked.any() else saturated,
            masked=masked,
            linear=None if image is stored else image,
        )


_LATEST: list[tuple[weakref.ref[Image], Detector, _Readout]] = []
"""Cache of the last image, as long as it exists: several estimators in turn use the same one."""
_LATEST_LOCK = threading.Lock()


def _readout(image: Image, detector: Detector) -> _Readout:
    """Cached readout of an image."""
    with _LATEST_LOCK:
        for known, stated, readout in _LATEST:
            if known() is image and stated == detector:
                return readout
        readout = _Readout.from_image(image, detector)
        _LATEST[:] = [(weakref.ref(image, lambda _: _LATEST.clear()), detector, readout)]
        return readout


def _bad_pixels(image: Image, frame: FrameLines, detector: Detector) -> Mask:
    """Mask of an image, with detected dead and hot rows and columns and with values that were not received."""
    noise_dn = math.sqrt(float(detector.variance_dn2(np.zeros(1))[0]))
    found = [
        dead_lines(frame, noise_dn=noise_dn),
        hot_lines(frame, noise_dn=noise_dn),
        _not_received(frame.light_dn, noise_dn),
    ]
    return functools.reduce(np.logical_or, (one for one in found if one is not None), image.mask)


def _not_received(light_dn: Float, noise_dn: float) -> Mask | None:
    """Pixels that hold one value far below the bias, and none a value near it; None where there are none."""
    least_dn = float(light_dn.min())
    if least_dn >= -_IMPOSSIBLE_SIGMAS * noise_dn:
        return None
    missing = light_dn == least_dn
    count = np.count_nonzero(missing)
    alone = count == np.count_nonzero(light_dn <= least_dn + max(_PLATEAU_SIGMAS * noise_dn, _PLATEAU_STEPS))
    return missing if alone and _PLATEAU_PIXELS <= count < _MOST_MISSING * missing.size else None


def _problem(inputs: EstimatorInputs) -> tuple[Reason, str] | None:
    """Reason and text where no estimator can use the inputs; None where they are good."""
    geometry = inputs.geometry
    if not inputs.usable.any():
        if inputs.saturated.any():
            return Reason.SATURATED, "every good pixel of the image is saturated; use a shorter exposure"
        return Reason.MASKED, "every pixel of the image is masked: no bad pixel is used; check the mask and the file"
    level = None if inputs.saturated.any() else _level_dn(inputs.pixels_dn, inputs.usable)
    if level is not None:
        return Reason.NO_SIGNAL, f"every good pixel of the image holds {level + inputs.camera.detector.bias_dn:g}"
    if geometry.range_km <= geometry.target.shape.circumscribing_radius_km:
        return Reason.DEGENERATE_GEOMETRY, f"at a range of {geometry.range_km:g} km the camera is inside the body"
    if not np.isfinite(inputs.predicted_px).all():
        return Reason.OUT_OF_FRAME, "the predicted center lies behind the camera or outside the field of its model"
    return None


def _level_dn(pixels_dn: Float, usable: Mask) -> float | None:
    """Value of all usable pixels (at least one) of an image; None where they differ."""
    for step in (_SPARSE, 1):  # pixels far apart differ nearly always
        values = pixels_dn[::step, ::step][usable[::step, ::step]]
        if values.size and float(values.min()) != float(values.max()):
            return None
    return float(values[0])


def _type_limit(pixels: NDArray[Any]) -> float:
    """Largest value of integer pixels, at which they are clipped."""
    return float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "iu" else math.inf


def _plateau_dn(image: Image, frame: FrameLines, detector: Detector) -> float:
    """Undeclared clipping level, DN, of an image; infinite where none is detected.

    A clipped image has more pixels of exactly the largest value than within the band of noise below it.
    """
    if image.mask.any():
        values = among = image.pixels[~image.mask]
    else:
        values, among = image.pixels, image.pixels[frame.largest_dn == frame.largest_dn.max()]
    if values.size == 0:
        return math.inf
    largest = among.max()
    at_top = int(np.count_nonzero(among == largest))
    if at_top < _PLATEAU_PIXELS or at_top == values.size:
        return math.inf
    top = float(largest)
    sigma = math.sqrt(float(detector.variance_dn2(np.array([top - detector.bias_dn]))[0]))
    below = values > top - max(_PLATEAU_SIGMAS * sigma, _PLATEAU_STEPS)
    return top if 2 * at_top > int(np.count_nonzero(below)) else math.inf


def _provenance(image: Image, camera: Camera, geometry: TargetGeometry, options: object) -> Mapping[str, str]:
    """Versions, hashes and names of the inputs, and the noise of the image where its camera declares none."""
    shape = geometry.target.shape
    noise = camera.detector.noise_of_image
    estimated = {} if noise is None else {ESTIMATED_NOISE: str(noise)}
    return estimated | {
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
