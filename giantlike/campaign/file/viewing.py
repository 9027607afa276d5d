"""``[geometry]`` of a campaign file: viewing geometry off a picture or a press kit, in camera axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from giantlike.camera import Camera
from giantlike.campaign.file.inputs import TargetSetup
from giantlike.campaign.file.schema import GeometrySection
from giantlike.campaign.file.toml_file import prefix_errors
from giantlike.core.arrays import Float, require
from giantlike.core.frames import direction_from_radec
from giantlike.core.time import time_from_utc
from giantlike.core.units import RAD_PER_DEG
from giantlike.io.geometry_table import ImageGeometry
from giantlike.io.viewing_geometry import StatedGeometry, ViewingGeometry
from giantlike.shapes import Ellipsoid

_ZERO_DEG = {"up": -90.0, "right": 0.0}
_NOTHING = ImageGeometry(epoch=None, exposure_s=None, camera_from_inertial=None, observer=None, targets={})
_SAME_SIZE = 0.05  # largest relative difference of a stated range from the one by a diameter read off the picture


class _Entry(Protocol):
    @property
    def key(self) -> str: ...

    @property
    def path(self) -> Path: ...


def viewing_of(
    sections: Sequence[GeometrySection], images: Sequence[_Entry], targets: Sequence[TargetSetup], camera: Camera
) -> dict[str, ImageGeometry]:
    """Geometry of the images that the ``[geometry]`` tables of a campaign describe, by image key."""
    found: dict[str, ImageGeometry] = {}
    for number, section in enumerate(sections):
        with prefix_errors(f"geometry[{number}]: "):
            key = _image(section.file, images)
            target = _target(section.target, targets)
            known = found.get(key, _NOTHING)
            require(target.name not in known.seen, f"{key!r} has another table of {target.name!r}")
            found[key] = replace(
                known,
                epoch=known.epoch if section.epoch_utc is None else time_from_utc(section.epoch_utc),
                exposure_s=known.exposure_s if section.exposure_s is None else section.exposure_s,
                seen={**known.seen, target.name: _place_target(section, target, camera)},
            )
    return found


def _image(name: str | None, images: Sequence[_Entry]) -> str:
    matching = [image.key for image in images if name is None or name in (image.key, image.path.name)]
    what = "which image? The campaign has several" if name is None else f"{len(matching)} images have the name {name!r}"
    require(len(matching) == 1, f"file: {what}")
    return matching[0]


def _target(name: str | None, targets: Sequence[TargetSetup]) -> TargetSetup:
    matching = [target for target in targets if name is None or name == target.name]
    names = ", ".join(target.name for target in targets) or "none"
    require(len(matching) == 1, f"target: expected the name of one of the targets ({names}), got {name!r}")
    return matching[0]


def _place_target(section: GeometrySection, target: TargetSetup, camera: Camera) -> StatedGeometry:
    center_px = camera.center_px if section.center_px is None else np.array(section.center_px)
    require(center_px.shape == (2,), f"center_px: expected [x, y], got {center_px.tolist()}")
    longitude_deg = section.sub_observer_longitude_deg
    if longitude_deg is None and section.sub_observer_latitude_deg is not None:
        turned = section.sub_solar_longitude_deg is None and _is_round(target)
        require(
            turned,
            "sub_observer_longitude_deg: may be left out for a body of revolution whose Sun is given by its azimuth",
        )
        longitude_deg = 0.0
    zero_deg = _ZERO_DEG[section.azimuth_zero]
    return ViewingGeometry(
        target=target.name,
        center_px=center_px,
        range_km=_range_km(section, center_px, target, camera),
        north_azimuth_rad=_radians(section.north_azimuth_deg, zero_deg),
        observer_direction_body=_direction("sub_observer", section.sub_observer_latitude_deg, longitude_deg),
        sun_direction_body=_direction("sub_solar", section.sub_solar_latitude_deg, section.sub_solar_longitude_deg),
        sun_azimuth_rad=_radians(section.sun_azimuth_deg, zero_deg),
        phase_angle_rad=_radians(section.phase_angle_deg),
    ).in_camera(camera.model)


def _is_round(target: TargetSetup) -> bool:
    return not isinstance(target.shape, Path) and target.shape[0] == target.shape[1]


def _range_km(section: GeometrySection, center_px: Float, target: TargetSetup, camera: Camera) -> float:
    """Range as stated, or by the widest diameter of the body in the picture; both have to agree."""
    if section.diameter_px is None:
        require(section.range_km is not None, "give range_km, or diameter_px of the body in the picture")
        assert section.range_km is not None
        return section.range_km
    shape = target.load_shape()
    widest_km = float(shape.radii_km.max()) if isinstance(shape, Ellipsoid) else shape.circumscribing_radius_km
    half_rad = section.diameter_px / 2.0 * float(camera.ifov_rad(center_px))
    require(0.0 < half_rad < math.pi / 2.0, f"diameter_px: {section.diameter_px:g} px are {2 * half_rad:.3g} rad")
    by_size_km = widest_km / math.sin(half_rad)
    range_km = by_size_km if section.range_km is None else section.range_km
    require(
        abs(math.log(range_km / by_size_km)) <= _SAME_SIZE,
        f"range_km is {range_km:g}, but a body {2 * widest_km:g} km wide has {section.diameter_px:g} px at "
        f"{by_size_km:.4g} km: check the focal length (camera.binned), the radii and the range",
    )
    return range_km


def _direction(name: str, latitude_deg: float | None, longitude_deg: float | None) -> Float | None:
    if latitude_deg is None and longitude_deg is None:
        return None
    both = latitude_deg is not None and longitude_deg is not None
    require(both, f"{name}_latitude_deg and {name}_longitude_deg belong together")
    assert latitude_deg is not None
    assert longitude_deg is not None
    return direction_from_radec(longitude_deg, latitude_deg)


def _radians(angle_deg: float | None, zero_deg: float = 0.0) -> float | None:
    return None if angle_deg is None else (angle_deg + zero_deg) * RAD_PER_DEG
