"""LMK files of stereophotoclinometry (SPC): place, axes and errors of a landmark, and where images show it.

Source opened: the wiki of SPC at the Planetary Science Institute, page LMKFILES, revisions 3 and 9 (fields, order and
an example). Pixels count from 1 as in SUMFILEs, which the page does not say either; :class:`Lmk` has them from 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import write_text_atomic
from giantlike.core.arrays import Float, as_finite, require
from giantlike.core.errors import DataError, InputError
from giantlike.core.values import Value
from giantlike.io.spc_sumfile import FIRST_PIXEL, Sumfile, numbers_line, read_axes, read_numbers, read_sumfile

_SECTIONS = ("PICTURES", "MAP OVERLAPS", "LIMB FITS", "END FILE")
_NAME_LENGTH, _IMAGE_LENGTH = 6, 12
_SAME_PX = 0.01  # largest difference of a pixel between an LMK file and a SUMFILE: three digits, and both rounded


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lmk(Value):
    """Content of an LMK file."""

    name: str  # of the landmark, up to 6 characters
    half_size: int  # pixels of its map from the center to the edge: the map has ``2 half_size + 1`` along each side
    scale_km: float  # of a pixel of the map
    position_body_km: Float  # of its center
    body_from_local: Rotation  # from the axes of its map, the third one outward; their unit vectors are its columns
    sigma_body_km: Float  # errors of the position along the body axes
    has_topography: bool = True  # whether it has a map of heights
    sigma_km: float = 0.0  # sigma_km, rms_km: error of the position, and RMS of the landmark
    rms_km: float = 0.0
    horizon: tuple[int, int, int, int] = (-1, -1, -1, -1)  # no longer used
    # pictures_px, limbs_px: mapping of str to (2,); places in images by their names; 0 is the center of the first pixel
    pictures_px: Mapping[str, Float] = field(default_factory=dict)
    overlaps: Mapping[str, Float] = field(default_factory=dict)  # (3,); offsets to other landmarks by name
    limbs_px: Mapping[str, Float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _require_name(self.name, _NAME_LENGTH)
        require(self.half_size > 0, f"{self.name}: half_size must be > 0, got {self.half_size}")
        require(0 < self.scale_km < np.inf, f"{self.name}: scale_km must be > 0, got {self.scale_km}")
        for name in ("position_body_km", "sigma_body_km"):
            object.__setattr__(self, name, as_finite(getattr(self, name), (3,), name))
        for name, size, length in (("pictures_px", 2, _IMAGE_LENGTH), ("overlaps", 3, _NAME_LENGTH),
                                   ("limbs_px", 2, _IMAGE_LENGTH)):  # fmt: skip
            for key in getattr(self, name):
                _require_name(key, length)
            values = {key: as_finite(value, (size,), f"{name}[{key!r}]") for key, value in getattr(self, name).items()}
            object.__setattr__(self, name, values)
        Value.__post_init__(self)


def write_lmk(path: str | Path, content: Lmk) -> None:
    """Write an LMK file."""
    axes = content.body_from_local.as_matrix().T
    lines = [
        f"{content.name:<6} {'T' if content.has_topography else 'F'}{'':<40}NAME, HFLAG",
        f"{content.half_size:8d}{content.scale_km:16.8f}{'':<24}SIZE, SCALE(KM)",
        "".join(f"{value:8d}" for value in content.horizon) + f"{'':<16}HORIZON",
        numbers_line([content.sigma_km, content.rms_km], "SIGKM, RMSLMK"),
        numbers_line(content.position_body_km, "VLM"),
        *(numbers_line(axis, name) for axis, name in zip(axes, ("UX", "UY", "UZ"), strict=True)),
        numbers_line(content.sigma_body_km, "SIGMA_LMK"),
        "PICTURES",
        *_place_lines(content.pictures_px),
        "MAP OVERLAPS",
        *(f"{name:<6}{x:16.8f}{y:16.8f}{z:16.8f}" for name, (x, y, z) in content.overlaps.items()),
        "LIMB FITS",
        *_place_lines(content.limbs_px),
        "END FILE",
    ]
    write_text_atomic(Path(path), "\n".join(lines) + "\n")


def read_lmk(path: str | Path) -> Lmk:
    """Read an LMK file."""
    path = Path(path)
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, f"cannot be read as an LMK file: {error}") from error
    named = {line.strip(): number for number, line in enumerate(lines) if line.strip() in _SECTIONS}
    words = lines[0].split() if lines else []
    if len(lines) < 11 or len(words) < 2 or list(named) != [name for name in _SECTIONS if name in named]:
        raise DataError(path, f"is no LMK file: it needs a name, nine lines of numbers and {', '.join(_SECTIONS)}")
    if "PICTURES" not in named or "END FILE" not in named:
        raise DataError(
            path, f"is cut off: it has {', '.join(named) or 'no section'}, and PICTURES to END FILE are needed"
        )
    size, horizon, errors, position, sigma = (
        read_numbers(path, lines, number, count) for number, count in ((1, 2), (2, 4), (3, 2), (4, 3), (8, 3))
    )

    def section(name: str, count: int) -> dict[str, Float]:
        if name not in named:
            return {}
        last = min((number for number in named.values() if number > named[name]), default=len(lines))
        return dict(_read_places(path, lines, range(named[name] + 1, last), count))

    first, second, third, fourth = (int(value) for value in horizon)
    axes = read_axes(path, lines, 5, "UX, UY, UZ")
    try:
        return Lmk(
            name=words[0],
            has_topography=words[1].upper() == "T",
            half_size=int(size[0]),
            scale_km=float(size[1]),
            horizon=(first, second, third, fourth),
            sigma_km=float(errors[0]),
            rms_km=float(errors[1]),
            position_body_km=position,
            body_from_local=Rotation.from_matrix(axes.T),
            sigma_body_km=sigma,
            pictures_px={name: place - FIRST_PIXEL for name, place in section("PICTURES", 2).items()},
            overlaps=section("MAP OVERLAPS", 3),
            limbs_px={name: place - FIRST_PIXEL for name, place in section("LIMB FITS", 2).items()},
        )
    except InputError as error:
        raise DataError(path, str(error)) from error


def read_lmks(folder: str | Path, sumfiles: str | Path | None = None) -> dict[str, Lmk]:
    """Landmarks by name of all LMK files of a folder, their pixels compared with SUMFILEs of another folder."""
    folder = Path(folder)
    landmarks = {landmark.name: landmark for landmark in map(read_lmk, sorted(folder.glob("*.LMK")))}
    if not landmarks:
        raise DataError(folder, "there is no file *.LMK")
    if sumfiles is not None:
        pictures = {one.name: one for one in map(read_sumfile, sorted(Path(sumfiles).glob("*.SUM")))}
        for landmark in landmarks.values():
            _require_same_pictures(folder / f"{landmark.name}.LMK", landmark, pictures)
    return landmarks


def _require_same_pictures(path: Path, landmark: Lmk, pictures: Mapping[str, Sumfile]) -> None:
    """Raise where a landmark lies elsewhere in its file than in the SUMFILE of an image."""
    for image, place in landmark.pictures_px.items():
        if image not in pictures:
            raise DataError(path, f"names the image {image}, which has no SUMFILE")
        there = pictures[image].landmarks_px.get(landmark.name)
        if there is None or np.abs(there - place).max() > _SAME_PX:
            said = "does not have it" if there is None else f"has it at {(there + FIRST_PIXEL).tolist()}"
            raise DataError(path, f"is in {image} at {(place + FIRST_PIXEL).tolist()} px, and {image}.SUM {said}")


def _place_lines(places_px: Mapping[str, Float]) -> Iterator[str]:
    """Lines of names and pixels."""
    return (f"{name:<12}{x + FIRST_PIXEL:12.3f}{y + FIRST_PIXEL:12.3f}" for name, (x, y) in places_px.items())


def _read_places(path: Path, lines: list[str], numbers: Iterable[int], count: int) -> Iterator[tuple[str, Float]]:
    """Yield names and numbers of lines."""
    for number in numbers:
        words = lines[number].split()
        if words:
            yield words[0], read_numbers(path, lines, number, count, skip=1)


def _require_name(name: str, length: int) -> None:
    """Raise unless a name is one word of so many characters."""
    sound = name.isascii() and name.isprintable() and len(name.split()) == 1 and name == name.strip()
    require(sound and len(name) <= length, f"SPC needs names of one word of at most {length} characters, got {name!r}")
