"""Camera models from and to OpenCV's calibration files (``cv2.FileStorage``, YAML or XML).

They are read by parsers of YAML and XML, because ``cv2.FileStorage`` can end the process at a damaged file. OpenCV
counts pixels from the center of the first one, and its x and y are ours: nothing is converted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import write_text_atomic
from giantlike._system.reading import reads
from giantlike.camera_models import BrownModel, CameraModel, EquidistantModel, OpenCVModel, PinholeModel
from giantlike.camera_models.affine import TEMPERATURE_NAMES, AffineModel
from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError
from giantlike.io.mission_frame import ImportedCamera

# Order and possible numbers of distortion coefficients: OpenCV 4 documentation, module calib3d, "Detailed Description".
_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
_COUNTS = (0, 4, 5, 8, 12, 14)  # of coefficients, same source
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "CameraMatrix", "K", "M1")
_COEFFICIENTS = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D", "D1")
_WIDTH = ("image_width", "image_Width", "imageWidth", "width")
_HEIGHT = ("image_height", "image_Height", "imageHeight", "height")


@reads("an OpenCV camera file")
def read_opencv_camera(path: str | Path, *, fisheye: bool | None = None) -> ImportedCamera:
    """Read the camera matrix and distortion of an OpenCV calibration file."""
    content = Path(path).read_bytes()
    storage = _xml_storage(content) if Path(path).suffix.lower() == ".xml" else _yaml_storage(content)
    matrix, coefficients = _matrix(storage, _MATRIX), _matrix(storage, _COEFFICIENTS)
    width, height = (_whole(storage, keys) for keys in (_WIDTH, _HEIGHT))
    if fisheye is None:
        fisheye = _is_fisheye(storage)
    if matrix is None or matrix.shape != (3, 3):
        raise ValueError(f"a 3 by 3 matrix under one of {', '.join(_MATRIX)} is needed")
    model = _model(matrix, np.array([]) if coefficients is None else coefficients.ravel(), fisheye)
    return ImportedCamera(
        name=Path(path).stem, model=model, columns=width, rows=height, camera_from_mission=Rotation.identity()
    )


def write_opencv_camera(path: str | Path, model: CameraModel, *, columns: int, rows: int) -> None:
    """Write a model as an OpenCV calibration file, YAML or XML by the suffix of the path."""
    import cv2

    if not isinstance(model, PinholeModel | BrownModel | OpenCVModel | EquidistantModel):
        raise InputError(f"OpenCV has no {model.type_name} model: convert it to opencv or equidistant first")
    known = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    if any(known[name] for name in ("skew_px", *TEMPERATURE_NAMES)):
        raise InputError(
            "OpenCV's files have no shear and no temperature terms: use model.at_temperature, and for shear fit a "
            "model without it"
        )
    names: Sequence[str] = ("k1", "k2", "k3", "k4") if isinstance(model, EquidistantModel) else _ORDER
    if not isinstance(model, OpenCVModel | EquidistantModel):
        names = names[:5]
    kind = cv2.FILE_STORAGE_FORMAT_XML if Path(path).suffix == ".xml" else cv2.FILE_STORAGE_FORMAT_YAML
    storage = cv2.FileStorage(Path(path).name, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | kind)
    storage.write("image_width", columns)
    storage.write("image_height", rows)
    storage.write(
        "camera_matrix", np.array([[known["fx_px"], 0, known["cx_px"]], [0, known["fy_px"], known["cy_px"]], [0, 0, 1]])
    )
    storage.write("distortion_coefficients", np.array([[known.get(name, 0.0) for name in names]]))
    storage.write("fisheye_model", int(isinstance(model, EquidistantModel)))
    write_text_atomic(Path(path), storage.releaseAndGetString())


class _Loader(yaml.SafeLoader):
    """Reads the matrices of OpenCV as plain mappings; constructs nothing else than YAML's own types."""


def _plain_matrix(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


for _tag in ("opencv-matrix", "opencv-nd-matrix"):  # OpenCV 5 writes arrays of one dimension as the second
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _plain_matrix)


def _yaml_storage(content: bytes) -> Mapping[str, Any]:
    """Values of a YAML file by key; OpenCV's own first line ``%YAML:1.0`` is not a directive of YAML."""
    text = content.decode("utf-8")
    storage = yaml.load(text.partition("\n")[2] if text.startswith("%YAML:") else text, _Loader)
    if not isinstance(storage, dict):
        raise ValueError("it has no keys with values")
    return storage


def _xml_storage(content: bytes) -> Mapping[str, Any]:
    """Values of an XML file by key: texts, and the parts of matrices."""
    return {
        entry.tag: {part.tag: part.text or "" for part in entry} if len(entry) else (entry.text or "").strip()
        for entry in ElementTree.fromstring(content)
    }


def _value(storage: Mapping[str, Any], keys: Sequence[str]) -> Any:
    """Value of the first of several keys that a storage has; None if it has none of them."""
    return next((storage[key] for key in keys if key in storage), None)


def _matrix(storage: Mapping[str, Any], keys: Sequence[str]) -> Float | None:
    value = _value(storage, keys)
    if value is None:
        return None
    if not isinstance(value, dict) or not (
        {"rows", "cols", "data"} <= value.keys() or {"sizes", "data"} <= value.keys()
    ):
        raise ValueError(f"a matrix with rows, cols and data is needed under one of {', '.join(keys)}")
    try:
        numbers = np.array([float(number) for number in _items(value["data"])])
        sizes = _items(value["sizes"]) if "sizes" in value else (value["rows"], value["cols"])
        shape = tuple(int(size) for size in sizes)
    except TypeError as error:
        raise ValueError(f"the matrix under one of {', '.join(keys)} holds something else than numbers") from error
    if min(shape, default=0) < 0 or math.prod(shape) != numbers.size:
        raise ValueError(f"a matrix of the shape {shape} cannot have {numbers.size} numbers")
    return numbers.reshape(shape)


def _items(values: Any) -> Any:
    """Items of a list, which XML holds as text."""
    return values.split() if isinstance(values, str) else values


def _whole(storage: Mapping[str, Any], keys: Sequence[str]) -> int | None:
    value = _value(storage, keys)
    if not isinstance(value, int | str | None):
        raise ValueError(f"a whole number is needed under one of {', '.join(keys)}, got {value!r}")
    return None if value is None else int(value)


def _is_fisheye(storage: Mapping[str, Any]) -> bool:
    named = storage.get("distortion_model")
    if isinstance(named, str):
        return named.strip('"') in {"fisheye", "equidistant"}
    return bool(_whole(storage, ("fisheye_model",)))


def _model(matrix: Float, coefficients: Float, fisheye: bool) -> AffineModel:
    affine = {"fx_px": matrix[0, 0], "fy_px": matrix[1, 1], "cx_px": matrix[0, 2], "cy_px": matrix[1, 2]}
    affine |= {"skew_px": matrix[0, 1]}
    values = {name: float(value) for name, value in affine.items()}
    if fisheye:
        require(coefficients.size == 4, f"a fisheye has 4 distortion coefficients, got {coefficients.size}")
        return EquidistantModel(**values, **dict(zip(("k1", "k2", "k3", "k4"), coefficients.tolist(), strict=True)))
    require(coefficients.size in _COUNTS, f"distortion coefficients number one of {_COUNTS}, got {coefficients.size}")
    require(not coefficients[12:].any(), "the tilted sensor of OpenCV (coefficients 13 and 14) has no model here")
    lens = dict(zip(_ORDER, coefficients[:12].tolist(), strict=False))
    kind: type[AffineModel] = (
        OpenCVModel if coefficients.size > 5 else BrownModel if coefficients.size else PinholeModel
    )
    return kind(**values, **lens)
