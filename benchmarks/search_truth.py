"""Sequences of classified sources with known tracks: clutter, hot pixels, stars that no catalog has, and particles.

Particles fly by :mod:`giantlike.independent.flight`, tumble, and are missed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import giantlike as gl
from giantlike import search
from giantlike.core.arrays import Float
from giantlike.dynamics import PointMasses
from giantlike.independent.flight import SmallBodyField

SIZE = 1024
PIXEL_RAD = 1.0e-4


def camera(size: int = SIZE) -> gl.Camera:
    """A square camera of 0.1 mrad a pixel."""
    return gl.Camera.from_fov(float(np.degrees(2.0 * np.arctan(size * PIXEL_RAD / 2.0))), size, size)


def as_residuals(
    view: gl.Camera, et: float, attitude: Rotation, points_px: Float, snr: Float, rng: np.random.Generator,
    *, attitude_rad: float = 0.0, sigma_px: Float | None = None,
) -> search.Residuals:  # fmt: skip
    """Sources at true places, seen with noise by their signal-to-noise ratio and through a wrong attitude."""
    n = len(points_px)
    sigma = 0.75 / snr + 0.02 if sigma_px is None else sigma_px
    seen = points_px + rng.normal(0.0, 1.0, (n, 2)) * sigma[:, None]
    believed = Rotation.from_rotvec(rng.normal(0.0, attitude_rad, 3)) * attitude
    return search.Residuals(
        name=f"image {et:g}",
        et=et,
        exposure_s=1.0,
        camera=view,
        camera_from_inertial=believed,
        attitude_rad2=attitude_rad**2 * np.eye(3),
        points_px=seen,
        covariance_px2=sigma[:, None, None] ** 2 * np.eye(2),
        directions_inertial=believed.inv().apply(np.array(view.model.unproject(seen)).reshape(-1, 3)),
        flux_dn=100.0 * snr,
        snr=snr,
        magnitude=np.full(n, np.nan),
        kinds=np.full(n, "unknown", dtype="<U24"),
        optics=np.ones(n),
        halves_px=np.zeros((n, 2)),
        half_sigma_px=np.zeros(n),
        linkable=np.ones(n, dtype=bool),
        covered=np.zeros((view.rows, view.columns), dtype=bool),
        threshold_sigma=5.0,
        reach_px=1.5,
    )


def empty_sequence(
    seed: int, *, images: int = 8, size: int = 256, most: int = 60, structure: bool = True
) -> list[search.Residuals]:
    """A sequence without anything that moves by itself.

    With ``structure``: the camera drifts and jitters over 30 uncataloged stars and 30 hot pixels, each seen now and
    then, ghosts that mirror the drift, and groups of particles beside each other.
    """
    rng, view = np.random.default_rng(seed), camera(size)
    stars, hot = rng.uniform(0.0, size, (2, 30, 2))
    seen_often = rng.uniform(0.1, 1.0, (2, 30))
    drift = rng.normal(0.0, 1.5, 2)
    sequence = []
    for k in range(images):
        off = drift * k + rng.normal(0.0, 0.5, 2)
        parts = [rng.uniform(0.0, size, (rng.integers(2, most), 2))]
        if structure:
            parts.append((stars + off)[rng.random(30) < seen_often[0]])
            parts.append(np.rint(hot)[rng.random(30) < seen_often[1]])
            group = rng.uniform(0.0, size, (rng.poisson(3), 2))
            parts.append((group[:, None] + rng.normal(0.0, 2.0, (len(group), 3, 2))).reshape(-1, 2))
        points = np.concatenate(parts)
        points = points[((points > 0.0) & (points < size - 1.0)).all(axis=1)]
        attitude = Rotation.from_rotvec([-off[1] * PIXEL_RAD, off[0] * PIXEL_RAD, 0.0])
        snr = 5.0 + rng.exponential(6.0, len(points))
        sequence.append(as_residuals(view, 10.0 * k, attitude, points, snr, rng, attitude_rad=0.05 * PIXEL_RAD))
    return sequence


def event(
    seed: int, *, particles: int = 350, images: int = 20, step_s: float = 60.0, range_km: float = 20.0
) -> tuple[list[search.Residuals], list[NDArray[np.int64]], float]:
    """Particles that leave a body of Bennu's gravity at their own times, over spurious sources.

    Speeds are those of an ejection of up to three times that of escape, brightness tumbles, and what falls below five
    sigma is missed. Also the number of the particle of each source (-1 for none), and the acceleration at the surface,
    px/s^2.
    """
    rng, view = np.random.default_rng(seed), camera()
    field = SmallBodyField(
        gm=4.89e-9, sun_gm=1.327e11, zonals={}, pole=np.array([0.0, 0.0, 1.0]),
        sun_km=lambda _: np.array([1.6e8, 0.0, 0.0]), sunlight=1e-10,
    )  # fmt: skip
    radius = 0.25
    outward = rng.normal(size=(particles, 3))
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    sideward = rng.normal(size=(particles, 3))
    sideward /= np.linalg.norm(sideward, axis=1)[:, None]
    speed = np.sqrt(2.0 * field.gm / radius) * rng.uniform(0.7, 3.0, particles)
    states = np.hstack([radius * outward, speed[:, None] * (outward + 0.4 * sideward)])
    span = images * step_s
    age = rng.uniform(0.0, 2.0 * span, particles)
    for k in range(particles):  # flown to the first image, each from its own ejection
        states[k] = field.coast(states[k : k + 1], -age[k], 0.0)[0]
    bright, swing = 7.0 * np.exp(rng.uniform(0.0, 1.8, particles)), rng.uniform(0.0, 0.6, particles)
    period, phase = rng.uniform(50.0, 2000.0, particles), rng.uniform(0.0, 2.0 * np.pi, particles)
    sequence, owners, time = [], [], 0.0
    for k in range(images):
        et = step_s * (k + (rng.random() < 0.1))  # a gap now and then
        if et <= time and k:
            et = time + 0.5 * step_s
        states, time = field.coast(states, time, et), et
        points = np.asarray(view.model.project(states[:, :3] + [0.0, 0.0, range_km]))
        snr = bright * (1.0 + swing * np.sin(2.0 * np.pi * time / period + phase)) + rng.normal(0.0, 1.0, particles)
        hidden = np.linalg.norm(points - (SIZE - 1) / 2, axis=1) < radius / range_km / PIXEL_RAD + 3.0
        inside = ((points > 2.0) & (points < SIZE - 3.0)).all(axis=1)
        seen = np.flatnonzero((snr > 5.0) & inside & ~hidden & (rng.random(particles) < 0.97))
        spurious = rng.integers(20, 201)
        places = np.concatenate([points[seen], rng.uniform(0.0, SIZE - 1.0, (spurious, 2))])
        ratio = np.concatenate([snr[seen], 5.0 + rng.exponential(6.0, spurious)])
        pointing = Rotation.from_rotvec(rng.normal(0.0, 3.0, 3) * PIXEL_RAD)
        moved = np.asarray(view.model.project(pointing.apply(np.asarray(view.model.unproject(places)))))
        one = as_residuals(view, time, pointing, moved, ratio, rng, attitude_rad=0.05 * PIXEL_RAD)
        sequence.append(one)
        owners.append(np.concatenate([seen, np.full(spurious, -1)]))
    return sequence, owners, field.gm / radius**2 / range_km / PIXEL_RAD


def orbit_track(
    seed: int, *, images: int = 16, step_s: float = 900.0, range_km: float = 20.0, noise_px: float = 0.1
) -> tuple[search.Track | None, Float, float, PointMasses, float]:
    """A track of one particle, its true state (6,) and time, and gravity as assumed, with its standard deviation.

    The gravity (2 %), the place of the spacecraft (20 m, in common to all images) and the attitudes (0.2 px) are wrong
    within what is declared.
    """
    rng, view = np.random.default_rng(seed), camera()
    gm, gm_sigma, craft_km, turn = 4.89e-9, 1e-10, 0.02, 0.2 * PIXEL_RAD
    field = SmallBodyField(
        gm=gm, sun_gm=0.0, zonals={}, pole=np.array([0.0, 0.0, 1.0]),
        sun_km=lambda _: np.array([1.6e8, 0.0, 0.0]), sunlight=0.0,
    )  # fmt: skip
    outward, sideward = rng.normal(size=(2, 3))
    outward /= np.linalg.norm(outward)
    sideward -= outward * (outward @ sideward)
    sideward /= np.linalg.norm(sideward)
    radius = rng.uniform(0.4, 0.8)
    speed = np.sqrt(gm / radius) * rng.uniform(0.85, 1.3)
    state = np.concatenate([radius * outward, speed * (sideward + rng.uniform(-0.3, 0.3) * outward)])[None]
    error_km = rng.normal(0.0, craft_km, 3)
    drift, sequence, states, time = rng.normal(0.0, 2e-4, 3), [], [], 0.0
    for k in range(images):
        state = field.coast(state, time, step_s * k)
        time = step_s * k
        states.append(state[0])
        body = np.array([0.0, 0.0, range_km]) + drift * time
        ray = body + state[0, :3]
        toward = Rotation.from_rotvec([body[1] / range_km, -body[0] / range_km, 0.0])  # the camera follows the body
        attitude = Rotation.from_rotvec(rng.normal(0.0, 30.0, 3) * PIXEL_RAD) * toward
        point = np.asarray(view.model.project(attitude.apply(ray)))
        if not ((point > 0.0) & (point < SIZE - 1.0)).all():
            continue
        light_s = float(np.linalg.norm(body)) / 299792.458
        one = as_residuals(
            view, time + light_s, attitude, point[None], np.array([20.0]), rng,
            attitude_rad=turn, sigma_px=np.array([np.hypot(noise_px, 0.1)]),
        )  # fmt: skip
        spread = noise_px**2 * np.eye(2)[None]
        sequence.append(replace(one, covariance_px2=spread, body_position_km=body + error_km, body_sigma_km=craft_km))
    options = search.LinkOptions(max_rate_px_s=0.3, max_acceleration_px_s2=2e-5, max_missed=3)
    assumed = PointMasses(gm + rng.normal(0.0, gm_sigma))
    found = [one for one in search.link(sequence, options) if len(one) >= 5]
    if not found:
        return None, np.zeros(6), 0.0, assumed, gm_sigma
    track = found[0]
    ranges = [np.linalg.norm(np.asarray(one.body_position_km)) for one in track.residuals]
    middle = track.et - float(np.mean(ranges)) / 299792.458
    before = max(k for k in range(images) if step_s * k <= middle)
    truth = field.coast(states[before][None], step_s * before, middle)[0]
    return track, truth, middle, assumed, gm_sigma
