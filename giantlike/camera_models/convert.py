"""Conversion of a lens model to another type, with the residuals of the fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from giantlike.camera_models.affine import AFFINE_NAMES, TEMPERATURE_NAMES, AffineModel
from giantlike.camera_models.base import CameraModel
from giantlike.camera_models.plane import PlaneModel
from giantlike.camera_models.registry import MODELS, lens_class
from giantlike.core.arrays import Float, require
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value

_MAX_STEPS = 100  # of Levenberg-Marquardt; refused steps, which raise the damping tenfold, are counted too
_LEAST_GAIN = 1e-9  # relative decrease of the sum of squares at which the fit stops
_EXACT_PX = 1e-9  # px rms at which the fit stops: the rounding of pixel coordinates of a few thousand is 1e-12
_NODES = 41  # nodes along the longer side of the frame
_WIDEST_PLANE = 20.0  # image-plane radius, 87 degrees from the axis, beyond which no gnomonic model is fitted
WIDE_START: Mapping[str, Mapping[str, float]] = {"scaramuzza": {"b2": -1 / 3, "b4": -1 / 45}}
"""Start of the fit of a lens with a wide field: the first terms of m / tan m, the equidistant projection."""
_SAME_LETTERS = frozenset({"pinhole", "brown", "opencv"})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Conversion(Value):
    """A camera model of another type, with its residuals against the original."""

    model: AffineModel  # the fitted model; temperature terms as in the original
    points_px: Float  # (rows, columns, 2); grid of pixels at which the two are compared
    residuals_px: Float  # (rows, columns, 2); fitted minus original pixel of a direction; NaN without one

    @property
    def max_px(self) -> float:
        """Largest length of a residual, px."""
        return float(np.nanmax(np.linalg.norm(self.residuals_px, axis=-1)))

    @property
    def rms_px(self) -> float:
        """Root of the mean squared length of the residuals, px."""
        return float(np.sqrt(np.nanmean(np.sum(self.residuals_px**2, axis=-1))))

    @property
    def coverage(self) -> float:
        """Fraction of the grid that both models image."""
        return float(np.mean(np.isfinite(self.residuals_px).all(axis=-1)))


def convert(model: CameraModel, type_name: str, *, columns: int, rows: int) -> Conversion | Failure:
    """Fit a model of another type to a model, over a frame."""
    kind = lens_class(type_name)
    require(columns > 0 and rows > 0, f"the frame must have pixels, got {columns} by {rows}")
    points_px = frame_grid(columns, rows, nodes=_NODES)
    directions = model.unproject(points_px)
    start = _start(model, type_name)
    used = np.isfinite(start.project(directions)).all(axis=-1)
    if issubclass(kind, PlaneModel):
        across = np.hypot(directions[..., 0], directions[..., 1])
        used &= across < _WIDEST_PLANE * directions[..., 2]
    if np.count_nonzero(used) < len(start.parameter_names):
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"a {type_name} model can image {np.count_nonzero(used)} of {used.size} grid points of the frame, "
            f"{len(start.parameter_names)} are needed",
        )
    fitted = fit_lens(start, directions[used], points_px[used])
    return Conversion(model=fitted, points_px=points_px, residuals_px=fitted.project(directions) - points_px)


def frame_grid(columns: int, rows: int, *, nodes: int) -> Float:
    """Return a regular grid of pixels over a frame, its outer edges included. Returns (m, n, 2) px."""
    step = max(columns, rows) / (nodes - 1)
    x = np.linspace(-0.5, columns - 0.5, max(2, round(columns / step) + 1))
    y = np.linspace(-0.5, rows - 0.5, max(2, round(rows / step) + 1))
    return np.stack(np.meshgrid(x, y), axis=-1)


def _start(model: CameraModel, type_name: str) -> AffineModel:
    """Start of the fit: affine and temperature terms of the original, and its distortion where the names agree."""
    known = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    kind = MODELS[type_name]
    alike = type_name == model.type_name or {type_name, model.type_name} <= _SAME_LETTERS
    shared = kind.parameter_names if alike else AFFINE_NAMES + TEMPERATURE_NAMES
    lens = {} if alike else WIDE_START.get(type_name, {})
    return kind(**lens, **{name: known[name] for name in shared if name in known})


def fit_lens(model: AffineModel, directions: Float, points_px: Float) -> AffineModel:
    """Fit all parameters but temperature so that directions (n, 3) fall on pixels (n, 2), with equal weights."""
    free = np.array([name not in TEMPERATURE_NAMES for name in model.parameter_names])
    residuals = points_px - model.project(directions)
    cost, damping, exact = float(np.sum(residuals**2)), 1e-3, _EXACT_PX**2 * len(residuals)
    for _ in range(_MAX_STEPS):
        if cost <= exact:
            break
        design = model.parameter_jacobian(directions)[..., free].reshape(residuals.size, -1)
        scale = np.linalg.norm(design, axis=0)
        scaled = np.vstack([design / scale, np.sqrt(damping) * np.eye(len(scale))])
        step = np.linalg.lstsq(scaled, np.append(residuals.ravel(), np.zeros(len(scale))), rcond=None)[0] / scale
        values = model.parameters
        values[free] += step
        if (values[:2] <= 0).any():
            damping = 10 * damping
            continue
        candidate = model.with_parameters(values)
        after = points_px - candidate.project(directions)
        new_cost = float(np.sum(after**2))
        if not new_cost < cost:  # NaN too
            damping = 10 * damping
            if damping > 1e12:
                break
            continue
        gain, model, residuals, damping = cost - new_cost, candidate, after, damping / 10
        cost = new_cost
        if gain <= _LEAST_GAIN * cost:
            break
    return model
