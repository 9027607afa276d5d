"""Images: pixels with mask, epoch, attitude and observer."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, Mask, as_finite, as_image, require, require_number
from giantlike.core.detector import Detector
from giantlike.core.display import Pictured
from giantlike.core.errors import InputError
from giantlike.core.frames import INERTIAL_FRAME, FrameRotation
from giantlike.core.gamma import GammaCurve
from giantlike.core.observer import ObserverState
from giantlike.core.outcomes import AttitudeErrors, AttitudeFix
from giantlike.core.pixel_noise import EightBitValues
from giantlike.core.time import et_from_time, utc_text
from giantlike.core.values import Value
from giantlike.io.image_files import read_image_file
from giantlike.processing.calibration_frames import CalibrationFrames

if TYPE_CHECKING:
    from astropy.time import Time

__all__ = ["AttitudeSource", "Image", "ObserverState"]


class AttitudeSource(StrEnum):
    """Source of the attitude of an image; with the values used in ``attitudes.csv``."""

    NONE = "none"
    A_PRIORI = "a_priori"
    STARS = "stars"
    INTERPOLATED = "interpolated"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class Image(Pictured, Value):
    """One image as an immutable value; :meth:`with_attitude` returns a new one.

    Parameters
    ----------
    pixels : (rows, columns) real numbers, DN; as stored, rows never reordered; made read-only
    mask : (rows, columns) bool, optional; True where a pixel is bad; default: nowhere
    epoch : astropy Time, optional; mid-exposure
    exposure_s : float, s, optional; exposure time
    camera_from_inertial : scipy Rotation, optional; attitude, a priori or improved
    attitude_source : AttitudeSource, optional; default: ``a_priori`` when there is an attitude, else ``none``
    attitude_covariance_rad2 : (3, 3) float64, rad^2, camera axes, optional; as in ``AttitudeFix``
    attitude_errors : AttitudeErrors; covariance by cause, share in errors of the camera, inherited flags
    observer : ObserverState, optional; spacecraft state, for parallax and aberration
    metadata : mapping; header values as read
    name : str; name in tables and messages
    path : Path, optional; the file
    sha256 : str; SHA-256 of the file, for provenance
    camera_name : str; name of the camera that took the image and whose axes the attitude refers to; empty when unknown
    detector : Detector, optional; where it differs from the camera's, as after :meth:`calibrated`
    eight_bit : EightBitValues, optional; of an 8-bit JPEG or PNG file, which may be coded for display

    Raises
    ------
    InputError
        Pixels are not a two-dimensional array of real numbers, or the mask has another shape.
    """

    pixels: NDArray[Any]
    mask: Mask = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    epoch: Time | None = None
    exposure_s: float | None = None
    camera_from_inertial: Rotation | None = None
    attitude_source: AttitudeSource = AttitudeSource.NONE
    attitude_covariance_rad2: Float | None = None
    attitude_errors: AttitudeErrors = field(default_factory=AttitudeErrors)
    observer: ObserverState | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    name: str = "image"
    path: Path | None = None
    sha256: str = ""
    camera_name: str = ""
    detector: Detector | None = None
    eight_bit: EightBitValues | None = None

    def __post_init__(self) -> None:
        pixels = as_image(self.pixels, f"{self.name}: pixels")
        mask = np.asarray(self.mask, dtype=bool)
        bad = np.zeros(pixels.shape, dtype=bool) if mask.size == 0 else mask.copy()
        require(bad.shape == pixels.shape, f"{self.name}: mask shape {bad.shape} differs from pixels {pixels.shape}")
        if pixels.dtype.kind == "f" and not np.isfinite(pixels).all():
            bad |= ~np.isfinite(pixels)
            pixels = np.where(bad, 0, pixels).astype(pixels.dtype)
        if self.exposure_s is not None:
            require_number(self.exposure_s, f"{self.name}: exposure_s", least=0.0)
        if self.camera_from_inertial is not None and self.attitude_source is AttitudeSource.NONE:
            object.__setattr__(self, "attitude_source", AttitudeSource.A_PRIORI)
        self._keep(pixels=pixels, mask=bad, metadata=dict(self.metadata))

    def __repr__(self) -> str:
        epoch = "no epoch" if self.epoch is None else utc_text(self.epoch)
        size = f"{self.columns} x {self.rows} {self.pixels.dtype}"
        return f"Image({self.name!r}, {size}, {epoch}, attitude: {self.attitude_source})"

    @classmethod
    def open(cls, path: str | Path, *, hdu: int | str | None = None, bottom_up: bool = False) -> Image:
        """Read a FITS, PNG, TIFF, JPEG, VICAR, PDS3, PDS4 or ISIS file.

        Parameters
        ----------
        path : path-like
        hdu : int or str, optional; number or name of the FITS extension; the first with an image by default
        bottom_up : bool
            True to reverse the rows on reading, for files whose first row is the bottom of the picture, as in many
            telescope images: as stored they show the sky mirrored, which no attitude can represent. Pixel coordinates
            then refer to the reversed image.

        Raises
        ------
        DataError
            The file is missing, damaged or of a format that is not supported.
        """
        file = read_image_file(path, hdu=hdu, bottom_up=bottom_up)
        return cls(
            pixels=file.pixels,
            mask=file.mask,
            epoch=file.epoch,
            exposure_s=file.exposure_s,
            camera_from_inertial=file.camera_from_inertial,
            observer=file.observer,
            metadata=file.header,
            name=Path(path).name,
            path=Path(path),
            sha256=file.sha256,
            eight_bit=file.eight_bit,
        )

    @property
    def rows(self) -> int:
        """Number of rows."""
        return int(self.pixels.shape[0])

    @property
    def columns(self) -> int:
        """Number of columns."""
        return int(self.pixels.shape[1])

    @property
    def et(self) -> float | None:
        """Mid-exposure in TDB seconds past J2000; None where the epoch is not known."""
        return None if self.epoch is None else et_from_time(self.epoch)

    @property
    def step_dn(self) -> float | None:
        """Step of the values by the format of the file, DN; None where the values themselves have to show it."""
        return None if self.eight_bit is None else self.eight_bit.step_dn

    @property
    def limit_dn(self) -> float:
        """Largest value that the pixels can hold by their type or file, DN; infinite where none is known."""
        if self.eight_bit is not None:
            return self.eight_bit.full_scale_dn
        return float(np.iinfo(self.pixels.dtype).max) if self.pixels.dtype.kind in "iu" else math.inf

    def linearized(self, detector: Detector) -> Image:
        """Return the image with linearized values, where its detector, else that of the camera, declares their gamma.

        Itself without a gamma. Else its ``detector`` has the noise of the values times the squared slope of the curve;
        0 above bias and the full scale (255 of 8-bit files, else the declared saturation or the end of an integer type)
        are as before.

        Raises
        ------
        InputError
            There is a gamma, but the values have no known full scale.
        """
        own = self.detector or detector
        if own.gamma is None:
            return self
        full_dn = self.limit_dn if self.eight_bit is not None else min(self.limit_dn, own.saturation_dn)
        require(
            math.isfinite(full_dn),
            f"{self.name}: a gamma of floating point values needs saturation_dn, the value of the full scale",
        )
        curve = GammaCurve(gamma=own.gamma, full_scale_dn=full_dn - own.bias_dn)
        known = own.of_image(self.pixels, self.mask, step_dn=self.step_dn)
        known = dataclasses.replace(known, saturation_dn=min(known.saturation_dn, self.limit_dn))
        light = known.bias_dn + curve.light_dn(self.pixels.astype(np.float64) - known.bias_dn)
        return dataclasses.replace(self, pixels=light, detector=known.of_light(curve), eight_bit=None)

    def calibrated(self, frames: CalibrationFrames, detector: Detector) -> Image:
        """Return the image without bias, dark current and differences of response; ``detector`` of the camera.

        The ``detector`` of the result knows the noise of the frames; hot and dead pixels are in its mask. Estimators
        and star navigation use that detector instead of the camera's.

        Raises
        ------
        InputError
            The frames have another size, the exposure is not known, or the image is calibrated already.
        """
        require(self.detector is None, f"{self.name}: the image is calibrated already")
        try:
            done = frames.apply(self.pixels, detector, exposure_s=self.exposure_s, mask=self.mask)
        except InputError as error:
            raise InputError(f"{self.name}: {error}") from error
        return dataclasses.replace(self, pixels=done.pixels, mask=done.mask, detector=done.detector, eight_bit=None)

    def with_observer(self, position_km: ArrayLike, velocity_km_s: ArrayLike) -> Image:
        """Return a new image taken from another place: light time and aberration follow from it.

        Parameters
        ----------
        position_km : (3,) array_like, km; of the camera from the solar system barycenter at mid-exposure, ICRF axes
        velocity_km_s : (3,) array_like, km/s
        """
        vectors = [as_finite(position_km, (3,), "position_km"), as_finite(velocity_km_s, (3,), "velocity_km_s")]
        return dataclasses.replace(self, observer=ObserverState(position_km=vectors[0], velocity_km_s=vectors[1]))

    def with_attitude(
        self,
        attitude: AttitudeFix | FrameRotation | Rotation,
        *,
        source: AttitudeSource | None = None,
        covariance_rad2: ArrayLike | None = None,
        errors: AttitudeErrors | None = None,
    ) -> Image:
        """Return a new image with another attitude.

        Parameters
        ----------
        attitude : AttitudeFix, FrameRotation or Rotation
            A star solution, whose covariance is used too, or ``camera_from_inertial``. The first two name the camera
            whose axes they refer to, which must be the camera of this image where both are known.
        source : AttitudeSource, optional; default: ``stars`` for a fix, ``a_priori`` for a rotation
        covariance_rad2 : (3, 3) array_like, rad^2, camera axes, optional; of a rotation; a fix brings its own
        errors : AttitudeErrors, optional; of a rotation; a fix brings its own

        Raises
        ------
        FrameMismatchError
            The attitude is one of another camera, or its source is not the inertial frame.
        InputError
            The covariance has another shape or is not finite.
        """
        camera_name, default = self.camera_name, AttitudeSource.A_PRIORI
        covariance = None if covariance_rad2 is None else as_finite(covariance_rad2, (3, 3), "covariance_rad2")
        if isinstance(attitude, AttitudeFix):
            default, covariance, errors = AttitudeSource.STARS, attitude.covariance_rad2, attitude.errors
            attitude = FrameRotation(
                rotation=attitude.camera_from_inertial, target=attitude.camera_name, source=INERTIAL_FRAME
            )
        if isinstance(attitude, FrameRotation):
            camera_name = camera_name or attitude.target
            attitude = attitude.between(camera_name, INERTIAL_FRAME)
        return dataclasses.replace(
            self,
            camera_from_inertial=attitude,
            attitude_source=source or default,
            attitude_covariance_rad2=covariance,
            attitude_errors=AttitudeErrors() if errors is None else errors,
            camera_name=camera_name,
        )
