"""A camera: model, point spread function and detector, as a value with a TOML file."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import tomli_w
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera_models import (
    MODELS,
    CameraModel,
    GridCorrectedModel,
    ifov_rad,
    model_from_mapping,
    model_to_mapping,
)
from giantlike.camera_models.affine import AffineModel
from giantlike.camera_models.convert import WIDE_START, frame_grid
from giantlike.camera_models.plane import PlaneModel
from giantlike.core.arrays import Float, as_finite, as_floats, require
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import quaternion_xyzw, rotation_from_xyzw
from giantlike.io.atomic import write_text_atomic

Part = TypeVar("Part", GaussianPsf, Detector)
_WIDEST_PLANE_DEG, _WIDEST_FISHEYE_DEG = 170.0, 360.0
_EDGE_NODES = 33  # along the longer side; the corners are among them


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelUncertainty:
    """How well the parameters of a camera model are known: the ``[calibration]`` table of a camera file.

    Parameters
    ----------
    estimated : tuple of str
        Names of the k parameters that were estimated; the others were taken as they are.
    covariance : (k, k) float64
        Of those, in their units.
    residual_sigma_px : float, px
        Post-fit residual per axis of the calibration.
    n_observations, n_images : int
        What it rests on.

    Raises
    ------
    InputError
        The covariance has another shape, or is not symmetric.
    """

    estimated: tuple[str, ...]
    covariance: Float
    residual_sigma_px: float
    n_observations: int
    n_images: int

    def __post_init__(self) -> None:
        count = len(self.estimated)
        covariance = as_finite(self.covariance, (count, count), "[calibration] covariance")
        tolerance = 1e-6 * np.sqrt(np.abs(np.outer(np.diag(covariance), np.diag(covariance))))
        symmetric = bool((np.abs(covariance - covariance.T) <= tolerance).all())
        require(symmetric, "[calibration] covariance must be symmetric")
        object.__setattr__(self, "covariance", covariance)

    @classmethod
    def from_mapping(cls, table: Mapping[str, Any], known: tuple[str, ...]) -> ModelUncertainty:
        """Build from the ``[calibration]`` table of a camera whose model has the parameters ``known``.

        Raises
        ------
        InputError
            A key is missing or unknown, or a parameter is none of the model.
        """
        names = [entry.name for entry in fields(cls)]
        for key in (*table, *names):
            require(key in names, f"[calibration] unknown key {key!r}; keys are {', '.join(names)}")
            require(key in table, f"[calibration] {key} is missing")
        estimated = table["estimated"]
        require(isinstance(estimated, list), f"[calibration] estimated must be a list of names, got {estimated!r}")
        for name in estimated:
            require(name in known, f"[calibration] estimated: the model has no parameter {name!r}")
        return cls(**(dict(table) | {"estimated": tuple(estimated)}))

    def to_mapping(self) -> dict[str, Any]:
        """The ``[calibration]`` table."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return values | {"estimated": list(self.estimated), "covariance": self.covariance.tolist()}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MissionFrame:
    """The camera frame of a mission's own kernels: the ``[mission_frame]`` table of a camera file.

    Parameters
    ----------
    name : str
        As in the mission's frame kernel.
    camera_from_mission : Rotation
        Takes vectors in that frame to our camera axes: ``camera_from_inertial = camera_from_mission *
        mission_from_inertial``, the last from pointing kernels.
    """

    name: str
    camera_from_mission: Rotation

    @classmethod
    def from_mapping(cls, table: Any) -> MissionFrame:
        """Build from the ``[mission_frame]`` table.

        Raises
        ------
        InputError
            It is no table, or a key is missing or unknown, or the quaternion is not unit.
        """
        keys = ("name", "camera_from_mission_xyzw")
        require(isinstance(table, Mapping), f"[mission_frame] must be a table, got {table!r}")
        require(set(table) == set(keys), f"[mission_frame] needs the keys {', '.join(keys)}; got {', '.join(table)}")
        quaternion = rotation_from_xyzw(table[keys[1]], "[mission_frame] camera_from_mission_xyzw")
        return cls(name=str(table["name"]), camera_from_mission=quaternion)

    def to_mapping(self) -> dict[str, Any]:
        """The ``[mission_frame]`` table."""
        return {"name": self.name, "camera_from_mission_xyzw": quaternion_xyzw(self.camera_from_mission).tolist()}


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
    uncertainty : ModelUncertainty, optional
        Of the model, where it was calibrated: the ``[calibration]`` table of its file.
    mission_frame : MissionFrame, optional
        Axes of the mission's own kernels, where the model was turned into ours on import.

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
    uncertainty: ModelUncertainty | None = field(default=None, compare=False)
    mission_frame: MissionFrame | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        for key in ("columns", "rows"):
            value = getattr(self, key)
            require(
                isinstance(value, int) and not isinstance(value, bool) and value > 0,
                f"camera {self.name!r}: {key} must be a positive whole number, got {value!r}",
            )

    @classmethod
    def from_fov(
        cls, fov_deg: float, columns: int, rows: int, *, name: str = "camera", type_name: str = "pinhole"
    ) -> Camera:
        """Return a camera of a rough field of view along x, principal point at the image center, ideal lens.

        Parameters
        ----------
        fov_deg : float, degrees
        columns, rows : int
        name : str
        type_name : str
            A key of :data:`~giantlike.camera_models.MODELS`.

        Raises
        ------
        InputError
            The type is unknown or such a lens does not see so much.

        >>> round(Camera.from_fov(90.0, 100, 80).model.focal_length_px, 9)
        50.0
        """
        require(type_name in MODELS, f"camera model type must be one of {', '.join(sorted(MODELS))}, got {type_name!r}")
        widest = _WIDEST_PLANE_DEG if issubclass(MODELS[type_name], PlaneModel) else _WIDEST_FISHEYE_DEG
        require(0 < fov_deg < widest, f"fov_deg must be between 0 and {widest:g} for {type_name}, got {fov_deg}")
        half = math.radians(fov_deg) / 2
        unit = MODELS[type_name](fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, **WIDE_START.get(type_name, {}))
        focal = columns / (2 * float(unit.project([math.sin(half), 0.0, math.cos(half)])[0]))
        values = {"fx_px": focal, "fy_px": focal, "cx_px": (columns - 1) / 2, "cy_px": (rows - 1) / 2}
        return cls(name=name, columns=columns, rows=rows, model=dataclasses.replace(unit, **values))

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

        ``fov_deg``, a rough field of view along x, may take the place of the model: see :meth:`from_fov`.

        Raises
        ------
        InputError
            A key is unknown or missing, or a value is of the wrong kind or out of range.
        """
        known = ("name", "columns", "rows", "model", "fov_deg", "psf", "detector", "calibration", "mission_frame")
        for key in table:
            if key not in known:
                raise InputError(f"unknown key {key!r}; a camera has {', '.join(known)}")
        for key in ("columns", "rows"):
            if key not in table:
                raise InputError(f"key {key!r} is missing")
        built = _model(table)
        uncertainty = table.get("calibration")
        if uncertainty is not None and not isinstance(uncertainty, Mapping):
            raise InputError(f"[calibration] must be a table, got {uncertainty!r}")
        return cls(
            name=str(table.get("name", "camera")),
            columns=table["columns"],
            rows=table["rows"],
            model=built,
            psf=_part(GaussianPsf, table["psf"], "psf") if "psf" in table else None,
            detector=_part(Detector, table.get("detector", {}), "detector"),
            uncertainty=None
            if uncertainty is None
            else ModelUncertainty.from_mapping(uncertainty, built.parameter_names),
            mission_frame=MissionFrame.from_mapping(table["mission_frame"]) if "mission_frame" in table else None,
        )

    def to_mapping(self) -> dict[str, Any]:
        """The keys of a camera file; what is unknown or infinite is left out."""
        table: dict[str, Any] = {"name": self.name, "columns": self.columns, "rows": self.rows}
        table["model"] = model_to_mapping(self.model)
        if self.psf is not None:
            table["psf"] = _numbers(self.psf)
        table["detector"] = _numbers(self.detector)
        if self.uncertainty is not None:
            table["calibration"] = self.uncertainty.to_mapping()
        if self.mission_frame is not None:
            table["mission_frame"] = self.mission_frame.to_mapping()
        return table

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
        """Largest angle between the line of sight of the image center and any other that the image holds, rad.

        That of a corner, or of the rim of the image circle where a lens leaves the corners dark; NaN when the lens
        shows nothing.
        """
        edge = frame_grid(self.columns, self.rows, nodes=_EDGE_NODES)
        cosines = self.model.unproject(edge) @ self.model.unproject(self.center_px)
        seen = cosines[np.isfinite(cosines)]
        return float(np.arccos(np.clip(seen.min(), -1.0, 1.0))) if seen.size else math.nan

    def at_temperature(self, temperature_c: float) -> Camera:
        """Return the camera at a temperature in degrees Celsius: its model scaled by the temperature terms."""
        return replace(self, model=self.model.at_temperature(temperature_c))

    def windowed(self, x0_px: int, y0_px: int, *, columns: int, rows: int) -> Camera:
        """Return the camera of a window of the detector whose first pixel is (``x0_px``, ``y0_px``).

        Raises
        ------
        InputError
            The window reaches over the detector, or the model can't be windowed.
        """
        inside = 0 <= x0_px <= self.columns - columns and 0 <= y0_px <= self.rows - rows
        require(inside, f"the window must lie on the {self.columns} by {self.rows} detector")
        return replace(self, columns=columns, rows=rows, model=_lens(self.model).windowed(x0_px, y0_px))

    def binned(self, factor: int, *, detector: Detector) -> Camera:
        """Return the camera of images whose pixels are ``factor`` by ``factor`` of these, first block first.

        ``detector`` is the one of the binned images: whether binning adds read noise or lowers it, and where it
        saturates, depends on the electronics. Columns and rows that fill no block are left out.
        """
        psf = None if self.psf is None else GaussianPsf(sigma_px=self.psf.sigma_px / factor)
        return replace(
            self,
            columns=self.columns // factor,
            rows=self.rows // factor,
            model=_lens(self.model).binned(factor),
            psf=psf,
            detector=detector,
        )

    def in_field(self, points_camera: ArrayLike, *, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """Whether points or directions (..., 3) in camera axes are imaged, at least ``margin_px`` from the edge."""
        return self.contains(self.model.project(points_camera), margin_px=margin_px)

    def ifov_rad(self, points_px: ArrayLike | None = None) -> Float:
        """Geometric-mean angle (...,), rad, that a pixel subtends at pixels (..., 2); default the image center."""
        return ifov_rad(self.model, self.center_px if points_px is None else points_px)

    def contains(self, points_px: ArrayLike, *, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """Whether pixels (..., 2) lie on the detector, at least ``margin_px`` from its edge; NaN does not."""
        points = as_floats(points_px, (2,), "points_px")
        low, high = margin_px - 0.5, np.array([self.columns, self.rows]) - 0.5 - margin_px
        with np.errstate(invalid="ignore"):
            result: NDArray[np.bool_] = np.all((points >= low) & (points <= high), axis=-1)
        return result


def _lens(model: CameraModel) -> AffineModel | GridCorrectedModel:
    """The model as one that knows about binning and windows."""
    if not isinstance(model, AffineModel | GridCorrectedModel):
        raise InputError(f"a {model.type_name} model can't be binned or windowed")
    return model


def _model(table: Mapping[str, Any]) -> CameraModel:
    """Model of a camera file; a pinhole where only a field of view is given."""
    if "fov_deg" in table:
        fov = table["fov_deg"]
        sizes = [table[key] for key in ("columns", "rows")]
        require(all(isinstance(size, int) and size > 0 for size in sizes), f"columns, rows must be whole, got {sizes}")
        require("model" not in table, "give either [model] or fov_deg, not both")
        require(isinstance(fov, int | float) and not isinstance(fov, bool), f"fov_deg must be a number, got {fov!r}")
        return Camera.from_fov(float(fov), table["columns"], table["rows"]).model
    if "model" not in table:
        raise InputError("key 'model' is missing")
    if not isinstance(table["model"], Mapping):
        raise InputError(f"[model] must be a table, got {table['model']!r}")
    return model_from_mapping(table["model"])


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
