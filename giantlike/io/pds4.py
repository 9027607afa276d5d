"""PDS4 products: an XML label and the image that it describes, by pds4_tools (an optional extra).

Source: PDS4 Information Model 1.21: ``Array_2D_Image``, ``Special_Constants``, ``Element_Array``, ``Time_Coordinates``;
discipline dictionary "Imaging": ``Exposure.exposure_duration``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.child import in_child
from giantlike._system.reading import reads
from giantlike.core.arrays import Mask
from giantlike.core.extras import require_extra
from giantlike.io.decoded import DecodedImage, HeaderValue
from giantlike.io.label_times import label_epoch

PRODUCT_START = re.compile(rb"(?:\xef\xbb\xbf)?\s*<\?xml[^>]*>[\s\S]{0,20000}?<Product_Observational\b")
"""Beginning of the label of an observation; model references and comments may stand before the root."""

_FILE_NAME = re.compile(rb"<file_name>([^<]*+)</file_name>")
LABEL_NAMES = {"start_date_time": "START_TIME", "stop_date_time": "STOP_TIME"}
"""Elements of a label with times, and their names in PDS3 labels."""
_SECONDS = {"s": 1.0, "ms": 1e-3, "microseconds": 1e-6, "min": 60.0}  # units of time of the information model, s


@reads("a PDS4 label")
def data_file_of(path: Path, label: bytes) -> str:
    """Name of the file that holds the data of a label."""
    match = _FILE_NAME.search(label)
    name = "" if match is None else match[1].decode().strip()
    if not name or name in {".", ".."} or "/" in name or "\\" in name:
        raise ValueError(f"its file_name must be that of a file beside it, got {name!r}")
    return name


@reads("a PDS4 product")
def decode_pds4(path: Path) -> DecodedImage:
    """Decode the first image of a PDS4 product."""
    require_extra("pds4_tools", extra="planetary", purpose="reading PDS4 products")
    arrays = in_child(read_product, [path], libraries=["pds4_tools"])
    header: dict[str, HeaderValue] = json.loads(str(arrays["header"]))
    units: dict[str, str] = json.loads(str(arrays["units"]))
    exposure_s = _exposure_s(header, units)
    times = {new: value for old, new in LABEL_NAMES.items() if (value := _leaf(header, old)) is not None}
    if times.get("START_TIME") == times.get("STOP_TIME"):  # the label gives one epoch twice: it is the start
        times.pop("STOP_TIME", None)
    return DecodedImage(
        pixels=arrays["pixels"],
        mask=arrays["mask"],
        format="pds4",
        epoch=label_epoch(times, exposure_s),
        exposure_s=exposure_s,
        header=header,
    )


def read_product(paths: Sequence[Path]) -> dict[str, NDArray[Any]]:
    """Read the first image of a product by pds4_tools."""
    import pds4_tools

    (path,) = paths
    product = pds4_tools.read(str(path), quiet=True, lazy_load=True, no_scale=True)
    for element in product.label.findall(".//file_name"):
        if Path(element.text).name != element.text or not (path.parent / element.text).is_file():
            raise ValueError(f"the file {element.text!r} that it describes is not beside it")
    image = next((each for each in product if _is_image(each)), None)
    if image is None:
        raise ValueError("it describes no image of lines and samples in one band")
    stored = np.asarray(image.data)
    mask = _special(stored, image.meta_data.get("Special_Constants", {}))
    element = image.meta_data["Element_Array"]
    scale, offset = float(element.get("scaling_factor", 1.0)), float(element.get("value_offset", 0.0))
    pixels = stored if (scale, offset) == (1.0, 0.0) else (stored * scale + offset).astype(np.float32)
    header, units = _leaves(product.label.getroot())
    return {
        "pixels": pixels.reshape(pixels.shape[-2:]),
        "mask": mask.reshape(mask.shape[-2:]),
        "header": np.array(json.dumps(header)),
        "units": np.array(json.dumps(units)),
    }


def _is_image(structure: Any) -> bool:
    """True for an array of lines and samples, or of one band of them."""
    if not structure.is_array():
        return False
    axes = [(str(axis["axis_name"]).lower(), axis["elements"]) for axis in structure.meta_data.get_axis_arrays()]
    if damaged := [name for name, number in axes if not isinstance(number, int)]:
        raise ValueError(f"its axis {damaged[0]!r} has no number of elements")
    *bands, lines, samples = axes or [("", 0)] * 2
    return lines[0] == "line" and samples[0] == "sample" and all(number == 1 for _, number in bands)


def _special(stored: NDArray[Any], constants: Mapping[str, Any]) -> Mask:
    """True where a stored value is a special constant or outside the valid range."""
    mask = np.zeros(stored.shape, dtype=bool)
    for name, value in constants.items():
        if name == "valid_minimum":
            mask |= stored < value
        elif name == "valid_maximum":
            mask |= stored > value
        elif name.endswith("_constant"):
            mask |= stored == value
    return mask


def _leaves(root: Any) -> tuple[dict[str, HeaderValue], dict[str, str]]:
    """Text of the first leaf of each path, and units by the same path; names without their namespaces."""
    header: dict[str, HeaderValue] = {}
    units: dict[str, str] = {}
    waiting = [(root, "")]
    while waiting:
        element, path = waiting.pop()
        children = list(element)
        waiting.extend((child, f"{path}{_local(child.tag)}.") for child in reversed(children))
        if not children and (text := (element.text or "").strip()) and path[:-1] not in header:
            header[path[:-1]] = text
            if "unit" in element.attrib:
                units[path[:-1]] = element.attrib["unit"]
    return header, units


def _local(tag: object) -> str:
    return str(tag).rpartition("}")[2]


def _leaf(header: Mapping[str, HeaderValue], name: str) -> HeaderValue | None:
    """Value of the first leaf of a name."""
    return next((value for path, value in header.items() if path.rpartition(".")[2] == name), None)


def _exposure_s(header: Mapping[str, HeaderValue], units: Mapping[str, str]) -> float | None:
    """Exposure time, s; None where the label does not give it, or in a unit that is not known."""
    for path, value in header.items():
        if path.rpartition(".")[2] == "exposure_duration":
            try:
                return float(value) * _SECONDS[units.get(path, "")]
            except (ValueError, KeyError):
                return None
    return None
