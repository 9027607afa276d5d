"""An illuminated limb measured in an image: its points with their errors, and the checks common to all methods."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, unit
from giantlike.core.causes import Cause, add_parts
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.processing.correlated_fit import solution_gain
from giantlike.processing.limb.view import LimbView

MIN_BRIGHTNESS = 0.1
"""Minimum brightness of used limb relative to the brightest; darker limb adds hardly any information."""
GAIN_RANGE = (0.2, 5.0)
"""Limits of brightness / expected brightness of good points, in medians of all; others lie on something else."""
UNSEEN = "masked, saturated or outside the frame"  # reason of points without usable pixels
SATURATED_SHARE = 0.2
"""Share of saturated pixels near a limb above which saturation is named as the reason for its failure; no study yet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothError:
    """An error that changes slowly along the limb, of covariance ``sigma_px^2 exp(-distance / length_px)``."""

    cause: Cause
    sigma_px: float  # standard deviation across the limb
    length_px: float  # correlation length
    # unit vector in the image. Distances count along it only: the error is the same where light falls alike, on both
    # sides of the direction of the Sun
    along: tuple[float, float] | None = None

    def covariance_px2(self, points_px: Float) -> Float:
        """Covariance of the error between points of a limb. ``points_px`` (n, 2); returns (n, n)."""
        places = points_px if self.along is None else points_px @ np.array(self.along)[:, None]
        square = sum((place[:, None] - place) ** 2 for place in places.T)  # half the time of norms of rows of two
        result: Float = self.sigma_px**2 * np.exp(np.sqrt(square) / -self.length_px)
        return result


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TerrainShift(Value):
    """Relief of a height map that was taken off the points of a limb."""

    shift_px: Float  # (n,); outward shift of the limb with relief from the smooth one
    log_odds: float  # logarithm of the Bayes factor of a smooth limb against the map
    misfit: float  # RMS of residuals averaged over parts of the limb, normalized by noise and the errors of the map
    name: str  # name, sha256: of the map
    sha256: str
    mean_km: float  # mean altitude of the points


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbMeasurement(Value):
    """Lit limb of a body, measured in an image across a prediction."""

    predicted_px: Float  # (n, 2); points of the limb of the body at ``position_camera_km``
    normals_px: Float  # (n, 2); outward unit normals of the outline in the image
    design: Float  # (n, 3) px/km; outward motion of the points with the position of the body, camera axes
    shift_px: Float  # (n,); distance from the predicted limb outward to the one in the image
    sigma_px: Float  # (n,); standard deviation of ``shift_px`` from pixel noise
    keep: Mask  # (n,); points consistent with one position
    common_px: Mapping[Cause, Float]  # Cause to (n, c); shift by one sigma of c errors common to all: blur, law
    smooth_errors: tuple[SmoothError, ...]  # errors in neither of these
    position_camera_km: Float  # position of the body for the prediction
    spacing_px: float  # spacing_px, perimeter_px: length of limb for each point; length of the whole outline
    perimeter_px: float
    cut_by_frame: bool  # part of the outline lies outside the frame
    rejected: Mapping[str, int]  # points of the illuminated limb that are not among the n, by reason
    area: Mask  # (rows, columns); pixels within reach of the limb
    relief: SmoothError | None = None  # deviation of the outline from the outline of the assumed body
    n_elsewhere: int = 0  # edges that are no points of the limb, and points without usable pixels
    terrain: TerrainShift | None = None  # relief by a height map; ``shift_px`` is without it
    unmeasured_px: Float = field(default_factory=lambda: np.zeros((0, 2)))  # (k, 2); predicted, of ``rejected``
    rotation_design: Float | None = None  # (n, 3) px/rad; outward motion by a small rotation of the body, if known
    wider_px2: float | None = None  # excess variance of the blur of the limb over the camera's, if measured

    @property
    def observed_px(self) -> Float:
        """Limb points (n, 2), px, as the smooth body has them: in the image but for the relief of a height map."""
        return self.predicted_px + self.shift_px[:, None] * self.normals_px

    @property
    def seen_px(self) -> Float:
        """Limb points (n, 2) in the image, px."""
        raised_px = 0.0 if self.terrain is None else self.terrain.shift_px[:, None]
        return self.observed_px + raised_px * self.normals_px

    @property
    def rejected_px(self) -> Float:
        """Points (k, 2) of the illuminated limb that are not used, px: as measured, else as predicted."""
        return np.concatenate([self.seen_px[~self.keep], self.unmeasured_px])

    @property
    def relief_px(self) -> float:
        """Root mean square of the relief, px."""
        return 0.0 if self.relief is None else self.relief.sigma_px

    @property
    def n_used(self) -> int:
        """Number of points used."""
        return int(self.keep.sum())

    @property
    def n_offered(self) -> int:
        """Number of points on illuminated limb in the frame."""
        return self.keep.size + sum(self.rejected.values())

    @property
    def outline_share(self) -> float:
        """Length of limb used / length of the whole outline, at most 1."""
        return min(self.n_used * self.spacing_px / self.perimeter_px, 1.0)

    def select(self, which: NDArray[np.integer]) -> LimbMeasurement:
        """Measurement with some of its points. ``which`` (k,), indices of the points, in the order wanted."""
        return replace(
            self,
            predicted_px=self.predicted_px[which],
            normals_px=self.normals_px[which],
            design=self.design[which],
            shift_px=self.shift_px[which],
            sigma_px=self.sigma_px[which],
            keep=self.keep[which],
            common_px={cause: shared_px[which] for cause, shared_px in self.common_px.items()},
            terrain=None if self.terrain is None else replace(self.terrain, shift_px=self.terrain.shift_px[which]),
            rotation_design=None if self.rotation_design is None else self.rotation_design[which],
        )

    def smooth_covariances(self, gain: Float) -> dict[Cause, Float]:
        """Covariances (k, k) by cause, of a solution of gain (k, m), from the common and the smooth errors."""
        parts: dict[Cause, Float] = {}
        for cause, common_px in self.common_px.items():
            moved = gain @ common_px[self.keep]
            parts[cause] = moved @ moved.T
        return add_parts(parts, smooth_parts(self.smooth_errors, self.predicted_px[self.keep], gain))

    @property
    def even_gain(self) -> Float:
        """Matrix (3, m), km/px, that takes the shifts of the points that are kept to a position, all weighted alike."""
        design = self.design[self.keep]
        return solution_gain(design, np.zeros((0, 0)), weights=np.ones(len(design)))

    @property
    def common_sigma_px(self) -> float:
        """Standard deviation, root mean square over the limb, of the common shift of the points, px."""
        return math.sqrt(sum(float(np.mean(np.sum(px[self.keep] ** 2, axis=1))) for px in self.common_px.values()))

    def motion_sigma_px(self, step_km: Float) -> float:
        """Standard deviation of the limb where it is least certain, by the scatter about a step in camera axes."""
        design = self.design[self.keep]
        left = self.shift_px[self.keep] - design @ step_km
        leverage = np.linalg.qr(design)[0]
        return float(np.std(left) * np.max(np.linalg.norm(leverage, axis=1)))


def smooth_parts(errors: Iterable[SmoothError], points_px: Float, gain: Float) -> dict[Cause, Float]:
    """Covariances (k, k) by cause, of a solution of gain (k, n), by smooth errors of its points (n, 2)."""
    parts: dict[Cause, Float] = {}
    for error in errors:
        part = gain @ error.covariance_px2(points_px) @ gain.T
        parts = add_parts(parts, {error.cause: (part + part.T) / 2.0})
    return parts


def judge_points(
    *,
    complete: Mask,
    strong: Mask,
    alike: Mask,
    gain_dn: Float,
    even: bool = True,
    also: Mapping[str, Mask] | None = None,
) -> tuple[Mask, dict[str, int]]:
    """Decide which points (n,) of a limb were measured well; count the others by the first reason that applies."""
    gain_ok = gain_dn > 0.0
    typical = complete & alike & gain_ok
    if even and typical.any():
        low, high = np.array(GAIN_RANGE) * float(np.median(gain_dn[typical]))
        gain_ok = (gain_dn > low) & (gain_dn < high)
    checks = {
        UNSEEN: complete,
        "too weak": strong,
        "not like the expected profile": alike,
        "too bright or too dark": gain_ok,
        **(also or {}),
    }
    good = np.ones(complete.shape, dtype=bool)
    rejected = {}
    for name, passed in checks.items():
        rejected[name] = int((good & ~passed).sum())
        good &= passed
    return good, rejected


def too_few(view: LimbView, area: Mask, good: Mask, rejected: Mapping[str, int], *, needed: int) -> Failure:
    """Return the failure of a limb with too few good points (n,); ``rejected`` as of :func:`judge_points`."""
    saturated = float(view.saturated[area].mean()) if area.any() else 0.0
    reasons = ", ".join(f"{count} {name}" for name, count in rejected.items() if count)
    return Failure(
        Reason.SATURATED if saturated > SATURATED_SHARE else Reason.NO_LIMB,
        f"{int(good.sum())} of {good.size} points measured along the lit limb in the frame are good, needed {needed}"
        + (f"; {reasons}" if reasons else ""),
        not_applicable=good.size < needed,
    )


def no_lit_limb(view: LimbView, outline_px: Float, inside: Mask, position_camera_km: Float) -> Failure:
    """Return the failure of a predicted outline (k, 2), NaN where not imaged, without a lit part in the frame."""
    rows, columns = view.usable.shape
    if inside.any() and not inside.all():
        return Failure(
            Reason.OUT_OF_FRAME,
            f"{inside.mean():.0%} of the predicted outline can lie in the frame, all dark: the lit limb is outside",
        )
    if inside.any():
        cosine = -float(unit(position_camera_km) @ view.sun_direction_camera)
        return Failure(
            Reason.NOT_LIT,
            f"{inside.mean():.0%} of the predicted outline lies in the frame, but the body is dark there (phase angle "
            f"{math.degrees(math.acos(min(max(cosine, -1.0), 1.0))):.0f} deg)",
        )
    known = outline_px[np.isfinite(outline_px).all(axis=1)]
    size = np.ptp(known, axis=0) if len(known) else np.full(2, np.nan)
    corners = np.array([[0, 0], [columns - 1, 0], [0, rows - 1], [columns - 1, rows - 1]])
    where = "the surface fills the frame" if _encloses(known, corners) else "the outline passes beside the frame"
    return Failure(
        Reason.NO_LIMB,
        f"none of the predicted outline ({size[0]:.0f} x {size[1]:.0f} px) lies in the frame of {columns} x {rows}: "
        f"{where}",
    )


def pixels_near(points_px: Float, normals_px: Float, offsets_px: Float, shape: tuple[int, ...]) -> Mask:
    """Mask (rows, columns) of the pixels on lines, at offsets (m,), across a limb of points and normals (n, 2)."""
    area = np.zeros(shape, dtype=bool)
    columns, rows = (np.rint(points_px[:, axis, None] + offsets_px * normals_px[:, axis, None]) for axis in range(2))
    inside = (columns >= 0) & (columns < shape[1]) & (rows >= 0) & (rows < shape[0])  # False where not finite
    area[rows[inside].astype(np.intp), columns[inside].astype(np.intp)] = True
    return area


def limb_design(normals_px: Float, projection_jacobian: Float) -> Float:
    """Outward motion (n, 3), px/km, of limb points in the image with the position of the body.

    A limb point that slides along the surface as the view changes slides along the limb too: to first order only its
    own motion, by ``projection_jacobian`` (n, 2, 3), counts.
    """
    design: Float = np.einsum("ni,nij->nj", normals_px, projection_jacobian)
    return design


def _encloses(polygon_px: Float, points_px: NDArray[np.int64]) -> bool:
    """True if the polygon (k, 2) winds around every one of the points (n, 2)."""
    if len(polygon_px) < 3:
        return False
    arms = polygon_px[None] - points_px[:, None]
    angles = np.arctan2(arms[..., 1], arms[..., 0])
    turns = np.diff(np.unwrap(np.concatenate([angles, angles[:, :1]], axis=1), axis=1), axis=1).sum(axis=1)
    return bool(np.all(np.abs(turns) > np.pi))
