"""Camera models from the XML files of NASA's GIANT.

Layout and names as in giant/camera_models (camera_model.py ``save``, and the attributes of each model),
github.com/nasa/giant. GIANT counts pixels from the center of the first one, as we do. The files hold Python
expressions; only numbers and arrays of numbers are read, nothing is evaluated.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.reading import check, reads
from giantlike.camera_models import BrownModel, EquidistantModel, OpenCVModel, OwenModel, PinholeModel
from giantlike.camera_models.affine import AffineModel
from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError
from giantlike.io.mission_frame import Boresight, ImportedCamera, from_mission_frame

_KINDS: dict[str, type[AffineModel]] = {
    "PinholeModel": PinholeModel,
    "BrownModel": BrownModel,
    "OpenCVModel": OpenCVModel,
    "OwenModel": OwenModel,
    "FisheyeModel": EquidistantModel,
}
_ORDER = {  # of the numbers in distortion_coefficients
    "BrownModel": ("k1", "k2", "k3", "p1", "p2"),
    "OpenCVModel": ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4"),
    "OwenModel": ("e2", "e4", "e5", "e6", "e1", "e3"),
    "FisheyeModel": ("k1", "k2", "k3", "k4"),
}
_ALIASES = {
    "BrownModel": {"radial2": "k1", "radial4": "k2", "radial6": "k3", "tiptilt_y": "p1", "tiptilt_x": "p2"},
    "OpenCVModel": {
        "radial2n": "k1", "radial4n": "k2", "radial6n": "k3", "radial2d": "k4", "radial4d": "k5", "radial6d": "k6",
        "tiptilt_y": "p1", "tiptilt_x": "p2",
        "thinprism_1": "s1", "thinprism_2": "s2", "thinprism_3": "s3", "thinprism_4": "s4",
    },
    "OwenModel": {
        "radial2": "e2", "radial4": "e4", "tangential_y": "e5", "tangential_x": "e6", "pinwheel1": "e1",
        "pinwheel2": "e3",
    },
}  # fmt: skip
_OWEN_POWERS = {"e1": 1, "e2": 2, "e3": 3, "e4": 4, "e5": 1, "e6": 1}  # of the focal length
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?\b(?:nan|inf)\b")


@reads("a camera file of NASA's GIANT")
def read_giant_camera(
    path: str | Path, name: str | None = None, *, boresight: Boresight | None = None
) -> ImportedCamera:
    """Read one camera of a GIANT XML file."""
    element = _element(ElementTree.parse(path).getroot(), name)
    kind = element.get("type", "")
    check(kind in _KINDS, f"camera {element.tag!r} is of type {kind!r}; known are {', '.join(_KINDS)}")
    return _make_camera(element.tag, kind, {child.tag: _numbers(child.text or "") for child in element}, boresight)


def _element(root: ElementTree.Element, name: str | None) -> ElementTree.Element:
    """The element of the camera with this name, or of the only camera."""
    cameras = {element.tag: element for element in root.iter() if element.get("type") and element.get("module")}
    check(bool(cameras), "it holds no GIANT camera: elements with the attributes module and type were expected")
    if name is None and len(cameras) == 1:
        return next(iter(cameras.values()))
    if name not in cameras:
        raise ValueError(f"name one of its cameras, {', '.join(sorted(cameras))}; got {name!r}")
    return cameras[name]


def _numbers(text: str) -> Float:
    """The numbers of a Python expression like ``1.0``, ``np.float64(1.0)`` or ``array([[1., 0.]])``."""
    bare = re.sub(r"(?:np\.|numpy\.)?(?:float|int)\d+|dtype=\S+", "", text)
    return np.array([float(number) for number in _NUMBER.findall(bare)])


def _make_camera(name: str, kind: str, values: dict[str, Float], boresight: Boresight | None) -> ImportedCamera:
    """Camera of the values of one element, in our axes."""
    single = {key: float(numbers[0]) for key, numbers in values.items() if numbers.size == 1}
    matrix, focal = _matrix(single, values.get("intrinsic_matrix"))
    lens = dict(zip(_ORDER.get(kind, ()), values.get("distortion_coefficients", np.array([])).tolist(), strict=False))
    aliases = _ALIASES.get(kind, {})
    named = {aliases.get(key, key): value for key, value in single.items()}
    lens |= {key: named[key] for key in _ORDER.get(kind, ()) if key in named}
    if kind == "OwenModel":
        lens = {key: value * focal ** _OWEN_POWERS[key] for key, value in lens.items()}
    turn = np.arctan2(matrix[1, 0] * np.sign(matrix[1, 1]), abs(matrix[1, 1]))
    if turn:
        matrix, lens = _upright(matrix, lens, turn)
    warm = dict(zip(("a1", "a2", "a3"), values.get("temperature_coefficients", np.zeros(3)).tolist(), strict=False))
    warm |= {key: single[key] for key in warm if key in single}
    sizes = [int(single[key]) if single.get(key, 1) > 1 else None for key in ("n_cols", "n_rows")]
    parameters = lens | {
        "fx_px": matrix[0, 0], "fy_px": matrix[1, 1], "skew_px": matrix[0, 1], "cx_px": matrix[0, 2],
        "cy_px": matrix[1, 2], "a1_per_c": warm["a1"], "a2_per_c2": warm["a2"], "a3_per_c3": warm["a3"],
    }  # fmt: skip
    camera = from_mission_frame(
        _KINDS[kind], {key: float(value) for key, value in parameters.items()}, name=name, columns=sizes[0],
        rows=sizes[1], boresight=boresight,
    )  # fmt: skip
    misaligned = np.any(values.get("misalignment", np.zeros(3)) != 0)
    return replace(
        camera,
        camera_from_mission=camera.camera_from_mission * Rotation.from_rotvec([0.0, 0.0, turn]),
        ignored=("misalignment",) if misaligned else (),
    )


def _matrix(single: dict[str, float], stored: Float | None) -> tuple[Float, float]:
    """Intrinsic matrix (2, 3), px, of the image plane at unit distance, and the focal length in the file's unit."""
    matrix = np.zeros((2, 3)) if stored is None or stored.size != 6 else stored.reshape(2, 3).copy()
    places = {
        "kx": (0, 0), "fx": (0, 0), "kxy": (0, 1), "alpha": (0, 1), "px": (0, 2), "kyx": (1, 0), "ky": (1, 1),
        "fy": (1, 1), "py": (1, 2),
    }  # fmt: skip
    for key, place in places.items():
        matrix[place] = single.get(key, matrix[place])
    if not (matrix[0, 0] and matrix[1, 1]):
        raise InputError("kx and ky (or fx and fy) are needed, and not zero")
    focal = single.get("focal_length", 1.0)
    with np.errstate(over="ignore"):
        matrix[:, :2] *= focal
    require(bool(np.isfinite(matrix).all()), f"kx, ky and focal_length {focal:g} come to infinite focal lengths")
    return matrix, focal


def _upright(matrix: Float, lens: dict[str, float], turn: float) -> tuple[Float, dict[str, float]]:
    """Turn the axes of a camera about the boresight so that its rows depend on y alone."""
    if any(lens.get(key) for key in ("p1", "p2", "s1", "s2", "s3", "s4")):
        raise InputError("kyx together with decentering or prism terms can't be represented: convert in GIANT first")
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    matrix = np.column_stack([matrix[:, :2] @ rotation.T, matrix[:, 2]])
    matrix[1, 0] = 0.0
    if "e5" in lens:
        e6, e5 = rotation @ [lens["e6"], lens["e5"]]
        lens = lens | {"e5": float(e5), "e6": float(e6)}
    return matrix, lens
