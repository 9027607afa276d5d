"""Kinds in which optics, detector or transmission spoil the image; a body or stars alike."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from giantlike.core.arrays import Float
from giantlike.gauntlet import lights
from giantlike.gauntlet.plan import BIAS_DN, FULL_DN, PSF_PX, Light, Plan, Readout, World, log_uniform
from giantlike.independent import Defects, Psf

_DECLARED_SHARE = 0.6  # share of saturated images whose saturation is declared
_MASKED_SHARE = 0.3  # share of images with missing parts that come with a mask of them
WORD_BITS = 14  # bits of a pixel, the width of most converters
_BLOCK_PX = 16  # side of the blocks in which images are compressed and sent, px
_FLARE_WIDTH_PX = 1.5  # half width of a satellite trail, px: a little out of focus


def _lit(plan: Plan, light: Light, *, hard: bool) -> Plan:
    return plan.but(world={"lights": (*plan.world.lights, light)}, hard=hard)


def _read(plan: Plan, readout: Readout, *, hard: bool) -> Plan:
    return plan.but(world={"readouts": (*plan.world.readouts, readout)}, hard=hard)


def _level_dn(world: World) -> float:
    """Brightness that damage is measured by: the peak of the body, or a bright star, DN."""
    return world.peak_dn if world.sky is None else 1000.0


def _middle_px(world: World) -> np.ndarray:
    """Place of the body, or of the middle of the frame."""
    if world.body is None:
        return np.array([0.5 * world.view.columns, 0.5 * world.view.rows])
    return world.center_px


def stray_light(plan: Plan, rng: np.random.Generator) -> Plan:
    """A plane of light, and a glow from outside."""
    level = _level_dn(plan.world)
    amount = log_uniform(rng, 0.02, 0.8)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    size = plan.world.view.columns
    light = lights.background_light(
        slope_dn=(amount * level * math.cos(angle), amount * level * math.sin(angle)),
        glow_dn=amount * level,
        glow_px=tuple(0.5 * size + 0.9 * size * np.array([math.cos(angle), math.sin(angle)])),
        width_px=rng.uniform(0.3, 1.0) * size,
    )
    return _lit(plan, light, hard=amount > 0.2)


def glare(plan: Plan, rng: np.random.Generator) -> Plan:
    """A glow of a source close to the body."""
    world = plan.world
    width = log_uniform(rng, 8.0, 80.0)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    away = rng.uniform(0.2, 1.5) * 0.4 * world.view.columns
    light = lights.background_light(
        slope_dn=(0.0, 0.0),
        glow_dn=log_uniform(rng, 0.2, 4.0) * _level_dn(world),
        glow_px=tuple(_middle_px(world) + away * np.array([math.cos(angle), math.sin(angle)])),
        width_px=width,
    )
    return _lit(plan, light, hard=True)


def _shift(rng: np.random.Generator, least: float, most: float) -> tuple[int, int]:
    angle, length = rng.uniform(0.0, 2.0 * math.pi), log_uniform(rng, least, most)
    return round(length * math.cos(angle)), round(length * math.sin(angle))


def ghost(plan: Plan, rng: np.random.Generator) -> Plan:
    """A faint second image."""
    share = log_uniform(rng, 0.01, 0.3)
    light = lights.second_image(
        shift_px=_shift(rng, 10.0, 150.0), share=share, blur_px=log_uniform(rng, 0.5, 8.0), turned=rng.uniform() < 0.5
    )
    return _lit(plan, light, hard=share > 0.03)


def double_exposure(plan: Plan, rng: np.random.Generator) -> Plan:
    """Two exposures between which the camera moved by at least 5 px; a smaller motion has its midpoint as the truth."""
    light = lights.second_image(shift_px=_shift(rng, 5.0, 80.0), share=log_uniform(rng, 0.3, 1.0))
    return _lit(plan, light, hard=True)


def radiation(plan: Plan, rng: np.random.Generator) -> Plan:
    """Tracks of particles and hot pixels."""
    world = plan.world
    share = log_uniform(rng, 1e-3, 0.1)
    pixels = share * world.view.columns * world.view.rows
    defects = Defects(
        cosmic_rays=int(pixels / 5.0), cosmic_dn=log_uniform(rng, 100.0, 3000.0), hot_pixels=int(0.1 * pixels)
    )
    return plan.but(world={"defects": defects}, hard=share > 0.02)


def _columns_across(plan: Plan, rng: np.random.Generator, count: int) -> tuple[int, ...]:
    """Columns over the middle of the image, where the body is."""
    world = plan.world
    reach = 0.3 * world.view.columns
    places = np.round(_middle_px(world)[0] + rng.uniform(-reach, reach, count))
    return tuple(int(place) for place in np.clip(places, 0, world.view.columns - 1))


def hot_columns(plan: Plan, rng: np.random.Generator) -> Plan:
    """Columns with charge that they always have, below a random row."""
    count = int(log_uniform(rng, 1.0, 15.0))
    extra_dn = log_uniform(rng, 0.05, 1.0) * _level_dn(plan.world)
    columns = _columns_across(plan, rng, count)

    def add(pixels: Float, rng: np.random.Generator) -> Float:
        result = pixels.copy()
        for column in columns:
            first = int(rng.integers(0, max(len(pixels) // 2, 1)))
            charge = extra_dn * rng.uniform(0.5, 1.5)
            result[first:, column] += np.round(rng.poisson(charge, size=len(pixels) - first))
        return result

    return _read(plan, add, hard=count > 3)


def dead_rows(plan: Plan, rng: np.random.Generator) -> Plan:
    """Rows and columns without signal."""
    rows, columns = int(log_uniform(rng, 1.0, 12.0)), int(rng.integers(0, 3))
    world = plan.world
    reach = 0.3 * world.view.rows
    places = np.round(_middle_px(world)[1] + rng.uniform(-reach, reach, rows))
    defects = Defects(
        dead_rows=tuple(int(place) for place in np.clip(places, 0, world.view.rows - 1)),
        dead_columns=_columns_across(plan, rng, columns),
    )
    return plan.but(world={"defects": defects}, hard=rows + columns > 2)


def saturate(plan: Plan, rng: np.random.Generator, *, least_share: float, blooms: bool) -> Plan:
    """Values end below the brightest light, or charge flows along columns beyond that."""
    share = rng.uniform(least_share, 0.9)
    limit = BIAS_DN + share * _level_dn(plan.world)
    declared = rng.uniform() < _DECLARED_SHARE
    recorder = replace(plan.world.recorder, saturation_dn=float(np.round(limit)), blooms=blooms)
    told = {"saturation_dn": recorder.saturation_dn} if declared else {}
    return plan.but(world={"recorder": recorder}, told=told, hard=blooms or share < 0.5 or not declared)


def smear(plan: Plan, rng: np.random.Generator) -> Plan:
    """Transfer smear: every pixel of a column gets a little light of all others while the frame is read."""
    share = log_uniform(rng, 0.003, 0.2)

    def add(signal: Float, world: World, rng: np.random.Generator) -> Float:
        return np.asarray(signal + share * signal.mean(axis=0, keepdims=True))

    return _lit(plan, add, hard=share > 0.02)


def motion(plan: Plan, rng: np.random.Generator) -> Plan:
    """The camera rotated during the exposure."""
    angle, length = rng.uniform(0.0, math.pi), log_uniform(rng, 1.0, 30.0)
    path = (length * math.cos(angle), length * math.sin(angle))
    return plan.but(world={"psf": Psf(PSF_PX, motion_px=path)}, hard=length > 1.5)


def defocus(plan: Plan, rng: np.random.Generator) -> Plan:
    """Point spread function 1.5 to 8 times as wide as assumed."""
    return plan.but(world={"psf": Psf(PSF_PX * log_uniform(rng, 1.5, 8.0))}, hard=True)


def missing_lines(plan: Plan, rng: np.random.Generator) -> Plan:
    """Bands of lines that were not received: zero."""
    rows = plan.world.view.rows
    bands = tuple(
        (int(rng.integers(0, rows)), int(log_uniform(rng, 2.0, 0.25 * rows))) for _ in range(int(rng.integers(1, 5)))
    )

    def drop(pixels: Float, rng: np.random.Generator) -> Float:
        result = pixels.copy()
        for first, number in bands:
            result[first : first + number] = 0.0
        return result

    return _maybe_masked(_read(plan, drop, hard=True), rng)


def missing_blocks(plan: Plan, rng: np.random.Generator) -> Plan:
    """Compressed blocks that were not received: zero."""
    share = log_uniform(rng, 0.03, 0.4)

    def drop(pixels: Float, rng: np.random.Generator) -> Float:
        rows, columns = (-(-size // _BLOCK_PX) for size in pixels.shape)
        lost = rng.uniform(size=(rows, columns)) < share
        blocks = np.kron(lost, np.ones((_BLOCK_PX, _BLOCK_PX))) > 0
        return np.where(blocks[: pixels.shape[0], : pixels.shape[1]], 0.0, pixels)

    return _maybe_masked(_read(plan, drop, hard=True), rng)


def _maybe_masked(plan: Plan, rng: np.random.Generator) -> Plan:
    """Plan with a mask of the pixels that were not received, exactly zero, in some cases."""
    return plan.but(told={"mask": _is_zero} if rng.uniform() < _MASKED_SHARE else {}, hard=True)


def _is_zero(pixels: Float) -> Float:
    return np.asarray(pixels == 0.0)


def bit_flips(plan: Plan, rng: np.random.Generator) -> Plan:
    """Bit flips in memory, at any bit of a word."""
    share = log_uniform(rng, 1e-4, 0.05)

    def flip(pixels: Float, rng: np.random.Generator) -> Float:
        words = np.clip(pixels, 0.0, 2.0**WORD_BITS - 1.0).astype(np.int64)
        hit = rng.uniform(size=words.shape) < share
        words[hit] ^= 1 << rng.integers(0, WORD_BITS, size=int(hit.sum()))
        return words.astype(float)

    return _read(plan, flip, hard=share > 1e-3)


def satellites(plan: Plan, rng: np.random.Generator) -> Plan:
    """Bright, straight trails across the whole frame."""
    count = int(rng.integers(1, 8))
    brightness_dn = log_uniform(rng, 0.05, 2.0) * _level_dn(plan.world)

    def add(signal: Float, world: World, rng: np.random.Generator) -> Float:
        rows, columns = signal.shape
        y, x = np.mgrid[:rows, :columns].astype(float)
        for _ in range(count):
            angle = rng.uniform(0.0, math.pi)
            through = rng.uniform([0.0, 0.0], [columns, rows])
            away = (x - through[0]) * math.sin(angle) - (y - through[1]) * math.cos(angle)
            height = brightness_dn * rng.uniform(0.3, 1.0)
            signal = signal + height * np.exp(-0.5 * (away / _FLARE_WIDTH_PX) ** 2)
        return signal

    return _lit(plan, add, hard=True)


def reverse_columns(plan: Plan, rng: np.random.Generator) -> Plan:
    """Columns in the wrong order."""
    return _read(plan, lambda pixels, rng: np.ascontiguousarray(pixels[:, ::-1]), hard=True)


def reverse_rows(plan: Plan, rng: np.random.Generator) -> Plan:
    """Rows in the wrong order."""
    return _read(plan, lambda pixels, rng: np.ascontiguousarray(pixels[::-1]), hard=True)


def rows_shifted(plan: Plan, rng: np.random.Generator) -> Plan:
    """Rows moved along columns: each by a few random pixels, or all from one on, as where clock pulses were lost."""
    if rng.uniform() < 0.5:
        sigma_px = log_uniform(rng, 0.7, 6.0)

        def shake(pixels: Float, rng: np.random.Generator) -> Float:
            steps = np.round(sigma_px * rng.normal(size=len(pixels))).astype(int)
            return np.stack([np.roll(row, step) for row, step in zip(pixels, steps, strict=True)])

        return _read(plan, shake, hard=True)
    first = int(_break_row(plan, rng.uniform(-1.0, 1.0)))
    shift_px = int(np.ceil(log_uniform(rng, 1.0, 40.0)) * rng.choice([-1, 1]))

    def shift(pixels: Float, rng: np.random.Generator) -> Float:
        result = pixels.copy()
        result[first:] = np.roll(pixels[first:], shift_px, axis=1)
        return result

    return _read(plan, shift, hard=True)


def _break_row(plan: Plan, place: float) -> float:
    """Row at a position, -1 to 1, in the illuminated part of the body: a shift of all of it is undetectable."""
    world = plan.world
    middle = float(_middle_px(world)[1])
    if world.body is None:
        return middle + 0.1 * place * world.view.rows
    radius_px = world.body.bounding_radius_km / world.range_km * world.view.focal_px
    # The illuminated part of a sphere extends from -cos(phase) to 1 radii towards the Sun.
    cosine, across = math.cos(world.phase_rad), math.hypot(world.sun[0], world.sun[1])
    toward_sun = float(world.sun[1]) / max(across, 1e-9)
    return middle + 0.5 * radius_px * ((1.0 - cosine) * toward_sun + 0.6 * (1.0 + cosine) * place)


def eight_bit(plan: Plan, rng: np.random.Generator, *, square_root: bool) -> Plan:
    """Values on 255 steps, and a detector assumed in the new unit; the square-root coding is undeclared."""
    full = min(FULL_DN, BIAS_DN + _level_dn(plan.world) * log_uniform(rng, 1.2, 3.0))

    def put(pixels: Float, rng: np.random.Generator) -> Float:
        share = np.clip(pixels / full, 0.0, 1.0)
        return np.round(255.0 * (np.sqrt(share) if square_root else share))

    return _read(plan, put, hard=False).but(told={"dn_scale": 255.0 / full}, hard=square_root)
