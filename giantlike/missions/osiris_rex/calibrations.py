"""Table 1 and Figs. 2 to 6: the cameras calibrated from simulated star fields."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.calibration import CalibrationResult
from giantlike.calibration.star_images import StarImage, calibrate_stars, identify_first
from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.outcomes import Failure
from giantlike.core.time import et_from_time, time_from_et, time_from_utc
from giantlike.core.units import RAD_PER_ARCSEC, RAD_PER_DEG, SECONDS_PER_DAY
from giantlike.core.values import Value
from giantlike.image import Image, ObserverState
from giantlike.missions.osiris_rex.images import Exposure, Taker, sky_for
from giantlike.missions.osiris_rex.setup import CameraSetup, MissionSetup
from giantlike.processing.detection.options import DetectionOptions
from giantlike.stars import StarNavigation, StarOptions

_FIRST_UTC = "2017-09-20T00:00:00"  # epoch of the first image, in cruise [assumed]
_DAYS = 10.0  # time from one image to the next [assumed]
_CELLS = 4  # cells along a side of the field in which means of residuals are tested
_SCALE_ERROR = 0.05
"""Largest error of the nominal focal length that the identification allows for; they are stated to two digits."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraCalibration(Value):
    """A calibration and its truth."""

    key: str  # key, label: of the camera
    label: str
    truth: Float  # (k,); parameters of Table 1, in the order of ``result.estimated``
    found: Float  # (k,)
    result: CalibrationResult
    camera: Camera  # the calibrated camera, at 0 degrees Celsius
    images: int  # number of star images taken

    @property
    def squared_distance(self) -> float:
        """Squared error of all parameters over their covariance; k on average where the covariance is correct."""
        error = self.found - self.truth
        return float(error @ np.linalg.solve(self.result.covariance, error))

    @property
    def residual_std_px(self) -> float:
        """Standard deviation of the residuals of the stars used, per axis, px."""
        return float(np.std(self.result.residuals_px[self.result.used]))

    def structure(self) -> tuple[float, int]:
        """Squared means of residuals in cells of the field over their variances, summed, and their number."""
        used = self.result.used
        residuals = self.result.residuals_px[used] / self.result.sigma_px[used, None]
        scale = np.mean(residuals**2)
        place = np.floor(self.result.observed_px[used] / [self.result.columns, self.result.rows] * _CELLS)
        number = np.clip(place, 0, _CELLS - 1) @ [1, _CELLS]
        sums = [residuals[number == each].sum(axis=0) ** 2 / np.sum(number == each) for each in np.unique(number)]
        return float(np.sum(sums) / scale), 2 * len(sums)


def calibrate_camera(
    mission: MissionSetup, key: str, *, images: int, seed: int, progress: Callable[[str, int, int], None]
) -> CameraCalibration:
    """Take star images with a camera of Table 1 and calibrate it from them.

    It starts from a nominal focal length, no distortion and the middle of the frame, as the paper does.
    """
    setup, declared = mission.cameras[key], mission.declared_camera(key)
    rng = np.random.default_rng([seed, 20, sum(key.encode())])
    attitudes = [Rotation.random(random_state=rng) for _ in range(images)]
    catalog = sky_for(mission, key, attitudes, seed=seed)
    taker = Taker(key=key, catalog=catalog, body=None, seed=seed)
    options = StarOptions(max_magnitude=mission.max_magnitude(key), all_stars=True)
    detection = DetectionOptions(threshold_sigma=mission.threshold_sigma)
    navigation = StarNavigation(declared, catalog, options, detection=detection)
    identified: list[StarImage] = []
    for number, temperature_c in enumerate(np.linspace(*setup.temperatures_c, images).tolist()):
        exposure = _exposure(mission, setup, attitudes[number], (seed, number))
        wrong = Rotation.from_rotvec(mission.pointing.attitude_error_deg * RAD_PER_DEG * rng.normal(size=3))
        position, velocity = mission.orbit.state(exposure.et)
        apriori = Image(
            pixels=taker.take(exposure, (seed, number), temperature_c)[0],
            epoch=time_from_et(exposure.et),
            exposure_s=exposure.exposure_s,
            camera_from_inertial=wrong * attitudes[number],
            observer=ObserverState(position_km=position, velocity_km_s=velocity),
            name=exposure.name,
        )
        found = identify_first(apriori, declared, navigation, scale_error=_SCALE_ERROR, temperature_c=temperature_c)
        if not isinstance(found, Failure):
            identified.append(found)
        progress(f"calibration of {setup.label}", number + 1, images)
    result = calibrate_stars(identified, declared, estimate=setup.estimated, stars=options).unwrap().result
    return CameraCalibration(
        key=key,
        label=setup.label,
        truth=np.array([getattr(setup.model, name) for name in result.estimated]),
        found=np.array([getattr(result.model, name) for name in result.estimated]),
        result=result,
        camera=dataclasses.replace(declared, model=result.model),
        images=images,
    )


def _exposure(mission: MissionSetup, setup: CameraSetup, attitude: Rotation, seed: tuple[int, int]) -> Exposure:
    """An exposure of stars in cruise, along the orbit of Bennu; ``seed`` ends with the number of the image."""
    turn = np.random.default_rng([seed[0], 21, seed[1]]).normal(size=3)
    return Exposure(
        name=f"{setup.key} {seed[1] + 1}",
        et=et_from_time(time_from_utc(_FIRST_UTC)) + seed[1] * _DAYS * SECONDS_PER_DAY,
        exposure_s=setup.long_exposure_s,
        camera_from_inertial=attitude,
        state_km=np.zeros(6),
        rate_rad_s=mission.pointing.rate_arcsec_s * RAD_PER_ARCSEC * turn,
    )
