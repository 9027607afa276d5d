"""Thirty calibrations on star fields, three iterations each, and the interlock of two star trackers: Figs. 4 and 5."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from giantlike.calibration import CalibrationResult
from giantlike.calibration.alignment import align
from giantlike.calibration.star_images import calibrate_stars, identify_first
from giantlike.camera import Camera
from giantlike.camera_models import BrownModel
from giantlike.core.arrays import Float, unit
from giantlike.core.outcomes import Failure
from giantlike.core.time import time_from_et
from giantlike.core.units import ARCSEC_PER_RAD, AU_KM
from giantlike.core.values import Value
from giantlike.gauntlet.stage import catalog_of
from giantlike.image import Image, ObserverState
from giantlike.independent import StarField, random_stars
from giantlike.missions.artemis1.images import star_shot
from giantlike.missions.artemis1.passes import Setting
from giantlike.missions.artemis1.report import BLUE, GRAY, RED
from giantlike.missions.replay import (
    DERIVED,
    INDEPENDENT,
    INPUT,
    SELF_CHECK,
    Comparison,
    ReplayFigure,
    ReplaySettings,
    Section,
    Stated,
)
from giantlike.stars import StarNavigation, StarOptions

_STRUCK_IMAGE = 4  # "in the fifth image, a cluster of bright pixels"
_SCALE_ERROR = 0.01  # largest error of the focal length of the ground that identification allows for [assumed]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Session(Value):
    """A calibration of the flight: the fits of its iterations, and the true attitudes of its star images."""

    number: int  # from 0: pass n follows number n - 1
    fits: tuple[CalibrationResult, ...]
    true: Mapping[str, Rotation]  # by the name of the image

    @property
    def camera(self) -> BrownModel:
        """Model of the last iteration."""
        model = self.fits[-1].model
        assert isinstance(model, BrownModel)
        return model


def lens_of(setting: Setting, seed: int, number: int) -> BrownModel:
    """Lens as it was on the day of a calibration: shifted after launch, and wandering."""
    rules, ground = setting.data["calibration"], ground_model(setting)
    wander = np.random.default_rng([seed, 4, number]).normal(size=len(rules["wander"]))
    by = dict(rules["shift"])
    for (name, size), drawn in zip(rules["wander"].items(), wander.tolist(), strict=True):
        by[name] = by.get(name, 0.0) + size * drawn
    return replace(ground, **{name: getattr(ground, name) + value for name, value in by.items()})


def ground_model(setting: Setting) -> BrownModel:
    """Lens as it was calibrated on the ground."""
    return BrownModel(**asdict(setting.model), **setting.data["calibration"]["ground"])


def run_sessions(
    setting: Setting, settings: ReplaySettings, numbers: Sequence[int] | None = None
) -> tuple[Session, ...]:
    """Run the calibrations of the flight, or those of some numbers."""
    rules = setting.data["calibration"]
    rng = np.random.default_rng([settings.seed, 5])
    faint = tuple(rules["magnitudes"])
    field = random_stars(rng, rules["stars"], axis=(0.0, 0.0, 1.0), radius_rad=np.pi, magnitudes=faint)
    numbers = numbers or (rules["small_numbers"] if settings.small else range(rules["count"]))
    return tuple(_run_session(setting, number, field, settings) for number in numbers)


def _run_session(setting: Setting, number: int, field: StarField, settings: ReplaySettings) -> Session:
    """Take star images, identify their stars once, and fit the camera in several iterations to these."""
    rules, rng = setting.data["calibration"], np.random.default_rng([settings.seed, 6, number])
    data, lens = setting.data["camera"], lens_of(setting, settings.seed, number)
    camera = Camera(
        name="Orion",
        columns=data["columns"],
        rows=data["rows"],
        model=ground_model(setting),
        psf=setting.psf,
        detector=setting.detector,
    )
    navigation = StarNavigation(camera, catalog_of(field), StarOptions(max_magnitude=rules["max_magnitude"]))
    true, identified = {}, []
    count = rules["small_images" if settings.small else "images"]
    for k in range(count):
        settings.progress(f"star images of calibration {number + 1}", k, count)
        name, attitude = f"image {k + 1}", Rotation.random(random_state=rng)
        wrong = Rotation.from_rotvec(rules["interlock_arcsec"][0] / ARCSEC_PER_RAD * rng.normal(size=3))
        struck = number == rules["struck"] and k == _STRUCK_IMAGE
        image = Image(
            pixels=star_shot(setting, field, attitude, lens, rng, struck=struck),
            epoch=time_from_et(0.0),
            exposure_s=1.0,
            camera_from_inertial=wrong * attitude,
            observer=ObserverState(position_km=np.array([AU_KM, 0.0, 0.0]), velocity_km_s=np.zeros(3)),
            name=name,
        )
        found = identify_first(image, camera, navigation, scale_error=_SCALE_ERROR)
        if not isinstance(found, Failure):
            true[name] = attitude
            identified.append(found)
    fits: list[CalibrationResult] = []
    for _ in range(rules["iterations"]):
        start = replace(camera, model=fits[-1].model) if fits else camera
        fits.append(calibrate_stars(identified, start, estimate=rules["estimate"]).unwrap().result)
    return Session(number=number, fits=tuple(fits), true=true)


def _interlock_arcsec(
    result: CalibrationResult, session: Session, turn: Rotation, rules: Mapping[str, Any], rng: np.random.Generator
) -> float:
    """Angle, arcsec, between the estimated attitude of a star tracker and its attitude on the ground."""
    sigma = np.array(rules["tracker_arcsec"]) / ARCSEC_PER_RAD
    noise = Rotation.from_rotvec(sigma * rng.normal(size=(len(result.images), 3)))
    true = Rotation.concatenate([session.true[image.name] for image in result.images])
    camera_from_inertial = Rotation.concatenate([image.camera_from_reference for image in result.images])
    aligned = align(  # on the ground both have the same axes
        noise * turn * true * camera_from_inertial.inv(),
        np.array([np.diag(sigma**2) + image.covariance_rad2 for image in result.images]),
    ).unwrap()
    return float(aligned.rotation.magnitude()) * ARCSEC_PER_RAD


def _interlocks_arcsec(setting: Setting, sessions: Sequence[Session], settings: ReplaySettings) -> Float:
    """Change (2, n) of the angle of each star tracker from the ground, of all iterations; NaN where there is none."""
    rules = setting.data["calibration"]
    rng = np.random.default_rng([settings.seed, 4])
    axes, interlocks = unit(rng.normal(size=(3, 3))), []
    for session in sessions:
        tracker_seed = int(rng.integers(2**31))
        wander = rules["interlock_wander_arcsec"] * rng.normal(size=(2, 3))
        for index, result in zip(_indices([session]), session.fits, strict=True):
            warm = rules["thermal_arcsec"] if rules["warm"][0] <= index <= rules["warm"][1] else 0.0
            angles = []
            for tracker in range(2):
                blind = tracker == 1 and any(low <= index <= high for low, high in rules["blind"])
                arcsec = rules["interlock_arcsec"][tracker] * axes[tracker] + warm * axes[2] + wander[tracker]
                turn = Rotation.from_rotvec(arcsec / ARCSEC_PER_RAD)
                noise = np.random.default_rng(tracker_seed + tracker)
                angles.append(np.nan if blind else _interlock_arcsec(result, session, turn, rules, noise))
            interlocks.append(angles)
    return np.array(interlocks).T


def _indices(sessions: Sequence[Session]) -> Float:
    """Indices (n,) of all iterations from the first calibration of the flight on."""
    return np.array([len(each.fits) * each.number + k for each in sessions for k in range(len(each.fits))], dtype=float)


def calibration_section(setting: Setting, sessions: Sequence[Session], settings: ReplaySettings) -> Section:
    """Figures 4 and 5."""
    rules, indices = setting.data["calibration"], _indices(sessions)
    interlocks = _interlocks_arcsec(setting, sessions, settings)
    ground = np.array([getattr(ground_model(setting), name) for name in rules["estimate"]])
    fits = [result for session in sessions for result in session.fits]
    values = np.array([[getattr(each.model, name) for name in rules["estimate"]] for each in fits])
    sigmas = np.array([np.sqrt(np.diagonal(each.covariance)) for each in fits])
    parameters = Figure(figsize=(7.4, 7.0), layout="constrained")
    for k, (axis, name) in enumerate(zip(parameters.subplots(4, 2).ravel(), rules["estimate"], strict=True)):
        axis.errorbar(indices, values[:, k], sigmas[:, k], fmt=".", markersize=3, color=BLUE, linewidth=0.6)
        axis.axhline(ground[k], color=GRAY, linestyle="--", linewidth=0.9)
        axis.set_ylabel(name)
        axis.grid(alpha=0.25)
    interlock = Figure(figsize=(7.0, 3.0), layout="constrained")
    axis = interlock.subplots()
    for row, color, name in zip(interlocks, (BLUE, RED), ("star tracker 1", "star tracker 2"), strict=True):
        axis.plot(indices, row, ".", color=color, markersize=5, label=name)
    axis.axvspan(*rules["warm"], color="#f3d9a4", alpha=0.5)
    axis.set_xlabel("index of calibration")
    axis.set_ylabel("change from the ground, arcsec")
    axis.legend(fontsize=8)
    axis.grid(alpha=0.25)
    return Section(
        title="Calibration in flight (IV.A)",
        text=f"{rules['count']} calibrations of {rules['images']} images of stars and {rules['iterations']} "
        "iterations, on images by the independent renderer through the lens as it was, whose stars are identified "
        "from an attitude 100 arcsec off; the principal point is held, as flown. Each is the camera of the next pass.",
        figures=(
            ReplayFigure(
                "Fig. 4",
                "Parameters of the camera by calibration",
                "With their standard deviations; dashed: on the ground.",
                parameters,
            ),
            ReplayFigure(
                "Fig. 5",
                "Interlock of both star trackers against the ground",
                "Shaded: the optical bench in sunlight. The second is blind at 42 to 50 and 53 to 55.",
                interlock,
            ),
        ),
        comparisons=(
            *_of_parameters(sessions, values, sigmas, ground, rules),
            *_of_strike(sessions, rules),
            *_of_interlock(indices, interlocks, rules),
        ),
    )


def _of_parameters(
    sessions: Sequence[Session], values: Float, sigmas: Float, ground: Float, rules: Mapping[str, Any]
) -> list[Comparison]:
    """Parameters of the camera: Fig. 4."""
    names, every = list(rules["estimate"]), rules["iterations"]
    final = values[every - 1 :: every]
    means, spread = final.mean(axis=0), final.std(axis=0, ddof=1)
    change = np.abs(final - values[every - 2 :: every]) / sigmas[every - 1 :: every]
    map_px = max(float(np.max(each.map_sigma_px)) for session in sessions for each in session.fits)
    relative = {name: float(spread[k] / abs(means[k])) for k, name in enumerate(names)}
    shifted = int((np.abs(means - ground) > 5.0 * spread / np.sqrt(len(final))).sum())
    return [
        Stated(
            "IV.A", "data points of each parameter", 90.0, float(rules["count"] * rules["iterations"]), DERIVED
        ).within(0.0, "30 calibrations of 3 iterations"),
        Stated(
            "Fig. 4",
            "parameters that shifted between ground and flight, of 8",
            "an initial shift in several model parameters",
            str(shifted),
            INPUT,
        ).agrees(shifted >= 2, "agrees from two, by five standard deviations of the mean; the shifts were put in"),
        Stated(
            "IV.A",
            "change of parameters from the second to the third iteration, in sigmas, largest",
            "three iterations to ensure convergence",
            f"{float(change.max()):.2g}",
            SELF_CHECK,
        ).agrees(change.max() < 0.1, "agrees below a tenth of a sigma"),
        Stated(
            "Fig. 4",
            "scatter of k2 and k3 between calibrations over their means, and of k1",
            "k2 and k3 fluctuate significantly",
            f"{relative['k2']:.1f}, {relative['k3']:.1f}; k1 {relative['k1']:.2f}",
            INDEPENDENT,
            "quiet_stars",
        ).agrees(
            min(relative["k2"], relative["k3"]) > 0.5 and relative["k1"] < min(relative["k2"], relative["k3"]),
            "agrees where both scatter by more than half of their means, and k1 less: it follows from the "
            "field and the noise",
        ),
        Stated(
            "IV.A",
            "largest uncertainty of the map over the field, px, all calibrations",
            "their impact on the model is relatively small",
            round(map_px, 3),
            SELF_CHECK,
        ).agrees(map_px < 0.25, "agrees below the 0.27 px of the better pointing"),
    ]


def _of_strike(sessions: Sequence[Session], rules: Mapping[str, Any]) -> list[Comparison]:
    """The calibration that failed: Fig. 3."""
    fit = next(session.fits[-1] for session in sessions if session.number == rules["struck"])
    sigmas = max((each.sigmas for each in fit.rejected if each.image == f"image {_STRUCK_IMAGE + 1}"), default=0.0)
    accepted = fit.accepted and sigmas > 0.0
    return [
        Stated(
            "Fig. 3",
            "residual of a star beside which radiation struck the image, in sigmas of its centroid",
            "large residual, which violated the acceptance criteria",
            round(sigmas, 1),
            INPUT,
        ).agrees(sigmas > 5.0, "agrees beyond five; its place was put in"),
        Stated(
            "IV.A",
            "calibration with the strike, once outliers are rejected",
            "software updated to reject such outliers rather than fail",
            "accepted" if accepted else "refused",
            SELF_CHECK,
        ).agrees(accepted, "agrees where it is accepted"),
    ]


def _of_interlock(indices: Float, interlocks: Float, rules: Mapping[str, Any]) -> list[Comparison]:
    """Star trackers: Fig. 5."""
    warm = (indices >= rules["warm"][0]) & (indices <= rules["warm"][1])
    first, second = interlocks
    step = abs(float(first[warm].mean() - first[~warm].mean())) if warm.any() else 0.0
    return [
        Stated(
            "Fig. 5", "shift of star tracker 1 from the ground, arcsec", 100.0, float(first[~warm].mean()), INPUT
        ).within(10.0, "put in, found again within a tenth"),
        Stated(
            "Fig. 5", "shift of star tracker 2 from the ground, arcsec", 100.0, float(np.nanmean(second)), INPUT
        ).within(20.0, "put in, found again within the thermal step"),
        Stated(
            "Fig. 5",
            "change of the interlock with the bench in sunlight, arcsec",
            "less than 20",
            round(step, 2),
            INPUT,
        ).agrees(
            step < 20.0 if warm.any() else None,
            "agrees below 20; a turn of 15 arcsec about an axis of its own was put in",
        ),
        Stated(
            "Fig. 5",
            "scatter of the interlock in flight out of sunlight, arcsec",
            "relatively stable across in-flight measurements",
            round(float(first[~warm].std()), 2),
            INPUT,
        ).agrees(
            first[~warm].std() < 20.0,
            "agrees below the thermal effect of 20; noise of trackers of 8 and 40 arcsec over 20 images, 2 "
            "arcsec put in",
        ),
    ]
