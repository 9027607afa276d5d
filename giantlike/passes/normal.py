"""Normal equations of a pass: images compressed to the errors that each can show, those new in an image taken out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.statistics import robust_sigma
from giantlike.core.values import Value
from giantlike.passes.images import DISPLACEMENT, ROTATION, MeasuredPosition, NavigationPass, PassImage
from giantlike.passes.layout import PassLayout


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageSums(Value):
    """Normal equations of one image for its 8 + c errors, and its q random errors."""

    information: Float  # (8 + c, 8 + c)
    pull: Float  # (8 + c,)
    squares: float  # squared residuals, sigmas
    count: int  # residuals used
    random: Float  # (8 + c, q); errors of the image by one standard deviation of each random error

    @property
    def inner(self) -> Float:
        """Information (q, q) of measurement and a priori on the errors that are new."""
        return np.eye(self.random.shape[1]) + self.random.T @ self.information @ self.random

    @property
    def new_errors(self) -> Float:
        """Likeliest values (q,) of these, in their standard deviations, with all else as it is."""
        return np.asarray(np.linalg.solve(self.inner, self.random.T @ self.pull), dtype=np.float64)

    def without_new(self) -> tuple[Float, Float, float, float]:
        """Information, pull, squares, relative log determinant of the covariance; the new errors integrated out."""
        seen = self.information @ self.random
        gain = np.linalg.solve(self.inner, np.column_stack([seen.T, self.random.T @ self.pull]))
        information: Float = self.information - seen @ gain[:, :-1]
        pull: Float = self.pull - seen @ gain[:, -1]
        squares = self.squares - float(self.pull @ self.random @ gain[:, -1])
        return information, pull, squares, float(np.linalg.slogdet(self.inner)[1])

    @property
    def own_scatter(self) -> tuple[float, int]:
        """Squared residuals that no error of the image explains, and how many degrees of freedom they have."""
        lengths: Float = np.sqrt(np.diagonal(self.information))
        scale: Float = np.where(lengths > 0.0, lengths, 1.0)
        values, vectors = np.linalg.eigh(self.information / np.outer(scale, scale))
        told = values > 1e-10 * values[-1]  # rounding of the sums
        along = vectors[:, told].T @ (self.pull / scale)
        return self.squares - float(np.sum(along**2 / values[told])), self.count - int(told.sum())

    def rescale(self, variance: float, random: Float) -> ImageSums:
        """The same with noise of another variance and other new errors."""
        return ImageSums(
            information=self.information / variance,
            pull=self.pull / variance,
            squares=self.squares / variance,
            count=self.count,
            random=random,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Normal(Value):
    """Normal equations of a pass in its k parameters."""

    information: Float  # (k, k)
    pull: Float  # (k,)
    squares: float
    log_determinant: float
    count: int


def new_in_image(image: PassImage, size: int, jitter_s: float, pointing_rad: float) -> Float:
    """Errors (size, q) of an image by one standard deviation of each that is new in it: tag first, then attitude."""
    columns = []
    if jitter_s > 0.0:
        late = np.zeros(size)
        late[DISPLACEMENT] = jitter_s * image.rate_camera_km_s
        columns.append(late)
    if pointing_rad > 0.0:
        for k in range(3):
            turned = np.zeros(size)
            turned[ROTATION][k] = pointing_rad
            columns.append(turned)
    return np.stack(columns, axis=1) if columns else np.zeros((size, 0))


def evaluate(given: NavigationPass, layout: PassLayout, departure: Float) -> list[tuple[Float, Float]]:
    """Residuals and designs of all images at a departure (k,) of the parameters from their a priori values."""
    altitude = given.limb_altitude_km
    return [
        image.observed.effects(image.position_camera_km, altitude, moves @ departure)
        for image, moves in zip(given.images, layout.maps, strict=True)
    ]


def sums_of(residuals: Float, design: Float, keep: Mask, random: Float) -> ImageSums:
    """Compress the residuals (n,) that are kept of an image."""
    left, moved = residuals[keep], design[keep]
    return ImageSums(
        information=moved.T @ moved,
        pull=moved.T @ left,
        squares=float(left @ left),
        count=int(keep.sum()),
        random=random,
    )


def normal_of(layout: PassLayout, sums: list[ImageSums]) -> Normal:
    """Add up the images of a pass."""
    size = len(layout.names)
    information, pull = np.zeros((size, size)), np.zeros(size)
    squares = log_determinant = 0.0
    for moves, image in zip(layout.maps, sums, strict=True):
        own, along, left, log = image.without_new()
        information += moves.T @ own @ moves
        pull += moves.T @ along
        squares += left
        log_determinant += log
    return Normal(
        information=(information + information.T) / 2.0,
        pull=pull,
        squares=squares,
        log_determinant=log_determinant,
        count=sum(image.count for image in sums),
    )


def agreeing(
    given: NavigationPass, measured: list[tuple[Float, Float]], sums: list[ImageSums], outlier_sigmas: float
) -> list[Mask]:
    """Residuals of every image that are not outliers; a position is kept or left out as a whole."""
    left = [
        residuals - design @ (image.random @ image.new_errors)
        for (residuals, design), image in zip(measured, sums, strict=True)
    ]
    everything = np.concatenate(left)
    known = everything[np.isfinite(everything)]
    allowed = outlier_sigmas * max(robust_sigma(known, 0.0) if known.size else 1.0, 1.0)
    keeps = []
    for image, each in zip(given.images, left, strict=True):
        near = np.abs(each) < allowed
        keeps.append(np.full(near.shape, near.all()) if isinstance(image.observed, MeasuredPosition) else near)
    return keeps


def scaled_inverse(matrix: Float) -> Float:
    """Inverse of a symmetric positive definite matrix whose rows have different units."""
    scale = 1.0 / np.sqrt(np.diagonal(matrix))
    inverse = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    return (inverse + inverse.T) / 2.0


def noise_variance(sums: list[ImageSums]) -> float:
    """Variance of the residuals within images relative to their noise, at least 1; 1 where images cannot show it."""
    scatter = [image.own_scatter for image in sums]
    freedom = sum(count for _, count in scatter)
    return max(sum(squares for squares, _ in scatter) / freedom, 1.0) if freedom > 0 else 1.0


def restricted_cost(layout: PassLayout, sums: list[ImageSums], departure: Float) -> float:
    """Minus twice the logarithm of the restricted likelihood of the residuals, up to a constant."""
    normal, prior = normal_of(layout, sums), layout.information
    total, pull = normal.information + prior, normal.pull - prior @ departure
    scale = np.sqrt(np.diagonal(total))
    scaled = total / np.outer(scale, scale)
    explained = float(pull / scale @ np.linalg.solve(scaled, pull / scale))
    spread = float(np.linalg.slogdet(scaled)[1]) + 2.0 * float(np.sum(np.log(scale)))
    known = float(departure @ prior @ departure)
    cost = normal.log_determinant + spread + normal.squares + known - explained
    return cost if math.isfinite(cost) else math.inf
