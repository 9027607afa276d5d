"""Files of ISIS (USGS): control networks in PVL, and image support data (ISD) of frame cameras.

Sources opened: ISIS "ControlPoint.cpp" and "ControlNetVersioner.cpp" (keywords), usgscsm "Distortion.cpp" (radial
distortion). Samples and lines count from 1 at the center of the first pixel.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.reading import check, reads
from giantlike.core.arrays import Float, as_finite
from giantlike.core.frames import rotation_from_xyzw
from giantlike.core.units import RAD_PER_DEG
from giantlike.core.values import Value, check_covariance
from giantlike.io.label_statements import statements

_TYPES = {"Free": "Free", "Tie": "Free", "Constrained": "Constrained", "Fixed": "Fixed", "Ground": "Fixed"}
_UNIT_QUATERNION = 1e-6  # largest error of its length: ISDs hold all digits of a double
_TRUE = frozenset({"true", "yes"})
_KM_PER = {"meters": 1e-3, "m": 1e-3, "km": 1.0, "kilometers": 1.0, None: 1e-3}


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlMeasure:
    """A point in an image: serial number of the image, and sample and line, counted from 1."""

    serial_number: str
    sample: float
    line: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlPoint(Value):
    """A point of a control network."""

    name: str
    type: str  # ``Free``, ``Constrained`` or ``Fixed``
    position_km: Float  # (3,); a priori, body axes; NaN where the file has none
    covariance_km2: Float | None  # (3, 3) of this, where the file has one, else None
    measures: tuple[ControlMeasure, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlNetwork:
    """A control network without what it marks as ignored or rejected, of which it has the numbers."""

    target: str
    points: tuple[ControlPoint, ...]
    ignored_points: int
    ignored_measures: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageSupport(Value):
    """State and optics of a frame camera, as an ISD has them."""

    platform: str
    sensor: str
    samples: int
    lines: int
    et: float
    focal_length_mm: float
    center: Float  # (2,); sample and line, from 1, of the optical axis on the whole detector; NaN if not in the file
    pixels_per_mm: Float  # (2, 2); sample and line by x and y of the focal plane
    first: tuple[float, float]
    summing: tuple[float, float]
    camera_from_inertial: Rotation  # camera_from_inertial, body_from_inertial: ISIS camera axes; body-fixed axes
    body_from_inertial: Rotation
    position_km: Float  # (3,); of the camera from the center of the body, J2000
    distortion: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # coefficients by name

    def ideal_mm(self, sample_line: Float) -> Float:
        """Focal-plane coordinates (n, 2), mm, without distortion, of pixels (n, 2) of the whole detector."""
        offset = sample_line - self.center
        x, y = np.linalg.solve(self.pixels_per_mm, offset.T)
        if "principal_point" in self.distortion:
            x, y = x - self.distortion["principal_point"][0], y - self.distortion["principal_point"][1]
        square = x * x + y * y
        radial = self.distortion.get("radial", (0.0, 0.0, 0.0))
        factor = 1.0 + radial[0] * square + radial[1] * square**2 + radial[2] * square**3
        if "csm_radial" in self.distortion:
            a, b, c = self.distortion["csm_radial"]
            factor = factor - (a + b * square + c * square**2)
        j1, j2, angle = self.distortion.get("decentering", (0.0, 0.0, 0.0))
        tangential = j1 * square + j2 * square**2
        return np.stack([factor * x - tangential * np.sin(angle), factor * y + tangential * np.cos(angle)], axis=-1)


@reads("a control network")
def read_control_network(path: Path) -> ControlNetwork:
    """Read a control network in PVL; ignored points and rejected measures are left out."""
    data = path.read_bytes()
    check(b"ProtoBuffer" not in data[:65536] and b"HeaderStartByte" not in data[:65536],
          "it is a binary network, which is not read: convert it to PVL by cnetbin2pvl")  # fmt: skip
    target, points, dropped_points, dropped_measures, found = "", [], 0, 0, False
    for kind, items, groups in _objects(data.decode("latin-1")):
        if kind == "ControlNetwork":
            found, target = True, items.get("TargetName", ("", None))[0]
            continue
        good = [group for group in groups if not (_flag(group, "Ignore") or _flag(group, "JigsawRejected"))]
        dropped_measures += len(groups) - len(good)
        if _flag(items, "Ignore"):
            dropped_points += 1
            continue
        points.append(_control_point(items, good))
    check(found, "it has no object ControlNetwork")
    check(bool(points), "it has no point that is in use")
    names = [point.name for point in points]
    check(len(set(names)) == len(names), "two points have one PointId")
    return ControlNetwork(
        target=target, points=tuple(points), ignored_points=dropped_points, ignored_measures=dropped_measures
    )


_Items = dict[str, tuple[str, str | None]]


def _objects(text: str) -> Iterator[tuple[str, _Items, list[_Items]]]:
    """Yield the network and its points: kind, keywords, and those of the measures."""
    network: _Items = {}
    point: _Items | None = None
    measures: list[_Items] = []
    group: _Items | None = None
    seen = False
    for key, value, unit in statements(text):
        if key in ("Object", "Group"):
            if value == "ControlNetwork":
                seen = True
            elif value == "ControlPoint":
                if not seen or point is not None:
                    raise ValueError("a point begins where it should not: the file is damaged")
                point, measures = {}, []
            elif value == "ControlMeasure":
                check(point is not None, "a measure lies outside of a point")
                group = {}
        elif key == "End_Group":
            if group is not None:
                measures.append(group)
            group = None
        elif key == "End_Object" and point is not None:
            yield "ControlPoint", point, measures
            point = None
        elif group is not None:
            group[key] = (value.strip("\"'"), unit)
        elif point is not None:
            point[key] = (value.strip("\"'"), unit)
        elif seen:
            network[key] = (value.strip("\"'"), unit)
    check(point is None and group is None, "it is truncated within a point")
    if seen:
        yield "ControlNetwork", network, []


def _flag(items: _Items, key: str) -> bool:
    return key in items and items[key][0].lower() in _TRUE


def _number(items: _Items, key: str, where: str) -> float:
    check(key in items, f"{where}: {key} is missing")
    value = float(items[key][0])
    check(bool(np.isfinite(value)), f"{where}: {key} must be finite, got {value}")
    return value


def _control_point(items: _Items, measures: list[_Items]) -> ControlPoint:
    check("PointId" in items, "a point has no PointId")
    name = items["PointId"][0]
    kind = items.get("PointType", ("Free", None))[0]
    check(kind in _TYPES, f"point {name}: PointType must be one of {', '.join(_TYPES)}, got {kind!r}")
    keys = next((k for k in ("Apriori", "Adjusted") if all(k + axis in items for axis in "XYZ")), None)
    position = np.full(3, np.nan)
    if keys is not None:
        units = [items[keys + axis][1] for axis in "XYZ"]
        check(all(unit in _KM_PER for unit in units), f"point {name}: {keys}X has the unit {units[0]!r}")
        position = np.array(
            [_number(items, keys + a, f"point {name}") * _KM_PER[u] for a, u in zip("XYZ", units, strict=True)]
        )
    covariance = None
    if "AprioriCovarianceMatrix" in items:
        words = items["AprioriCovarianceMatrix"][0].strip("()").split(",")
        upper = [float(word.split("<")[0]) for word in words]
        check(
            len(upper) == 6 and bool(np.isfinite(upper).all()), f"point {name}: its covariance needs 6 finite numbers"
        )
        a, b, c, d, e, f = upper
        covariance = np.array([[a, b, c], [b, d, e], [c, e, f]]) * 1e-6
        check_covariance(covariance, f"point {name}: AprioriCovarianceMatrix")
    return ControlPoint(
        name=name,
        type=_TYPES[kind],
        position_km=position,
        covariance_km2=covariance,
        measures=tuple(
            ControlMeasure(
                serial_number=measure.get("SerialNumber", ("", None))[0],
                sample=_number(measure, "Sample", f"point {name}"),
                line=_number(measure, "Line", f"point {name}"),
            )
            for measure in measures
        ),
    )


@reads("image support data")
def read_image_support(path: Path) -> ImageSupport:
    """Read the ISD of a frame camera."""
    table = json.loads(path.read_bytes())
    check(isinstance(table, dict), "it must hold a table of JSON")
    name = str(table.get("name_model"))
    check("FRAME" in name.upper(), f"only frame cameras are read, name_model is {name}: line scanners are not")
    et = _float(table["center_ephemeris_time"], "center_ephemeris_time")
    samples, lines = (_whole(table[key], key) for key in ("image_samples", "image_lines"))
    offsets = [_float(table[f"focal2pixel_{key}"][0], f"focal2pixel_{key}") for key in ("samples", "lines")]
    matrix = as_finite([table[f"focal2pixel_{key}"][1:3] for key in ("samples", "lines")], (2, 2), "focal2pixel")
    check(abs(float(np.linalg.det(matrix))) > 0.0, "focal2pixel_samples and focal2pixel_lines must not be parallel")
    stored = table.get("detector_center") or {}
    center = [
        np.nan if stored.get(key) is None else _float(stored[key], "detector_center") for key in ("sample", "line")
    ]
    return ImageSupport(
        platform=str(table.get("name_platform", "")),
        sensor=str(table.get("name_sensor", "")),
        samples=samples,
        lines=lines,
        et=et,
        focal_length_mm=_float(table["focal_length_model"]["focal_length"], "focal_length"),
        center=np.array(center) + offsets,
        pixels_per_mm=matrix,
        first=_pair(table, "starting_detector_{}", 0.0),
        summing=_pair(table, "detector_{}_summing", 1.0),
        camera_from_inertial=_rotation(table["instrument_pointing"], et, "instrument_pointing"),
        body_from_inertial=_rotation(table["body_rotation"], et, "body_rotation"),
        position_km=as_finite(_state(table["instrument_position"], "positions", et), (3,), "instrument_position"),
        distortion=_distortion(table),
    )


def _float(value: Any, name: str) -> float:
    check(isinstance(value, int | float) and bool(np.isfinite(value)), f"{name} must be a finite number, got {value!r}")
    return float(value)


def _whole(value: Any, name: str) -> int:
    check(isinstance(value, int) and 0 < value < 10**6, f"{name} must be a whole number above 0, got {value!r}")
    return int(value)


def _pair(table: Mapping[str, Any], key: str, default: float) -> tuple[float, float]:
    sample, line = (_float(table.get(key.format(axis), default), key.format(axis)) for axis in ("sample", "line"))
    return sample, line


def _state(table: Mapping[str, Any], key: str, et: float) -> Any:
    """State nearest to the epoch, as it is."""
    times = as_finite(table["ephemeris_times"], (len(table["ephemeris_times"]),), "ephemeris_times")
    check(0 < len(times) == len(table[key]), f"{key} and ephemeris_times must be of one length")
    check(table.get("reference_frame", 1) == 1, f"{key} must be in J2000 (frame 1), got {table.get('reference_frame')}")
    return table[key][int(np.argmin(np.abs(times - et)))]


def _rotation(table: Mapping[str, Any], et: float, name: str) -> Rotation:
    w, x, y, z = as_finite(_state(table, "quaternions", et), (4,), f"{name}: quaternion")
    length = float(np.linalg.norm([w, x, y, z]))
    check(abs(length - 1.0) < _UNIT_QUATERNION, f"{name}: a quaternion must have length 1, got {length:.6g}")
    constant = as_finite(table.get("constant_rotation", np.eye(3).ravel()), (9,), f"{name}: constant_rotation")
    matrix = constant.reshape(3, 3)
    check(float(np.abs(matrix).max()) < 2.0, f"{name}: constant_rotation must be a rotation")
    turned = np.abs(matrix @ matrix.T - np.eye(3)).max() < _UNIT_QUATERNION and np.linalg.det(matrix) > 0.0
    check(bool(turned), f"{name}: constant_rotation must be a rotation")
    return Rotation.from_matrix(matrix) * rotation_from_xyzw([x, y, z, w], name)


def _distortion(table: Mapping[str, Any]) -> dict[str, tuple[float, ...]]:
    """Coefficients from measured to ideal coordinates: ISIS keywords of metric cameras, else the radial ones of CSM."""
    found: dict[str, tuple[float, ...]] = {}
    keywords = {str(key).split("_", 1)[-1]: value for key, value in (table.get("naif_keywords") or {}).items()}
    for key, name, count in (("OD_K", "radial", 3), ("DECENTER", "decentering", 3), ("PP", "principal_point", 2)):
        if key in keywords and "DECENTER" in keywords:
            found[name] = tuple(as_finite(keywords[key], (count,), key).tolist())
    declared = table.get("optical_distortion") or {}
    check(set(declared) <= {"radial"}, f"optical_distortion {', '.join(declared)} is not read: radial is")
    if "radial" in declared:
        values = as_finite(declared["radial"]["coefficients"], (3,), "optical_distortion")
        if values.any():
            found["csm_radial"] = tuple(values.tolist())
    return found


def angles_covariance(camera_from_inertial: Rotation, sigma_deg: float) -> Float:
    """Covariance (3, 3), rad^2, camera axes, of errors of one size in RA, DEC, TWIST of ISIS (axes 3, 1, 3)."""
    by_ra = camera_from_inertial.as_matrix()[:, 2]
    twist = np.arctan2(by_ra[0], by_ra[1])
    by_dec = np.array([np.cos(twist), -np.sin(twist), 0.0])
    axes = np.stack([by_ra, by_dec, [0.0, 0.0, 1.0]], axis=1)
    return np.asarray(axes @ axes.T) * (sigma_deg * RAD_PER_DEG) ** 2
