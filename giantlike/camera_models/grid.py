"""A smooth correction on a grid of pixels, for what no lens formula fits."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.camera_models.affine import AffineModel, blockwise, inverse_on_the_sphere
from giantlike.core.arrays import Float, as_finite, as_floats, frozen, require
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value

_MAX_STEEPNESS = 0.5  # px per px: half of what would fold
_MAX_TURNS = 60  # each at least halves the error
_LEFT_PX = 1e-10


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GridCorrectedModel(Value):
    """A camera model whose pixels are moved by a bicubic spline: ``pixel = q + g(q)``, q the pixel of the base.

    The spline is uniform, cubic and twice continuously differentiable. Its control values surround the pixels they
    act on: control ``[j, i]`` sits at ``corner_px + ((i - 1) step_px, (j - 1) step_px)``, and the spline reaches from
    the control ``[1, 1]`` to the last but one; beyond, it keeps the value of its edge. :attr:`parameters` are those of
    the base; the correction is fixed while they are estimated.

    Parameters
    ----------
    base : AffineModel
        Any lens model.
    corner_px : (2,) float64, px
        Where the spline begins.
    step_px : float, px
        Distance of the controls.
    dx_px, dy_px : (rows, columns) float64, px
        Control values, at least 4 by 4.

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
        object.__setattr__(self, "corner_px", frozen(as_finite(self.corner_px, (2,), "corner_px")))
        shape = np.shape(self.dx_px)
        require(len(shape) == 2 and min(shape) >= 4, f"dx_px must be at least 4 by 4 control values, got {shape}")
        for name in ("dx_px", "dy_px"):
            object.__setattr__(self, name, frozen(as_finite(getattr(self, name), shape, name)))
        require(np.isfinite(self.step_px) and self.step_px > 0, f"step_px must be > 0, got {self.step_px}")
        steepness = self._steepness()
        require(
            steepness <= _MAX_STEEPNESS,
            f"the grid correction changes by {steepness:.3g} px per px, at most {_MAX_STEEPNESS} is sure to be "
            "invertible: give the base model more of the distortion",
        )
        Value.__post_init__(self)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters of the base."""
        return self.base.parameter_names

    @property
    def parameters(self) -> Float:
        """Parameter values (k,) of the base."""
        return self.base.parameters

    def with_parameters(self, values: ArrayLike) -> Self:
        """Return the same correction of a base with other parameter values (k,)."""
        return dataclasses.replace(self, base=self.base.with_parameters(values))

    @property
    def focal_length_px(self) -> float:
        """Focal length along x of the base, px."""
        return self.base.focal_length_px

    def project(self, points_camera: ArrayLike) -> Float:
        """Pixels (..., 2) of points (..., 3) in camera axes; NaN where the base images nothing."""
        pixels = self.base.project(points_camera)
        return pixels + self.correction(pixels)

    def unproject(self, points_px: ArrayLike) -> Float:
        """Unit vectors (..., 3) in camera axes of pixels (..., 2); NaN where no direction maps there."""
        return self.base.unproject(blockwise(self._uncorrected, as_floats(points_px, (2,), "points_px"), (2,)))

    def project_jacobian(self, points_camera: ArrayLike) -> Float:
        """Derivative (..., 2, 3) of ``project`` with respect to the point, px per its unit."""
        result: Float = self._slope(self.base.project(points_camera)) @ self.base.project_jacobian(points_camera)
        return result

    def unproject_jacobian(self, points_px: ArrayLike) -> Float:
        """Derivative (..., 3, 2) of ``unproject`` with respect to the pixel, 1/px."""
        return inverse_on_the_sphere(self.project_jacobian(self.unproject(points_px)))

    def parameter_jacobian(self, points_camera: ArrayLike, temperature_c: float = 0.0) -> Float:
        """Derivative (..., 2, k) of the pixels at a temperature with respect to the parameters of the base."""
        pixels = self.base.at_temperature(temperature_c).project(points_camera)
        result: Float = self._slope(pixels) @ self.base.parameter_jacobian(points_camera, temperature_c)
        return result

    def at_temperature(self, temperature_c: float) -> Self:
        """Return the model at a temperature in degrees Celsius: the base scaled, the correction as it is."""
        return dataclasses.replace(self, base=self.base.at_temperature(temperature_c))

    def binned(self, factor: int) -> Self:
        """Return the model of an image whose pixels are ``factor`` by ``factor`` of these, first block first."""
        return dataclasses.replace(
            self,
            base=self.base.binned(factor),
            corner_px=(self.corner_px - (factor - 1) / 2) / factor,
            step_px=self.step_px / factor,
            dx_px=self.dx_px / factor,
            dy_px=self.dy_px / factor,
        )

    def windowed(self, x0_px: float, y0_px: float) -> Self:
        """Return the model of a window whose first pixel is (``x0_px``, ``y0_px``) here."""
        return dataclasses.replace(
            self, base=self.base.windowed(x0_px, y0_px), corner_px=self.corner_px - [x0_px, y0_px]
        )

    def correction(self, base_px: ArrayLike) -> Float:
        """Displacement (..., 2), px, of pixels (..., 2) of the base."""
        return blockwise(self._correction_block, as_floats(base_px, (2,), "base_px"), (2,))

    def _correction_block(self, pixels: Float) -> Float:
        moved = self._spline_sum(*self._weights(pixels))
        return np.stack([moved.real, moved.imag], axis=-1)

    def _spline_sum(
        self, cell: NDArray[np.int64], weights_x: list[Float], weights_y: list[Float]
    ) -> NDArray[np.complex128]:
        """Weighted sum of controls, dx as the real and dy as the imaginary part: each is looked up once."""
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
        """First control of each pixel and its four weights along x and y, their derivative along one axis."""
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
        """(..., 2, 2) derivative of the corrected pixel by that of the base."""

        def block(pixels: Float) -> Float:
            result = np.broadcast_to(np.eye(2), (len(pixels), 2, 2)).copy()
            for axis in (0, 1):
                growth = self._spline_sum(*self._weights(pixels, slope=axis))
                result[:, 0, axis] += growth.real
                result[:, 1, axis] += growth.imag
            return result

        return blockwise(block, base_px, (2, 2))

    def _steepness(self) -> float:
        """Bound on how far the correction of two pixels differs, per distance of the pixels."""
        return max(
            sum(float(np.abs(np.diff(values, axis=axis)).max()) for values in (self.dx_px, self.dy_px)) / self.step_px
            for axis in (0, 1)
        )

    def _uncorrected(self, pixels: Float) -> Float:
        """Pixels of the base: a fixed point, which every turn comes nearer to by the steepness of the correction."""
        base, nearer = pixels, self._steepness()
        for _ in range(_MAX_TURNS):
            before, base = base, pixels - self._correction_block(base)
            if not np.nanmax(np.abs(base - before), initial=0.0) * nearer / (1.0 - nearer) > _LEFT_PX:
                break
        return base


def _spline(f: Float) -> list[Float]:
    """Weights of the four controls around a place in a cell, by the uniform cubic B-spline."""
    g = 1.0 - f
    ff, gg = f * f, g * g
    return [gg * g / 6, 2 / 3 - ff * (1 + g) / 2, 2 / 3 - gg * (1 + f) / 2, ff * f / 6]


def _spline_slope(f: Float) -> list[Float]:
    """Derivative of :func:`_spline` by the place."""
    g = 1.0 - f
    return [-g * g / 2, f * (3 * f - 4) / 2, -g * (3 * g - 4) / 2, f * f / 2]


def fit_grid(
    base: AffineModel,
    points_camera: ArrayLike,
    points_px: ArrayLike,
    *,
    columns: int,
    rows: int,
    step_px: float,
    smoothing: float = 1e-3,
) -> GridCorrectedModel | Failure:
    """Fit the correction that takes what a base model predicts to what was measured (linear least squares).

    Parameters
    ----------
    base : AffineModel
    points_camera : (n, 3) float64, camera axes
        Known points or directions.
    points_px : (n, 2) float64, px
        Where they were measured.
    columns, rows : int
        Frame that the grid covers.
    step_px : float, px
        Distance of the controls: not less than that of neighboring measurements, all images together.
    smoothing : float
        Weight of the squared second differences of the controls against the squared residuals; it also carries the
        correction smoothly over cells without measurements.

    Returns
    -------
    GridCorrectedModel or Failure
        ``TOO_FEW_MATCHES`` with fewer than three measurements that the base can image.

    Raises
    ------
    InputError
        ``smoothing`` is not positive, or the fitted correction is too steep to be inverted.
    """
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    require(smoothing > 0, f"smoothing must be > 0, got {smoothing}")
    measured = as_floats(points_px, (2,), "points_px")
    predicted = base.project(points_camera)
    seen = np.isfinite(predicted).all(axis=-1) & np.isfinite(measured).all(axis=-1)
    if np.count_nonzero(seen) < 3:
        return Failure(Reason.TOO_FEW_MATCHES, f"a grid needs 3 measurements, the base images {np.count_nonzero(seen)}")
    shape = (int(np.ceil(rows / step_px)) + 3, int(np.ceil(columns / step_px)) + 3)
    empty = GridCorrectedModel(
        base=base, corner_px=np.array([-0.5, -0.5]), step_px=step_px, dx_px=np.zeros(shape), dy_px=np.zeros(shape)
    )
    cell, weights_x, weights_y = empty._weights(predicted[seen])
    at = [cell + j * shape[1] + i for j in range(4) for i in range(4)]
    values = [across * along for across in weights_y for along in weights_x]
    lines = np.tile(np.arange(len(cell)), 16)
    design = sparse.csr_array((np.concatenate(values), (lines, np.concatenate(at))), shape=(len(cell), np.prod(shape)))
    normal = sparse.csc_array(design.T @ design + smoothing * _roughness(shape))
    fitted = np.asarray(spsolve(normal, design.T @ (measured - predicted)[seen]))
    return dataclasses.replace(empty, dx_px=fitted[:, 0].reshape(shape), dy_px=fitted[:, 1].reshape(shape))


def _roughness(shape: tuple[int, int]) -> Any:
    """Sparse matrix of the sum of squared second differences of controls, along both axes."""
    from scipy import sparse

    bends = [sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(n - 2, n)) for n in shape]
    along = [sparse.kron(bends[0], sparse.eye_array(shape[1])), sparse.kron(sparse.eye_array(shape[0]), bends[1])]
    rough = sparse.vstack(along)
    return rough.T @ rough
