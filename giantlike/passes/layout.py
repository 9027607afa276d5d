"""From terms to parameters: names, units, a priori covariance, and how each moves every image of a pass."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike.calibration.options import Treatment
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.values import Value
from giantlike.passes.images import (
    ALTITUDE,
    DISPLACEMENT,
    EFFECTS,
    OFFSET,
    ROTATION,
    NavigationPass,
    PassImage,
    shared_names,
)
from giantlike.passes.terms import TRAJECTORY, PassOptions, PassTerm

_AXES = ("x", "y", "z")
_UNITS = {
    PassTerm.LIMB_ALTITUDE: "km",
    PassTerm.RANGE_SCALE: "",
    PassTerm.LIMB_OFFSET: "px",
    PassTerm.EXPOSURE_STEPS: "px",
    PassTerm.EXPOSURE_LOG: "px",
    PassTerm.POINTING_BIAS: "rad",
    PassTerm.POINTING_DRIFT: "rad/s",
    PassTerm.INTERLOCK: "rad",
    PassTerm.TIMETAG_BIAS: "s",
}
LIMB_ERRORS = "limb errors"  # name of the term of all errors that limbs share; each has unit variance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassLayout(Value):
    """Parameters of a pass, k in all."""

    names: tuple[str, ...]  # names, units, terms: of each parameter; ``terms`` names the term that it belongs to
    units: tuple[str, ...]
    terms: tuple[str, ...]
    apriori: Float  # (k,); values before
    covariance_apriori: Float  # (k, k); of these; zero in rows of parameters of which nothing is known (``free``)
    free: Mask  # (k,)
    estimated: Mask  # (k,); the others are considered
    maps: tuple[Float, ...]  # for each image (8 + c, k); its errors by parameters less ``apriori``

    @classmethod
    def from_pass(cls, given: NavigationPass, options: PassOptions) -> PassLayout:
        """Lay out the parameters of a pass."""
        columns: list[_Column] = []
        for treatment, terms in ((True, options.estimate), (False, options.consider)):
            for term, sigma in terms.items():
                columns += [
                    _Column(name, _UNITS[term], str(term), sigma, treatment, moves)
                    for name, moves in _moves(term, given.images)
                ]
        trajectory, limbs = options.trajectory is Treatment.ESTIMATE, options.limb_errors is Treatment.ESTIMATE
        base = len(columns)
        count = len(given.covariance_trajectory) if options.trajectory is not Treatment.FIXED else 0
        for k in range(count):
            name = given.trajectory_names[k] if given.trajectory_names else str(k)
            moves = tuple(_effect(image, DISPLACEMENT, image.by_trajectory[:, k]) for image in given.images)
            columns.append(_Column(f"{TRAJECTORY}_{name}", "", TRAJECTORY, 1.0, trajectory, moves))
        for key, several in shared_names(given.images) if options.limb_errors is not Treatment.FIXED else []:
            columns += [
                _Column(
                    f"{key} {k}",
                    "sigma",
                    LIMB_ERRORS,
                    1.0,
                    limbs,
                    tuple(_shared_error(i, key, k) for i in given.images),
                )
                for k in range(several)
            ]
        require(any(column.estimated for column in columns), "options.estimate names no term: nothing to solve for")
        sigmas = np.array([column.sigma for column in columns])
        free = np.isinf(sigmas)
        own = np.diag(np.where(free, 0.0, np.where(free, 0.0, sigmas) ** 2))
        own[base : base + count, base : base + count] = given.covariance_trajectory[:count, :count]
        altitude = [column.term == PassTerm.LIMB_ALTITUDE for column in columns]
        return cls(
            names=tuple(column.name for column in columns),
            units=tuple(column.unit for column in columns),
            terms=tuple(column.term for column in columns),
            apriori=np.where(altitude, given.limb_altitude_km, 0.0),
            covariance_apriori=own,
            free=free,
            estimated=np.array([column.estimated for column in columns]),
            maps=tuple(np.stack([column.moves[k] for column in columns], axis=1) for k in range(len(given.images))),
        )

    @property
    def information(self) -> Float:
        """A priori information (k, k); zero for parameters of which nothing is known."""
        known = ~self.free
        result = np.zeros_like(self.covariance_apriori)
        part = self.covariance_apriori[np.ix_(known, known)]
        scale = np.sqrt(np.diagonal(part))
        require(bool(np.all(scale > 0.0)), "covariance_trajectory must have variances > 0: leave exact parameters out")
        result[np.ix_(known, known)] = np.linalg.inv(part / np.outer(scale, scale)) / np.outer(scale, scale)
        return (result + result.T) / 2.0

    @property
    def groups(self) -> dict[str, NDArray[np.intp]]:
        """Indices of the parameters of each term, in the order of the terms."""
        return {term: np.flatnonzero([each == term for each in self.terms]) for term in dict.fromkeys(self.terms)}


@dataclass(frozen=True, slots=True)
class _Column:
    """One parameter, and the errors (8 + c,) that one unit of it makes in every image."""

    name: str
    unit: str
    term: str
    sigma: float
    estimated: bool
    moves: tuple[Float, ...]


def _effect(image: PassImage, where: slice | int, value: Float | float) -> Float:
    """Errors (8 + c,) of an image, zero but in one place."""
    errors = np.zeros(EFFECTS + sum(px.shape[1] for px in image.observed.shared_px.values()))
    errors[where] = value
    return errors


def _shared_error(image: PassImage, key: str, index: int) -> Float:
    """One of the errors that limbs share; zero where the image has none of them."""
    first = EFFECTS
    for name, shift in image.observed.shared_px.items():
        if name == key:
            return _effect(image, first + index, 1.0)
        first += shift.shape[1]
    return _effect(image, OFFSET, 0.0)


def _moves(term: PassTerm, images: tuple[PassImage, ...]) -> list[tuple[str, tuple[Float, ...]]]:
    """Names of the parameters of a term, and the effect of one unit of each on every image."""
    single = {
        PassTerm.LIMB_ALTITUDE: lambda image: _effect(image, ALTITUDE, 1.0),
        PassTerm.RANGE_SCALE: lambda image: _effect(image, DISPLACEMENT, image.position_camera_km),
        PassTerm.LIMB_OFFSET: lambda image: _effect(image, OFFSET, 1.0),
        PassTerm.TIMETAG_BIAS: lambda image: _effect(image, DISPLACEMENT, image.rate_camera_km_s),
    }
    if term in single:
        return [(str(term), tuple(single[term](image) for image in images))]
    if term in (PassTerm.EXPOSURE_STEPS, PassTerm.EXPOSURE_LOG):
        return _exposure_moves(term, images)
    times = np.array([image.time_s for image in images])
    middle = 0.5 * float(times.min() + times.max())
    if term is PassTerm.INTERLOCK:
        sensors = list(dict.fromkeys(image.sensor for image in images))
        require(len(sensors) > 1, f"{term}: the attitudes of all images come from one sensor ({sensors[0]!r})")
        weights = {f"{term}_{sensor}": [float(image.sensor == sensor) for image in images] for sensor in sensors[1:]}
    else:
        weights = {str(term): [1.0] * len(images) if term is PassTerm.POINTING_BIAS else list(times - middle)}
    return [
        (f"{name}_{axis}", tuple(_effect(i, ROTATION, w * np.eye(3)[k]) for i, w in zip(images, each, strict=True)))
        for name, each in weights.items()
        for k, axis in enumerate(_AXES)
    ]


def _exposure_moves(term: PassTerm, images: tuple[PassImage, ...]) -> list[tuple[str, tuple[Float, ...]]]:
    """The same for the terms of the exposure."""
    exposures = [image.exposure_s for image in images]
    unknown = [image.name for image in images if not (math.isfinite(image.exposure_s) and image.exposure_s > 0.0)]
    require(not unknown, f"{term}: exposure_s of {', '.join(unknown[:3])} must be > 0")
    levels = sorted(set(exposures))
    require(len(levels) > 1, f"{term}: all images have the exposure {levels[0]:g} s")
    if term is PassTerm.EXPOSURE_LOG:
        slopes = [math.log(exposure / levels[0]) for exposure in exposures]
        return [(str(term), tuple(_effect(i, OFFSET, slope) for i, slope in zip(images, slopes, strict=True)))]
    return [
        (f"{term}_{level:g}s", tuple(_effect(image, OFFSET, float(image.exposure_s == level)) for image in images))
        for level in levels[1:]
    ]
