"""A camera: model, point spread function and detector, as a value with a TOML file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import tomli_w
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import write_text_atomic
from giantlike._system.reading import toml_table
from giantlike.camera_models import CameraModel, ifov_rad, model_from_mapping, model_to_mapping
from giantlike.camera_models.convert import WIDE_START, frame_grid
from giantlike.camera_models.part import divisible
from giantlike.camera_models.plane import PlaneModel
from giantlike.camera_models.registry import lens_class
from giantlike.core.arrays import Float, Mask, as_finite, as_floats, require
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.display import Pictured
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import FrameRotation, quaternion_xyzw, require_same_frame, rotation_from_xyzw
from giantlike.core.photometry import Photometry
from giantlike.core.tables import checked_table, record_of_numbers, table_of_numbers
from giantlike.core.values import Value

if TYPE_CHECKING:
    from giantlike.image import Image

DEFAULT_NAME = "camera"
"""Name of a camera that was given none; it does not tell one camera from another."""
_WIDEST_PLANE_DEG = 170.0  # a gnomonic focal plane of 11 focal lengths each way; at 180 degrees it is infinite
_WIDEST_FISHEYE_DEG = 360.0  # all directions
_WHOLE_PX = 1e-6  # rounding of a size divided by a factor that is no whole number
_EDGE_NODES = 33  # nodes along the longer side of the frame; the corners are among them


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelUncertainty(Value):
    """Uncertainty of the parameters of a camera model: the ``[calibration]`` table of a camera file.

    Parameters
    ----------
    estimated : tuple of str; names of the k parameters that were estimated; the others were held fixed
    covariance : (k, k) float64; covariance of the estimated parameters, in their units
    residual_sigma_px : float, px; standard deviation of the post-fit residuals, per axis
    n_observations, n_images : int; numbers of star observations and of images that were fitted

    Raises
    ------
    InputError
        The names are not a list, or the covariance has another shape, is not symmetric or not positive semi-definite.
    """

    estimated: tuple[str, ...]
    covariance: Float
    residual_sigma_px: float
    n_observations: int
    n_images: int

    def __post_init__(self) -> None:
        require(
            isinstance(self.estimated, tuple | list),
            f"[calibration] estimated must be a list of names, got {self.estimated!r}",
        )
        count = len(self.estimated)
        covariance = as_finite(self.covariance, (count, count), "[calibration] covariance")
        self._keep(estimated=tuple(self.estimated), covariance=covariance)

    @classmethod
    def from_mapping(cls, table: object) -> ModelUncertainty:
        """Build from the ``[calibration]`` table of a camera file, whose keys are the fields; InputError if wrong."""
        names = [entry.name for entry in fields(cls)]
        return cls(**checked_table(table, "[calibration]", names, names))

    def to_mapping(self) -> dict[str, Any]:
        """Return the ``[calibration]`` table of a camera file."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return values | {"estimated": list(self.estimated), "covariance": self.covariance.tolist()}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MissionFrame(Value):
    """Camera frame of a mission's own kernels: the ``[mission_frame]`` table of a camera file.

    Parameters
    ----------
    name : str; name in the mission's frame kernel
    camera_from_mission : Rotation
        Takes vectors in that frame to the camera axes of this package: ``camera_from_inertial =
        camera_from_mission * mission_from_inertial``, the last from pointing kernels.
    """

    name: str
    camera_from_mission: Rotation

    def mission_from_camera(self, camera: Camera) -> FrameRotation:
        """Return the rotation from the axes of a camera, which this frame belongs to, with the names of both."""
        return FrameRotation(rotation=self.camera_from_mission.inv(), target=self.name, source=camera.frame_name)

    @classmethod
    def from_mapping(cls, table: object) -> MissionFrame:
        """Build from the ``[mission_frame]`` table of a camera file.

        Its keys are ``name`` and ``camera_from_mission_xyzw``, a unit quaternion with the scalar last; InputError for
        anything else.
        """
        keys = ("name", "camera_from_mission_xyzw")
        checked = checked_table(table, "[mission_frame]", keys, keys)
        turn = rotation_from_xyzw(checked[keys[1]], "[mission_frame] camera_from_mission_xyzw")
        return cls(name=str(checked["name"]), camera_from_mission=turn)

    def to_mapping(self) -> dict[str, Any]:
        """Return the ``[mission_frame]`` table of a camera file."""
        return {"name": self.name, "camera_from_mission_xyzw": quaternion_xyzw(self.camera_from_mission).tolist()}


class _Section(NamedTuple):
    """A table of a camera file: its name there and in :class:`Camera`, and the functions that read and write it."""

    key: str
    attribute: str
    read: Callable[[Any], object]
    write: Callable[[Any], Mapping[str, Any]]


_SECTIONS = (
    _Section("model", "model", model_from_mapping, model_to_mapping),
    _Section("psf", "psf", partial(record_of_numbers, GaussianPsf, where="[psf]"), table_of_numbers),
    _Section("detector", "detector", Detector.from_mapping, Detector.to_mapping),
    _Section("calibration", "uncertainty", ModelUncertainty.from_mapping, ModelUncertainty.to_mapping),
    _Section("mission_frame", "mission_frame", MissionFrame.from_mapping, MissionFrame.to_mapping),
    _Section("photometry", "photometry", Photometry.from_mapping, Photometry.to_mapping),
)
_SIZE = ("columns", "rows")
_KEYS = ("name", *_SIZE, "fov_deg", *(section.key for section in _SECTIONS))


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera(Pictured):
    """A lens, a point spread function and a detector: turns directions into pixels and light into numbers.

    Parameters
    ----------
    name : str; name in tables and messages; also stands for the camera axes where frames are checked
    columns, rows : int; size of the stored images
    model : CameraModel; projection from camera axes to pixels
    psf : GaussianPsf, optional; None when unknown: algorithms estimate it from the image or return a failure
    detector : Detector; gain, read noise, saturation and bias
    uncertainty : ModelUncertainty, optional; of a calibrated model, the ``[calibration]`` table of its file
    mission_frame : MissionFrame, optional; axes of the mission's kernels, where they differ from camera axes
    photometry : Photometry, optional; zero point; None where it is unknown

    Raises
    ------
    InputError
        The size is not positive, or ``uncertainty`` names a parameter that the model does not have.
    """

    name: str
    columns: int
    rows: int
    model: CameraModel
    psf: GaussianPsf | None = None
    detector: Detector = field(default_factory=partial(Detector, estimated=True))
    uncertainty: ModelUncertainty | None = field(default=None, compare=False)
    mission_frame: MissionFrame | None = field(default=None, compare=False)
    photometry: Photometry | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        _require_size(self.name, self.columns, self.rows)
        for name in () if self.uncertainty is None else self.uncertainty.estimated:
            require(
                name in self.model.parameter_names,
                f"[calibration] estimated: the model has no parameter {name!r}; it has "
                f"{', '.join(self.model.parameter_names)}",
            )

    def __repr__(self) -> str:
        edges = self.model.unproject(np.array([[-0.5, self.center_px[1]], [self.columns - 0.5, self.center_px[1]]]))
        fov_deg = math.degrees(math.acos(float(np.clip(edges[0] @ edges[1], -1.0, 1.0))))
        size = f"{self.columns} x {self.rows}"
        return f"Camera({self.name!r}, {size}, {type(self.model).__name__}, field of view {fov_deg:.4g} deg along x)"

    @classmethod
    def from_fov(
        cls, fov_deg: float, columns: int, rows: int, *, name: str = DEFAULT_NAME, type_name: str = "pinhole"
    ) -> Camera:
        """Return a camera with a rough field of view along x, an ideal lens and a centered principal point.

        Parameters
        ----------
        fov_deg : float, degrees; full angle from the left edge of the image to the right edge
        columns, rows : int
        name : str
        type_name : str; a key of :data:`~giantlike.camera_models.MODELS`

        Raises
        ------
        InputError
            The type is unknown, the field is wider than such a lens can image, or the size is not positive.

        Examples
        --------
        >>> round(Camera.from_fov(90.0, 100, 80).model.focal_length_px, 9)
        50.0
        """
        _require_size(name, columns, rows)
        kind = lens_class(type_name)
        widest = _WIDEST_PLANE_DEG if issubclass(kind, PlaneModel) else _WIDEST_FISHEYE_DEG
        require(0 < fov_deg < widest, f"fov_deg must be between 0 and {widest:g} for {type_name}, got {fov_deg}")
        half = math.radians(fov_deg) / 2
        unit = kind(fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, **WIDE_START.get(type_name, {}))
        focal = columns / (2 * float(unit.project([math.sin(half), 0.0, math.cos(half)])[0]))
        values = {"fx_px": focal, "fy_px": focal, "cx_px": (columns - 1) / 2, "cy_px": (rows - 1) / 2}
        return cls(name=name, columns=columns, rows=rows, model=replace(unit, **values))

    @classmethod
    def load(cls, path: str | Path) -> Camera:
        """Read a camera TOML file.

        Raises
        ------
        DataError
            The file is missing or not valid TOML, a key is unknown or missing, or a value is out of range.
        """
        table = toml_table(Path(path), "camera file")
        try:
            return cls.from_mapping(table)
        except InputError as error:
            raise DataError(path, str(error)) from error

    @classmethod
    def from_mapping(cls, table: Mapping[str, Any]) -> Camera:
        """Build a camera from the keys of a camera file, as :meth:`to_mapping` returns them.

        ``fov_deg``, a rough field of view along x, may take the place of ``model``: see :meth:`from_fov`. Raises
        InputError where a key is unknown or missing, or a value is of the wrong kind or out of range.
        """
        checked_table(table, "", _KEYS, _SIZE)
        name, columns, rows = str(table.get("name", DEFAULT_NAME)), table["columns"], table["rows"]
        parts: dict[str, Any] = {part.attribute: part.read(table[part.key]) for part in _SECTIONS if part.key in table}
        if "fov_deg" in table:
            fov = table["fov_deg"]
            require("model" not in parts, "give either [model] or fov_deg, not both")
            numeric = isinstance(fov, int | float) and not isinstance(fov, bool)
            require(numeric, f"fov_deg must be a number, got {fov!r}")
            parts["model"] = cls.from_fov(float(fov), columns, rows, name=name).model
        require("model" in parts, "key 'model' is missing; give a [model] table or fov_deg")
        return cls(name=name, columns=columns, rows=rows, **parts)

    def to_mapping(self) -> dict[str, Any]:
        """Return the keys of a camera file; unknown parts and infinite values are left out.

        They are ``name``, ``columns``, ``rows`` and the tables ``model``, ``psf``, ``detector``, ``calibration``,
        ``mission_frame`` and ``photometry``.
        """
        parts = {section: getattr(self, section.attribute) for section in _SECTIONS}
        tables = {section.key: section.write(part) for section, part in parts.items() if part is not None}
        return {"name": self.name, "columns": self.columns, "rows": self.rows, **tables}

    def save(self, path: str | Path) -> None:
        """Write a camera TOML file that :meth:`load` reads back exactly; an existing file is replaced."""
        write_text_atomic(Path(path), tomli_w.dumps(self.to_mapping()))

    @property
    def frame_name(self) -> str:
        """Name of the camera axes: the name of the camera, or empty for a camera without a name."""
        return "" if self.name == DEFAULT_NAME else self.name

    def require_image(self, image: Image) -> None:
        """Raise unless an image has the size of this camera and, where the image names its camera, is one of it.

        Raises
        ------
        InputError
            The image has another size than the camera.
        FrameMismatchError
            The image was taken by another camera, so its attitude refers to other axes.
        """
        require(
            (image.columns, image.rows) == (self.columns, self.rows),
            f"{image.name}: image is {image.columns} x {image.rows} pixels, camera {self.name!r} has {self.columns} x "
            f"{self.rows}; use the camera of this image, or Camera.binned or Camera.windowed of it (in a campaign, "
            "camera.binned)",
        )
        require_same_frame(image.camera_name, self.frame_name)

    @property
    def center_px(self) -> Float:
        """Center of the image ((columns - 1) / 2, (rows - 1) / 2), (2,), px; RA, Dec and roll refer to it."""
        return np.array([(self.columns - 1) / 2, (self.rows - 1) / 2])

    @property
    def fov_deg(self) -> float:
        """Field of view along x, ``2 atan(columns / (2 fx))``, degrees."""
        return math.degrees(2 * math.atan(self.columns / (2 * self.model.focal_length_px)))

    @property
    def half_diagonal_rad(self) -> float:
        """Largest angle between the line of sight of the image center and any other that the image holds, rad.

        The angle to a corner, or to the rim of the image circle where a lens leaves the corners dark; NaN when the
        lens images nothing.
        """
        return _half_diagonal_rad(self.model, self.columns, self.rows)

    def at_temperature(self, temperature_c: float) -> Camera:
        """Return the camera at a temperature of the optics, in Celsius: its model scaled by the temperature terms."""
        return replace(self, model=self.model.at_temperature(temperature_c))

    def windowed(self, x0_px: int, y0_px: int, *, columns: int, rows: int) -> Camera:
        """Return the camera for images that cover only a window of the detector.

        Parameters
        ----------
        x0_px, y0_px : int, px; first pixel of the window on the detector
        columns, rows : int; size of the window

        Raises
        ------
        InputError
            The window extends beyond the detector.
        """
        inside = 0 <= x0_px <= self.columns - columns and 0 <= y0_px <= self.rows - rows
        require(
            inside,
            f"the window must lie on the detector of {self.columns} x {self.rows} pixels, got {columns} x {rows} "
            f"pixels from ({x0_px}, {y0_px})",
        )
        return replace(self, columns=columns, rows=rows, model=divisible(self.model).windowed(x0_px, y0_px))

    def binned(self, factor: float, *, detector: Detector) -> Camera:
        """Return the camera of images whose pixels are blocks of ``factor`` by ``factor`` pixels.

        Parameters
        ----------
        factor : float
            Positive: pixels along one side of a block; columns and rows that fill no block are left out. Not a whole
            number for resampled images, and below 1 for enlarged ones.
        detector : Detector; of the binned images: read noise and saturation depend on the electronics
        """
        psf = None if self.psf is None else GaussianPsf(sigma_px=self.psf.sigma_px / factor)
        return replace(
            self,
            columns=math.floor(self.columns / factor + _WHOLE_PX),
            rows=math.floor(self.rows / factor + _WHOLE_PX),
            model=divisible(self.model).binned(factor),
            psf=psf,
            detector=detector,
        )

    def in_field(self, points_camera: ArrayLike, *, margin_px: float = 0.0) -> Mask:
        """Return which points or directions are imaged.

        Parameters
        ----------
        points_camera : (..., 3) array_like, camera axes; points or directions, in any unit of length
        margin_px : float, px; required distance from the edge of the image; negative values accept points outside it

        Returns
        -------
        (...,) bool
        """
        return self.contains(self.model.project(points_camera), margin_px=margin_px)

    def ifov_rad(self, points_px: ArrayLike | None = None) -> Float:
        """Return the geometric-mean angle (...), rad, that one pixel subtends.

        ``points_px`` (..., 2), px: pixels; the image center by default.
        """
        return ifov_rad(self.model, self.center_px if points_px is None else points_px)

    def contains(self, points_px: ArrayLike, *, margin_px: float = 0.0) -> Mask:
        """Return which pixels (..., 2) lie on the detector; NaN does not.

        ``margin_px``, px: required distance from the edge; negative values accept points outside the detector.
        """
        points = as_floats(points_px, (2,), "points_px")
        low, high = margin_px - 0.5, np.array([self.columns, self.rows]) - 0.5 - margin_px
        with np.errstate(invalid="ignore"):
            result: Mask = np.all((points >= low) & (points <= high), axis=-1)
        return result


@lru_cache(maxsize=16)
def _half_diagonal_rad(model: CameraModel, columns: int, rows: int) -> float:
    center_px = np.array([(columns - 1) / 2, (rows - 1) / 2])
    cosines = model.unproject(frame_grid(columns, rows, nodes=_EDGE_NODES)) @ model.unproject(center_px)
    seen = cosines[np.isfinite(cosines)]
    return float(np.arccos(np.clip(seen.min(), -1.0, 1.0))) if seen.size else math.nan


def _require_size(name: str, columns: int, rows: int) -> None:
    for key, value in (("columns", columns), ("rows", rows)):
        require(
            isinstance(value, int) and not isinstance(value, bool) and value > 0,
            f"camera {name!r}: {key} must be a positive whole number, got {value!r}",
        )
