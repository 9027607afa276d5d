"""Real cameras as data that ships with the package, one TOML file each in ``giantlike/camera_models/presets``.

A preset holds only values that its sources state: a camera without a ``psf`` or a detector noise has none in them, and
estimators take both from the image. A calibration from stars of one's own images is better.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from importlib.resources import files

from giantlike.camera import Camera
from giantlike.core.errors import InputError

_FOLDER = files("giantlike.camera_models") / "presets"


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPreset:
    """A real camera with notes about its images.

    Parameters
    ----------
    name : str; name of the preset
    camera : Camera
    bottom_up : bool; True if image files store the bottom row first, as ``images.bottom_up`` of a campaign says
    about : str; frames that it describes, and effects that it neglects
    sources : tuple of str; where the numbers come from
    """

    name: str
    camera: Camera
    bottom_up: bool
    about: str
    sources: tuple[str, ...]


def preset_names() -> tuple[str, ...]:
    """Names of the presets, sorted."""
    return tuple(sorted(file.name.removesuffix(".toml") for file in _FOLDER.iterdir() if file.name.endswith(".toml")))


def camera_preset(name: str) -> CameraPreset:
    """Return a real camera by its name.

    Parameters
    ----------
    name : str; one of :func:`preset_names`

    Raises
    ------
    InputError
        The name is unknown.

    Examples
    --------
    >>> camera_preset("cassini_nac").camera.columns
    1024
    """
    if name not in preset_names():
        raise InputError(f"there is no camera preset {name!r}; there are {', '.join(preset_names())}")
    table = tomllib.loads((_FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
    about = table["preset"]
    return CameraPreset(
        name=name,
        camera=Camera.from_mapping(table["camera"]),
        bottom_up=about["bottom_up"],
        about=about["about"],
        sources=tuple(about["sources"]),
    )
