"""A camera: model, point spread function and detector, as a value with a TOML file."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import tomli_w
from numpy.typing import ArrayLike, NDArray

from giantlike.camera_models import CameraModel, PinholeModel, model_from_mapping, model_to_mapping
from giantlike.core.arrays import Float, as_floats, require
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import DataError, InputError
from giantlike.io.atomic import write_text_atomic

Part = TypeVar("Part", GaussianPsf, Detector)


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """What turns directions into pixels and light into numbers.

    Parameters
    ----------
    name : str
    columns, rows : int
        Size of the detector as stored in the images.
    model : CameraModel
    psf : GaussianPsf, optional
        None when unknown: what needs it then estimates it from the image or says so.
    detector : Detector

    Raises
    ------
    InputError
        The size is not positive.
    """

    name: str
    columns: int
    rows: int
    model: CameraModel
    psf: GaussianPsf | None = None
    detector: Detector = field(default_factory=Detector)

    def __post_init__(self) -> None:
        for key in ("columns", "rows"):
            value = getattr(self, key)
            require(
                isinstance(value, int) and not isinstance(value, bool) and value > 0,
                f"camera {self.name!r}: {key} must be a positive whole number, got {value!r}",
            )

    @classmethod
    def from_fov(cls, fov_deg: float, columns: int, rows: int, *, name: str = "camera") -> Camera:
        """Return a pinhole camera of a rough field of view along x, principal point at the image centre.

        >>> round(Camera.from_fov(90.0, 100, 80).model.focal_length_px, 9)
        50.0
        """
        require(0 < fov_deg < 170, f"fov_deg must be between 0 and 170, got {fov_deg}")
        focal = columns / (2 * math.tan(math.radians(fov_deg) / 2))
        model = PinholeModel(fx_px=focal, fy_px=focal, cx_px=(columns - 1) / 2, cy_px=(rows - 1) / 2)
        return cls(name=name, columns=columns, rows=rows, model=model)

    @classmethod
    def load(cls, path: str | Path) -> Camera:
        """Read a camera TOML file.

        Raises
        ------
        DataError
            The file is missing or no TOML, a key is unknown or missing, or a value is out of range.
        """
        try:
            with Path(path).open("rb") as stream:
                table = tomllib.load(stream)
        except OSError as error:
            raise DataError(path, f"cannot read camera file: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise DataError(path, f"is not valid TOML: {error}") from error
        try:
            return cls.from_mapping(table)
        except InputError as error:
            raise DataError(path, str(error)) from error

    @classmethod
    def from_mapping(cls, table: Mapping[str, Any]) -> Camera:
        """Build a camera from the keys of a camera file.

        Raises
        ------
        InputError
            A key is unknown or missing, or a value is of the wrong kind or out of range.
        """
        known = ("name", "columns", "rows", "model", "psf", "detector")
        for key in table:
            if key not in known:
                raise InputError(f"unknown key {key!r}; a camera has {', '.join(known)}")
        for key in ("columns", "rows", "model"):
            if key not in table:
                raise InputError(f"key {key!r} is missing")
        model = table["model"]
        if not isinstance(model, Mapping):
            raise InputError(f"[model] must be a table, got {model!r}")
        return cls(
            name=str(table.get("name", "camera")),
            columns=table["columns"],
            rows=table["rows"],
            model=model_from_mapping(model),
            psf=_part(GaussianPsf, table["psf"], "psf") if "psf" in table else None,
            detector=_part(Detector, table.get("detector", {}), "detector"),
        )

    def to_mapping(self) -> dict[str, Any]:
        """The keys of a camera file; what is unknown or infinite is left out."""
        table: dict[str, Any] = {"name": self.name, "columns": self.columns, "rows": self.rows}
        table["model"] = model_to_mapping(self.model)
        if self.psf is not None:
            table["psf"] = _numbers(self.psf)
        return table | {"detector": _numbers(self.detector)}

    def save(self, path: str | Path) -> None:
        """Write a camera TOML file that :meth:`load` reads back exactly."""
        write_text_atomic(Path(path), tomli_w.dumps(self.to_mapping()))

    @property
    def center_px(self) -> Float:
        """Middle of the image ((columns - 1) / 2, (rows - 1) / 2), px: what RA, Dec and roll refer to."""
        return np.array([(self.columns - 1) / 2, (self.rows - 1) / 2])

    @property
    def fov_deg(self) -> float:
        """Field of view along x, ``2 atan(columns / (2 fx))``, degrees."""
        return math.degrees(2 * math.atan(self.columns / (2 * self.model.focal_length_px)))

    @property
    def half_diagonal_rad(self) -> float:
        """Largest angle between the line of sight of the image centre and an image corner, rad."""
        right, bottom = self.columns - 0.5, self.rows - 0.5
        corners = self.model.unproject([[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]])
        cosines = corners @ self.model.unproject(self.center_px)
        return float(np.arccos(np.clip(np.min(cosines), -1.0, 1.0)))

    def contains(self, points_px: ArrayLike, *, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """Whether pixels (..., 2) lie on the detector, at least ``margin_px`` from its edge; NaN does not."""
        points = as_floats(points_px, (2,), "points_px")
        low, high = margin_px - 0.5, np.array([self.columns, self.rows]) - 0.5 - margin_px
        with np.errstate(invalid="ignore"):
            result: NDArray[np.bool_] = np.all((points >= low) & (points <= high), axis=-1)
        return result


def _part(kind: type[Part], table: Any, name: str) -> Part:
    if not isinstance(table, Mapping):
        raise InputError(f"[{name}] must be a table, got {table!r}")
    known = [entry.name for entry in fields(kind)]
    for key, value in table.items():
        if key not in known:
            raise InputError(f"[{name}] unknown key {key!r}; keys are {', '.join(known)}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"[{name}] {key} must be a number, got {value!r}")
    return kind(**{key: float(value) for key, value in table.items()})


def _numbers(part: GaussianPsf | Detector) -> dict[str, float]:
    values = {entry.name: float(getattr(part, entry.name)) for entry in fields(part)}
    return {key: value for key, value in values.items() if math.isfinite(value)}
