"""Windows and blocks of the pixels of any camera model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self, runtime_checkable

from numpy.typing import ArrayLike

from giantlike.camera_models.base import CameraModel
from giantlike.core.arrays import Float, as_floats, require_number
from giantlike.core.documented import documented_by


@runtime_checkable
class DivisibleModel(CameraModel, Protocol):
    """A camera model that returns the models of its windows and blocks itself, as all lenses of this package do."""

    def binned(self, factor: float) -> Self:
        """Return the model of an image whose pixels are blocks of ``factor`` by ``factor`` pixels."""
        ...

    def windowed(self, x0_px: float, y0_px: float) -> Self:
        """Return the model of a window of the image, by its first pixel."""
        ...


@documented_by(CameraModel, DivisibleModel)
@dataclass(frozen=True, slots=True, kw_only=True)
class PartModel:
    """Any camera model, for the pixels of a window whose pixels may be blocks of pixels of the model.

    ``pixel = (base pixel - (x0_px, y0_px)) / size_px``: directions go through the model, pixels through this map.
    :attr:`parameters` belong to the model.
    """

    type_name: ClassVar[str] = "part"

    base: CameraModel  # of the whole image
    x0_px: float = 0.0  # x0_px, y0_px: pixel of the model at the center of the first pixel
    y0_px: float = 0.0
    size_px: float = 1.0  # pixels of the model along one side of a pixel

    def __post_init__(self) -> None:
        require_number(self.size_px, "size_px", above=0.0)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters of the model."""
        return self.base.parameter_names

    @property
    def parameters(self) -> Float:
        """Parameter values (k,) of the model."""
        return self.base.parameters

    def with_parameters(self, values: ArrayLike) -> Self:
        return replace(self, base=self.base.with_parameters(values))

    @property
    def focal_length_px(self) -> float:
        """Focal length along x, px."""
        return self.base.focal_length_px / self.size_px

    def project(self, points_camera: ArrayLike) -> Float:
        return (self.base.project(points_camera) - [self.x0_px, self.y0_px]) / self.size_px

    def unproject(self, points_px: ArrayLike) -> Float:
        return self.base.unproject(self._base_px(points_px))

    def project_jacobian(self, points_camera: ArrayLike) -> Float:
        return self.base.project_jacobian(points_camera) / self.size_px

    def unproject_jacobian(self, points_px: ArrayLike) -> Float:
        return self.size_px * self.base.unproject_jacobian(self._base_px(points_px))

    def parameter_jacobian(self, points_camera: ArrayLike, temperature_c: float = 0.0) -> Float:
        return self.base.parameter_jacobian(points_camera, temperature_c) / self.size_px

    def at_temperature(self, temperature_c: float) -> Self:
        """Return the same part of the model at a temperature."""
        return replace(self, base=self.base.at_temperature(temperature_c))

    def binned(self, factor: float) -> Self:
        """Return the model of an image whose pixels are blocks of ``factor`` by ``factor`` pixels of this one."""
        require_number(factor, "a binning factor", above=0.0)
        middle_px = 0.5 * (factor - 1) * self.size_px  # of the first block
        return replace(self, x0_px=self.x0_px + middle_px, y0_px=self.y0_px + middle_px, size_px=factor * self.size_px)

    def windowed(self, x0_px: float, y0_px: float) -> Self:
        return replace(self, x0_px=self.x0_px + self.size_px * x0_px, y0_px=self.y0_px + self.size_px * y0_px)

    def _base_px(self, points_px: ArrayLike) -> Float:
        """Pixels (..., 2) of the model."""
        return self.size_px * as_floats(points_px, (2,), "points_px") + [self.x0_px, self.y0_px]


def divisible(model: CameraModel) -> DivisibleModel:
    """Return a model with ``binned`` and ``windowed``: itself where it has them, else the part that is all of it."""
    return model if isinstance(model, DivisibleModel) else PartModel(base=model)
