"""Passes image by image: truth, the declared trajectory and attitude, and what the images give.

Images of the Moon are made and measured. Most of the Earth are simulated as limb points; the errors of edges, a shift
outward and to the Sun and a scatter, are measured on full images of the same pass, for every exposure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from giantlike.camera_models import BrownModel
from giantlike.core.arrays import Float
from giantlike.core.outcomes import Failure
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.core.values import Value
from giantlike.independent import ReliefBody
from giantlike.missions.artemis1.images import ImageWindow, earth_shot, limb_px, moon_shot
from giantlike.missions.artemis1.measure import iterative, non_iterative, residual_px
from giantlike.missions.artemis1.passes import SUN_AZIMUTH_DEG, Pass, Setting, sun_direction, times_of
from giantlike.missions.replay import ReplaySettings
from giantlike.relative.horizon.geometry import Altitude, CraMethod, christian_robinson, horizon_residuals

VELOCITY_SIGMA_KM_S = 2e-4
"""Error of the velocity of the trajectory, assumed: a range error that grows by a fifth of itself in a pass."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeErrors:
    """Errors of edges in images, relative to the limb of an ellipsoid."""

    toward_sun_px: float  # toward_sun_px, outward_px: shift of the fitted center along the Sun, and of the radius
    outward_px: float
    scatter_px: float  # root mean square of the points about the fit


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Track(Value):
    """Truth and knowledge of n images of a pass."""

    times_s: Float  # (n,); tags, about the middle of the pass
    true_km: Float  # (n, 3), camera axes; position of the body when the shutter was open
    known_km: Float  # (n, 3), camera axes; by trajectory and attitude at the tag
    rates_km_s: Float  # (n, 3), camera axes; of the known position
    exposures_us: Float  # (n,), microseconds


def track_of(setting: Setting, one: Pass, rng: np.random.Generator) -> Track:
    """Draw the track of a pass and its errors."""
    attitude, times = setting.data["attitude"], times_of(setting, one)
    range_sigma_km, pointing_px = setting.knowledge(one.target)
    pointing = pointing_px / setting.model.fx_px
    bias = rng.normal(size=2) * pointing / math.sqrt(2.0)
    off_km = rng.normal() * range_sigma_km + rng.normal() * VELOCITY_SIGMA_KM_S * times
    ranges = one.range_km + one.range_rate_km_s * times
    # The vehicle turns to and fro in its deadband, mostly across the Sun.
    rate = attitude["rate_arcsec_s"] / ARCSEC_PER_RAD
    swing = rate * np.array([0.2, 1.0])
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    period_s = np.array([410.0, 310.0])
    argument = 2.0 * np.pi * times[:, None] / period_s + phase
    angles = swing * period_s / (2.0 * np.pi) * np.sin(argument)
    turning = swing * np.cos(argument)
    spikes = rng.random(times.size) < attitude["spike_share"]
    late = rng.normal(size=times.size) * np.where(spikes, attitude["spike_s"], attitude["jitter_s"])
    noise = rng.normal(size=(times.size, 2)) * attitude["noise_arcsec"] / ARCSEC_PER_RAD
    seen, told = angles + late[:, None] * turning, angles + bias + noise
    truth = _positions(seen, ranges + late * one.range_rate_km_s)
    known = _positions(told, ranges + off_km)
    slope = np.column_stack([turning * ranges[:, None], np.full(times.size, one.range_rate_km_s)])
    return Track(
        times_s=times,
        true_km=truth,
        known_km=known,
        rates_km_s=slope,
        exposures_us=exposures_of(setting, times.size) if one.target == "earth" else np.zeros(times.size),
    )


def _positions(angles: Float, ranges_km: Float) -> Float:
    """Positions (n, 3), km, at angles (n, 2) to the right and down of the boresight."""
    ways = np.column_stack([np.tan(angles), np.ones(len(angles))])
    result: Float = ways / np.linalg.norm(ways, axis=1)[:, None] * ranges_km[:, None]
    return result


def exposures_of(setting: Setting, count: int) -> Float:
    """Exposures (n,), microseconds, of the automatic control: a step down when pixels are full, up when all are dark.

    At the shortest exposure the Earth is too dark and one step up it is too bright, so that the control toggles.
    """
    earth = setting.data["earth"]
    rule, full = earth["exposures_us"], earth["saturating_exposure_us"]
    exposure, taken = rule["first"], []
    for _ in range(count):
        taken.append(exposure)
        if exposure > full:
            exposure = max(exposure - rule["step"], rule["least"])
        elif exposure < earth["too_dark"] * full:
            exposure = max(rule["step"], exposure)
    return np.array(taken)


def edge_errors(setting: Setting, one: Pass, exposure_us: float, rng: np.random.Generator, count: int) -> EdgeErrors:
    """Measure errors of edges, relative to the limb of an ellipsoid, on full images of the Earth."""
    sun, figure = sun_direction(one.phase_deg), setting.figure(one.target)
    radius_km = float(figure.radii_km.mean())
    found, scatter = [], []
    for _ in range(count):
        aside = rng.uniform(-20.0, 20.0, 2) / setting.model.fx_px
        position = _positions(aside[None], np.array([one.range_km]))[0]
        shot = earth_shot(setting, position, sun, exposure_us, rng)
        fitted = non_iterative(setting, shot, sun, figure)
        if isinstance(fitted, Failure):
            continue
        found.append(residual_px(shot.model, radius_km, fitted[0], position, sun))
        points = fitted[1] - shot.corner_px
        scatter.append(float(np.std(horizon_residuals(points, shot.model, figure, fitted[0])[0])))
    mean = np.mean(found, axis=0)
    return EdgeErrors(toward_sun_px=float(mean[0]), outward_px=float(mean[2]), scatter_px=float(np.mean(scatter)))


def limb_points(setting: Setting, one: Pass, position: Float, errors: EdgeErrors, rng: np.random.Generator) -> Float:
    """Limb points (n, 2), px, of one image of a pass."""
    limb = setting.data["limb"]
    half = math.radians(limb["arc_deg"]) / 2.0
    angles = math.radians(SUN_AZIMUTH_DEG) + np.linspace(-half, half, limb["points"])
    points, normals = limb_px(setting.model, setting.figure(one.target), position, angles)
    sun = sun_direction(one.phase_deg)[:2]
    toward = normals @ (sun / np.linalg.norm(sun))
    shift: Float = errors.outward_px + errors.toward_sun_px * toward + errors.scatter_px * rng.normal(size=angles.size)
    return points + shift[:, None] * normals


def positions_of(setting: Setting, one: Pass, points: list[Float], limb_altitude_km: float = 0.0) -> Float:
    """Positions (n, 3), km, camera axes, by the Christian-Robinson algorithm from limb points of n images."""
    seen = Altitude(limb_altitude_km).above(setting.figure(one.target))
    found = []
    for each in points:
        position = christian_robinson(each, setting.model, seen, method=CraMethod.TOTAL_LEAST_SQUARES)
        found.append(position.unwrap() if isinstance(position, Failure) else position)
    return np.array(found)


def residuals_of(
    setting: Setting, one: Pass, found_km: Float, known_km: Float, model: BrownModel | None = None
) -> Float:
    """Residuals (n, 3), px, of positions: along the Sun, across it, radius; in a camera without distortion, or one."""
    sun, radius_km = sun_direction(one.phase_deg), float(setting.figure(one.target).radii_km.mean())
    pairs = zip(found_km, known_km, strict=True)
    return np.array([residual_px(model or setting.model, radius_km, *pair, sun) for pair in pairs]).reshape(-1, 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MoonPass(Value):
    """A pass of the Moon: n images through the lens as it was, measured with the camera calibrated before.

    residuals_px, iterative_px, uncalibrated_px, truth_px: (n, 3); along the Sun, across, radius: of the algorithm that
        does not iterate and of the other (pass 3 alone) against the trajectory, of the first with the first camera of
        the flight, and against the truth.
    """

    one: Pass
    track: Track  # of the images with a fix
    residuals_px: Float
    iterative_px: Float
    uncalibrated_px: Float
    truth_px: Float
    first: tuple[ImageWindow, Float, Float]  # the first image, its position, km, and its limb points, px
    failed: int  # images without a fix


def fly_moon(
    setting: Setting,
    one: Pass,
    body: ReliefBody,
    cameras: tuple[BrownModel, BrownModel, BrownModel],
    settings: ReplaySettings,
) -> MoonPass:
    """Take and measure the images of a pass; ``cameras``: the lens, its calibration, and the first of the flight."""
    rng = np.random.default_rng([settings.seed, one.number])
    if settings.change == "noisy_images" and one.number == 3:
        noise_e = 30.0 * setting.detector.read_noise_e
        setting = replace(setting, detector=replace(setting.detector, read_noise_e=noise_e))
    images, track = setting.data["images"], track_of(setting, one, rng)
    most = images["small" if settings.small else "full"].get(str(one.number), images["other"])
    track = select_rows_of(track, np.unique(np.linspace(0, track.times_s.size - 1, most).astype(np.intp)))
    lens, camera, early = cameras
    figure, sun = setting.figure("moon"), sun_direction(one.phase_deg)
    measured = []
    for k, position in enumerate(track.true_km):
        settings.progress(f"images of pass {one.number}", k, len(track.true_km))
        shot = moon_shot(setting, body, one, position, lens, camera, rng)
        first = non_iterative(setting, shot, sun, figure)
        if isinstance(first, Failure):
            continue
        second = iterative(setting, shot, sun, figure, first[0]) if one.number == 3 else first[0]
        third = christian_robinson(first[1], early, figure, method=CraMethod.TOTAL_LEAST_SQUARES)
        if isinstance(second, Failure) or isinstance(third, Failure):
            continue
        measured.append((k, (shot, *first), first[0], second, third))
    rows, firsts, found, iterated, again = zip(*measured, strict=True)
    seen = select_rows_of(track, np.array(rows, dtype=np.intp))
    return MoonPass(
        one=one,
        track=seen,
        residuals_px=residuals_of(setting, one, np.array(found), seen.known_km, camera),
        iterative_px=residuals_of(setting, one, np.array(iterated), seen.known_km, camera),
        uncalibrated_px=residuals_of(setting, one, np.array(again), seen.known_km, early),
        truth_px=residuals_of(setting, one, np.array(found), seen.true_km, camera),
        first=firsts[0],
        failed=len(track.times_s) - len(rows),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FlownPass(Value):
    """A pass of the Earth with its measurements.

    residuals_px: (n, 3); of the algorithm that does not iterate, with the altitude of the limb that flew: along the
        Sun, across, radius.
    """

    one: Pass
    track: Track  # of the n images that were simulated
    points_px: tuple[Float, ...]  # tuple of (m, 2); limb points of each image
    edges: Mapping[float, EdgeErrors]  # by exposure, microseconds
    residuals_px: Float


def fly(setting: Setting, one: Pass, settings: ReplaySettings) -> FlownPass:
    """Simulate a pass of the Earth: every image as limb points, with errors of edges from full images."""
    rng = np.random.default_rng([settings.seed, one.number])
    track = track_of(setting, one, rng)
    if settings.small:
        track = select_rows_of(track, np.arange(3, track.times_s.size, 5))
    levels = sorted(set(track.exposures_us.tolist()))  # the first two are usual, the others of the first images only
    edges = {
        level: edge_errors(setting, one, level, rng, 1 if settings.small or level not in levels[:2] else 2)
        for level in levels
    }
    points = [
        limb_points(setting, one, position, edges[level], rng)
        for position, level in zip(track.true_km, track.exposures_us.tolist(), strict=True)
    ]
    found = positions_of(setting, one, points, setting.data["earth"]["assumed_limb_km"])
    return FlownPass(
        one=one,
        track=track,
        points_px=tuple(points),
        edges=edges,
        residuals_px=residuals_of(setting, one, found, track.known_km),
    )


def select_rows_of(track: Track, which: NDArray[np.intp]) -> Track:
    """Some of the images of a track."""
    names = ("times_s", "true_km", "known_km", "rates_km_s", "exposures_us")
    return replace(track, **{name: getattr(track, name)[which] for name in names})
