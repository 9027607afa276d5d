"""The onboard filter on a pass of the Earth: 21 states in UDU factors, one of them the bias of the diameter."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.cislunar import BodyObservation, FilterModel, FilterState, measurement_update, time_update, udu_factors
from giantlike.cislunar.body_measurements import measure_body
from giantlike.core.arrays import Float, unit
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.dynamics import PointMasses
from giantlike.missions.artemis1.passes import Setting, preflight_sigmas_px
from giantlike.missions.artemis1.simulate import VELOCITY_SIGMA_KM_S, FlownPass, positions_of

_PARAMETERS = 15
_DIAMETER = 20
"""State that is the bias of the diameter of the disk, in focal lengths."""
_BIAS_SIGMA_KM = 20.0
"""A priori standard deviation of the bias of the radius: most of the 35 km assumed at first."""


def filter_bias_km(setting: Setting, flown: FlownPass) -> tuple[Float, Float]:
    """Bias of the radius of the Earth in a filter that is given positions processed with the limb that flew.

    Returns ``times_s`` (n,) and ``biases_km`` (n,).
    """
    track, one = flown.track, flown.one
    found = positions_of(setting, one, list(flown.points_px), setting.data["earth"]["assumed_limb_km"])
    range_sigma_km, pointing_px = setting.knowledge("earth")
    focal_px, radius_km = setting.model.fx_px, float(setting.figure("earth").radii_km.mean())
    attitude_rad = math.hypot(pointing_px / focal_px, setting.data["attitude"]["noise_arcsec"] / ARCSEC_PER_RAD)
    sigmas = np.zeros(_PARAMETERS)
    sigmas[:3] = attitude_rad
    sigmas[-1] = 2.0 * _BIAS_SIGMA_KM / one.range_km
    model = FilterModel(
        dynamics=PointMasses(0.0),  # the tracks are straight
        sigmas=sigmas,
        time_constants_s=np.full(_PARAMETERS, np.inf),
    )
    state = FilterState(
        float(track.times_s[0]),
        np.concatenate(
            [[0.0, 0.0, -np.linalg.norm(track.known_km[0])], [0.0, 0.0, -one.range_rate_km_s], np.zeros(15)]
        ),
        udu_factors(np.diag(np.concatenate([[range_sigma_km] * 3, [VELOCITY_SIGMA_KM_S] * 3, sigmas])) ** 2),
    )
    noise_px = 3.0 * preflight_sigmas_px("earth", one.range_km)  # three times, for exposures and late tags
    biases = []
    for k, time in enumerate(track.times_s.tolist()):
        state = time_update(state, time, model)
        measured = measure_body(found[k], radius_km)
        radius_px = focal_px * radius_km / measured[2]
        observation = BodyObservation(
            et=time,
            measured=measured,
            variances=np.array([*noise_px[:2] / focal_px, noise_px[2] / radius_px * measured[2]]) ** 2,
            camera_from_inertial=_turn_to(track.known_km[k]),
            body_position_km=np.zeros(3),
            radius_km=radius_km,
        )
        state, _ = measurement_update(state, observation, model)
        biases.append(-0.5 * float(state.mean[_DIAMETER]) * one.range_km)
    return track.times_s - track.times_s[0], np.array(biases)


def _turn_to(known_km: Float) -> Float:
    """Attitude (3, 3) as declared: the body lies along +z of the inertial axes, and there in the camera."""
    way = unit(known_km)
    axis = np.cross([0.0, 0.0, 1.0], way)
    sine = float(np.linalg.norm(axis))
    turn = Rotation.from_rotvec(axis / max(sine, 1e-300) * math.atan2(sine, float(way[2])))
    return np.asarray(turn.as_matrix(), dtype=np.float64)
