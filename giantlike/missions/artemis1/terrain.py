"""A made-up Moon: its ground, the limb of it that a camera sees, and a coarser map that predicts that limb."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.independent import SphereField, rough
from giantlike.missions.artemis1.passes import Pass, Setting
from giantlike.terrain import HeightMap, limb_profile

ANGLES = 720  # position angles of a limb
_STEP_DEG = 1.0
_WAVES, _CELLS, _LONGEST, _SHORTEST = 200, 128, 2.5, 60.0
"""Waves of the ground, cells of its table, and waves around the Moon: hills down to 90 km half across."""
_REACH_RAD, _ALONG = 0.15, 151  # ground to both sides of the limb that may stand above it, and places in it
_TURN_DEG = (137.5, 40.0)
"""Longitude from one pass to the next (the golden angle), and highest latitude, of the ground below the camera."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ground(Value):
    """Ground of a made-up Moon."""

    field: SphereField  # heights over the radius
    heights: HeightMap  # the same by a map with a degree between its samples
    radius_km: float


def made_up_moon(setting: Setting, seed: int) -> Ground:
    """Make ground with the relief that was expected before flight."""
    moon = setting.data["moon"]
    radius_km = float(moon["radius_km"])
    field = rough(seed, rms=moon["relief_km"] / radius_km, degrees=(_LONGEST, _SHORTEST), count=_WAVES, cells=_CELLS)
    rows = round(180.0 / _STEP_DEG)
    latitude = np.radians(90.0 - _STEP_DEG * (np.arange(rows) + 0.5))[:, None]
    longitude = np.radians(_STEP_DEG * (np.arange(2 * rows) + 0.5))[None]
    x, y, z = np.broadcast_arrays(
        np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
    )
    heights = radius_km * field(np.stack([x, y, z], axis=-1).reshape(-1, 3)).reshape(rows, 2 * rows)
    return Ground(
        field=field,
        heights=HeightMap.from_array(heights, reference_radii_km=np.full(3, radius_km)),
        radius_km=radius_km,
    )


def camera_axes(one: Pass) -> tuple[Float, Float, Float]:
    """Axes of the camera over the Moon, body axes: toward the camera, and along +x and +y of the image."""
    longitude = math.radians(_TURN_DEG[0] * one.number)
    latitude = math.radians(_TURN_DEG[1]) * math.sin(longitude * 1.7)
    toward = np.array(
        [math.cos(latitude) * math.cos(longitude), math.cos(latitude) * math.sin(longitude), math.sin(latitude)]
    )
    right = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
    return toward, right, np.cross(right, toward)


def seen_limb_km(ground: Ground, one: Pass) -> Float:
    """Heights (n,), km, of the limb at position angles in the image: the highest ground along each line of sight."""
    toward, right, down = camera_axes(one)
    angles = 2.0 * np.pi * np.arange(ANGLES) / ANGLES
    outward = np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * down
    tilt = math.acos(ground.radius_km / one.range_km) + np.linspace(-_REACH_RAD, _REACH_RAD, _ALONG)
    places = np.cos(tilt)[None, :, None] * toward + np.sin(tilt)[None, :, None] * outward[:, None]
    radii = ground.radius_km * (1.0 + ground.field(places.reshape(-1, 3)).reshape(ANGLES, _ALONG))
    elongation = np.arctan2(radii * np.sin(tilt), one.range_km - radii * np.cos(tilt)).max(axis=1)
    result: Float = one.range_km * np.sin(elongation) - ground.radius_km
    return result


def mapped_limb_km(ground: Ground, one: Pass) -> Float:
    """The same, predicted from the map."""
    toward, right, _ = camera_axes(one)
    profile = limb_profile(
        ground.heights, np.full(3, ground.radius_km), one.range_km * toward, angles=ANGLES, up_body=right
    )
    return profile.altitude_km
