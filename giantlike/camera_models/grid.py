"""Lens model with a smooth correction on a grid of pixels, for distortion that no formula fits."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.camera_models.affine import AffineModel, blockwise, inverse_on_the_sphere
from giantlike.camera_models.base import CameraModel
from giantlike.core.arrays import Float, as_finite, as_floats, require, require_number
from giantlike.core.documented import documented_by
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value

_MAX_STEEPNESS = 0.5  # px per px: half of the steepness that would fold; the inversion then gains a bit per iteration
_MAX_ITERATIONS = 60  # each at least halves the error, so a correction of 1e8 px would still converge to 1e-10 px
_INVERSION_ERROR_PX = 1e-10  # px, at which the inversion stops: far below the 1e-3 px of the best centroids


@documented_by(CameraModel, AffineModel)
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GridCorrectedModel(Value):
    """A camera model whose pixels are moved by a bicubic spline: ``pixel = q + g(q)``, q the pixel of the base.

    The spline is uniform, cubic and twice continuously differentiable. Its control values surround the pixels they
    act on: control ``[j, i]`` sits at ``corner_px + ((i - 1) step_px, (j - 1) step_px)``, and the spline reaches from
    the control ``[1, 1]`` to the last but one; beyond, it keeps the value of its edge. :attr:`parameters` belong to
    the base; the correction is fixed while they are estimated.

    Parameters
    ----------
    base : AffineModel; any lens model
    corner_px : (2,) float64, px; corner of the frame that the spline covers
    step_px : float, px; spacing of the control values
    dx_px, dy_px : (rows, columns) float64, px; control values of the displacement, at least 4 by 4

    Raises
    ------
    InputError
        Shapes disagree, or the correction is so steep (0.5 px per px) that it might fold.
    """

    type_name: ClassVar[str] = "grid"

    base: AffineModel
    corner_px: Float
    step_px: float
    dx_px: Float
    dy_px: Float

    def __post_init__(self) -> None:
        object.__setattr__(self, "corner_px", as_finite(self.corner_px, (2,), "corner_px"))
        shape = np.shape(self.dx_px)
        require(len(shape) == 2 and min(shape) >= 4, f"dx_px must be at least 4 by 4 control values, got {shape}")
        for name in ("dx_px", "dy_px"):
            object.__setattr__(self, name, as_finite(getattr(self, name), shape, name))
        require_number(self.step_px, "step_px", above=0.0)
        steepness = self._steepness()
        require(
            steepness <= _MAX_STEEPNESS,
            f"the grid correction changes by {steepness:.3g} px per px, but only {_MAX_STEEPNESS} is sure to be "
            "invertible: fit more of the distortion with the base model",
        )
        Value.__post_init__(self)

    @classmethod
    def flat(cls, base: AffineModel, columns: int, rows: int, *, step_px: float) -> Self:
        """Return a model without correction, whose grid covers a frame of ``columns`` by ``rows`` pixels.

        ``step_px``, px: spacing of the control values; for a fit, not less than the spacing of neighboring
        measurements, all images together.
        """
        zero = np.zeros((int(np.ceil(rows / step_px)) + 3, int(np.ceil(columns / step_px)) + 3))
        return cls(base=base, corner_px=np.array([-0.5, -0.5]), step_px=step_px, dx_px=zero, dy_px=zero)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters of the base model."""
        return self.base.parameter_names

    @property
    def parameters(self) -> Float:
        """Parameter values (k,) of the base model."""
        return self.base.parameters

    def with_parameters(self, values: ArrayLike) -> Self:
        return dataclasses.replace(self, base=self.base.with_parameters(values))

    @property
    def focal_length_px(self) -> float:
        """Focal length along x of the base model, px."""
        return self.base.focal_length_px

    def project(self, points_camera: ArrayLike) -> Float:
        pixels = self.base.project(points_camera)
        return pixels + self.correction(pixels)

    def unproject(self, points_px: ArrayLike) -> Float:
        return self.base.unproject(blockwise(self._undo_correction, as_floats(points_px, (2,), "points_px"), (2,)))

    def project_jacobian(self, points_camera: ArrayLike) -> Float:
        return self._slope(self.base.project(points_camera)) @ self.base.project_jacobian(points_camera)

    def unproject_jacobian(self, points_px: ArrayLike) -> Float:
        return inverse_on_the_sphere(self.project_jacobian(self.unproject(points_px)))

    def parameter_jacobian(self, points_camera: ArrayLike, temperature_c: float = 0.0) -> Float:
        pixels = self.base.at_temperature(temperature_c).project(points_camera)
        return self._slope(pixels) @ self.base.parameter_jacobian(points_camera, temperature_c)

    def at_temperature(self, temperature_c: float) -> Self:
        """Return the model at a temperature (Celsius): the base model scaled, the correction unchanged."""
        return dataclasses.replace(self, base=self.base.at_temperature(temperature_c))

    def binned(self, factor: float) -> Self:
        return dataclasses.replace(
            self,
            base=self.base.binned(factor),
            corner_px=(self.corner_px - (factor - 1) / 2) / factor,
            step_px=self.step_px / factor,
            dx_px=self.dx_px / factor,
            dy_px=self.dy_px / factor,
        )

    def windowed(self, x0_px: float, y0_px: float) -> Self:
        return dataclasses.replace(
            self, base=self.base.windowed(x0_px, y0_px), corner_px=self.corner_px - [x0_px, y0_px]
        )

    def correction(self, base_px: ArrayLike) -> Float:
        """Displacement (..., 2), px, by the spline at pixels (..., 2) of the base model."""
        return blockwise(self._correction_block, as_floats(base_px, (2,), "base_px"), (2,))

    def _correction_block(self, pixels: Float) -> Float:
        moved = self._spline_sum(*self._weights(pixels))
        return np.stack([moved.real, moved.imag], axis=-1)

    def _spline_sum(
        self, cell: NDArray[np.int64], weights_x: list[Float], weights_y: list[Float]
    ) -> NDArray[np.complex128]:
        """Weighted sum of the control values, dx as real and dy as imaginary part, so that each is looked up once."""
        controls = (self.dx_px + 1j * self.dy_px).ravel()
        result = np.zeros(len(cell), dtype=np.complex128)
        for j, across in enumerate(weights_y):
            row = cell + j * self.dx_px.shape[1]
            along = weights_x[0] * controls.take(row)
            for i in (1, 2, 3):
                along += weights_x[i] * controls.take(row + i)
            along *= across
            result += along
        return result

    def _weights(self, pixels: Float, slope: int | None = None) -> tuple[NDArray[np.int64], list[Float], list[Float]]:
        """First control of each pixel, and its four weights along x and y, or their derivative along one axis."""
        rows, columns = self.dx_px.shape
        cells, weights = [], []
        for axis, count in enumerate((columns, rows)):
            place = (pixels[:, axis] - self.corner_px[axis]) / self.step_px
            inside = np.minimum(np.maximum(place, 0.0), count - 3.0)
            cell = np.fmin(np.floor(inside), count - 4.0)  # of NaN the last: its fraction stays NaN
            fraction = inside - cell
            cells.append(cell.astype(np.int64))
            if axis == slope:
                beyond = (place < 0) | (place > count - 3.0)
                weights.append([np.where(beyond, 0.0, w) / self.step_px for w in _spline_slope(fraction)])
            else:
                weights.append(_spline(fraction))
        return cells[0] + columns * cells[1], weights[0], weights[1]

    def _slope(self, base_px: Float) -> Float:
        """Derivative (..., 2, 2) of the corrected pixel by the pixel of the base model."""

        def block(pixels: Float) -> Float:
            result = np.broadcast_to(np.eye(2), (len(pixels), 2, 2)).copy()
            for axis in (0, 1):
                growth = self._spline_sum(*self._weights(pixels, slope=axis))
                result[:, 0, axis] += growth.real
                result[:, 1, axis] += growth.imag
            return result

        return blockwise(block, base_px, (2, 2))

    def _steepness(self) -> float:
        """Lipschitz bound of the correction, px per px."""
        return max(
            sum(float(np.abs(np.diff(values, axis=axis)).max()) for values in (self.dx_px, self.dy_px)) / self.step_px
            for axis in (0, 1)
        )

    def _undo_correction(self, pixels: Float) -> Float:
        """Pixels of the base model by fixed-point iteration, whose error shrinks by the steepness of the correction."""
        base, nearer = pixels, self._steepness()
        for _ in range(_MAX_ITERATIONS):
            before, base = base, pixels - self._correction_block(base)
            if not np.nanmax(np.abs(base - before), initial=0.0) * nearer / (1.0 - nearer) > _INVERSION_ERROR_PX:
                break
        return base


def _spline(f: Float) -> list[Float]:
    """Weights of the four control values around a point in a cell: the uniform cubic B-spline."""
    g = 1.0 - f
    ff, gg = f * f, g * g
    return [gg * g / 6, 2 / 3 - ff * (1 + g) / 2, 2 / 3 - gg * (1 + f) / 2, ff * f / 6]


def _spline_slope(f: Float) -> list[Float]:
    """Derivative of :func:`_spline` by the point."""
    g = 1.0 - f
    return [-g * g / 2, f * (3 * f - 4) / 2, -g * (3 * g - 4) / 2, f * f / 2]


def fit_grid(
    start: GridCorrectedModel, points_camera: ArrayLike, points_px: ArrayLike, *, smoothing: float = 1e-3
) -> GridCorrectedModel | Failure:
    """Fit the correction that takes the pixels of the base model to measured ones (linear least squares)."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    require_number(smoothing, "smoothing", above=0.0)
    measured = as_floats(points_px, (2,), "points_px")
    predicted = start.base.project(points_camera)
    seen = np.isfinite(predicted).all(axis=-1) & np.isfinite(measured).all(axis=-1)
    if np.count_nonzero(seen) < 3:
        detail = f"a grid needs 3 measurements, the base model images {np.count_nonzero(seen)}"
        return Failure(Reason.TOO_FEW_MATCHES, detail)
    shape = start.dx_px.shape
    cell, weights_x, weights_y = start._weights(predicted[seen])
    at = [cell + j * shape[1] + i for j in range(4) for i in range(4)]
    values = [across * along for across in weights_y for along in weights_x]
    lines = np.tile(np.arange(len(cell)), 16)
    design = sparse.csr_array((np.concatenate(values), (lines, np.concatenate(at))), shape=(len(cell), np.prod(shape)))
    normal = sparse.csc_array(design.T @ design + smoothing * _roughness(shape))
    fitted = np.asarray(spsolve(normal, design.T @ (measured - predicted)[seen]))
    return dataclasses.replace(start, dx_px=fitted[:, 0].reshape(shape), dy_px=fitted[:, 1].reshape(shape))


def _roughness(shape: tuple[int, int]) -> Any:
    """Sparse matrix of the sum of squared second differences of controls, along both axes."""
    from scipy import sparse

    bends = [sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(n - 2, n)) for n in shape]
    along = [sparse.kron(bends[0], sparse.eye_array(shape[1])), sparse.kron(sparse.eye_array(shape[0]), bends[1])]
    rough = sparse.vstack(along)
    return rough.T @ rough
