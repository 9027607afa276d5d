"""The zero point of a camera from fluxes of catalog stars: least squares of fluxes, not of magnitudes.

Fluxes are fitted at the places of catalog stars, detected or not, with weights by the expected flux: no star enters, or
counts more, by its noise. A scatter of the stars about the relation is estimated with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from giantlike.calibration.observability import ParameterVerdict, support_of
from giantlike.catalogs.table import StarTable
from giantlike.core.arrays import Float, Mask, require, symmetric
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.photometry import Photometry
from giantlike.core.values import Estimate
from giantlike.photometry.fluxes import Fluxes

TERMS = ("zero_point", "color_term", "field_term_mag")  # names of the terms, in the order of ``covariance_mag2``
_COLOR_SIGMA, _FIELD_SIGMA = 0.5, 1.0  # mag, before the data: bands from blue to red; vignetting
_OFF = 1e-9  # mag, of a term that is not fitted
_MAG = 2.5 / math.log(10.0)  # mag per natural logarithm
_ROUNDS, _FREE_ROUNDS = 40, 10  # stars come back in the first rounds only, so that the fit settles
_SETTLED = 0.05  # standard deviations by which a fit may still move, which adds a thousandth to its error
_LEAST_SCATTER_MAG = 1e-4
_OUTLIER = 4.0  # standard deviations, scatter included
_LEAST_SNR = 5.0  # of the median star that starts the fit
_FIRST_SCATTER_MAG = 0.05
_NOTES = {
    "color_term": "no color term: the stars have one color, none, or too little light",
    "field_term_mag": "no field term: the stars are too near the axis, or have too little light",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ZeroPointOptions:
    """Options of :func:`fit_zero_point`.

    Parameters
    ----------
    color : {"color_bp_rp"} or None; color of the color term; None for no color term
    field : bool; fit a term with the square of the angle from the axis
    min_stars : int; fewest stars of the whole fit, and of each of its terms
    band : str; band of the magnitudes of the stars

    Raises
    ------
    InputError
        ``min_stars`` is below 3, or the color is unknown.
    """

    color: Literal["color_bp_rp"] | None = "color_bp_rp"
    field: bool = True
    min_stars: int = 6
    band: str = "Gaia G"

    def __post_init__(self) -> None:
        require(self.min_stars >= 3, f"min_stars must be >= 3, got {self.min_stars}")
        require(self.color in (None, "color_bp_rp"), f"color must be 'color_bp_rp' or None, got {self.color!r}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ZeroPoint(Estimate):
    """Zero point of a camera, measured.

    Parameters
    ----------
    photometry : Photometry; for camera files; of several images the mean, their scatter in its covariance
    supported : mapping of str to ParameterVerdict; of each term of :data:`TERMS`, by the stars
    images_mag : (k,) float64, mag; zero point of each image, with the color and field term of all
    covariance_images_mag2 : (k + 2, k + 2) float64, mag^2; of ``images_mag``, color term and field term
    residuals : tuple of k (n,) float64; flux minus expected, over the sigma of both with scatter; NaN if not used
    used : tuple of k (n,) bool; stars used
    n_used, n_rejected : int; stars used, and those left out as outliers
    notes : tuple of str; terms and stars missing from the fit, and why
    """

    photometry: Photometry
    supported: Mapping[str, ParameterVerdict]
    images_mag: Float
    covariance_images_mag2: Float
    residuals: tuple[Float, ...]
    used: tuple[Mask, ...]
    n_used: int
    n_rejected: int
    notes: tuple[str, ...] = ()

    @property
    def value_mag(self) -> float:
        """Magnitude of a star of BP-RP 1 on the axis that gives 1 electron per second."""
        return self.photometry.zero_point_mag

    @property
    def covariance_mag2(self) -> Float:
        """Covariance (3, 3) of zero point, color term and field term, mag^2."""
        return self.photometry.covariance_mag2

    def to_mapping(self) -> dict[str, Any]:
        """Return the zero point as a mapping for JSON; ``photometry`` is the table of camera files."""
        return {
            "photometry": self.photometry.to_mapping(),
            "zero_point_mag": self.value_mag,
            "sigma_mag": float(math.sqrt(self.covariance_mag2[0, 0])),
            "supported": {name: str(verdict) for name, verdict in self.supported.items()},
            "images_mag": self.images_mag.tolist(),
            "images_sigma_mag": np.sqrt(np.diag(self.covariance_images_mag2))[:-2].tolist(),
            "n_used": self.n_used,
            "n_rejected": self.n_rejected,
            "notes": list(self.notes),
        }


def fit_zero_point(
    fluxes: Sequence[Fluxes], stars: StarTable | Sequence[StarTable], options: ZeroPointOptions = ZeroPointOptions()
) -> ZeroPoint | Failure:
    r"""Fit the zero point of a camera to fluxes of catalog stars.

    Parameters
    ----------
    fluxes : sequence of k Fluxes; of one camera: of all catalog stars of each field, detected or not
    stars : StarTable or sequence of k StarTable; the star of each row of each of the fluxes
    options : ZeroPointOptions

    Returns
    -------
    ZeroPoint or Failure
        ``too_few_matches``: fewer useful stars than ``min_stars``; ``no_signal``: the stars have no light.

    Raises
    ------
    InputError
        There are no fluxes, or not as many stars as fluxes, or a magnitude is not finite.

    Notes
    -----
    :math:`m + 2.5 \log_{10} f = z_k + c (BP-RP - 1) + v (\theta / \theta_0)^2` in flux :math:`f`, by generalized least
    squares with the covariance of the fluxes, the relative scatter of the stars (restricted likelihood), and rejection
    of outliers on both sides. The angle :math:`\theta_0` is that of the corner. Color and field term have wide priors,
    0.5 and 1 mag, which stay in the covariance where the stars say nothing of them.
    """
    require(len(fluxes) > 0, "fluxes: at least one image is needed")
    tables = [stars] * len(fluxes) if isinstance(stars, StarTable) else list(stars)
    require(len(tables) == len(fluxes), f"stars: {len(fluxes)} tables are needed, one an image, got {len(tables)}")
    frames = [
        _Frame.from_fluxes(*pair, fluxes[0].half_diagonal_deg, options) for pair in zip(fluxes, tables, strict=True)
    ]
    n_useful = sum(int(frame.useful.sum()) for frame in frames)
    if n_useful < options.min_stars:
        return Failure(
            Reason.TOO_FEW_MATCHES,
            f"{n_useful} stars are neither saturated, masked, cut nor blended, {options.min_stars} are needed",
        )
    start = np.array([frame.start_mag() for frame in frames])
    if not np.isfinite(start).all():
        dark = [frame.fluxes.name for frame, each in zip(frames, start, strict=True) if not math.isfinite(each)]
        return Failure(Reason.NO_SIGNAL, f"{', '.join(dark)}: the stars of the catalog have no light")
    fit = _Fit(
        frames, start, np.array([_COLOR_SIGMA if options.color else _OFF, _FIELD_SIGMA if options.field else _OFF])
    )
    if not fit.solve():
        return Failure(Reason.NOT_CONVERGED, "the zero point did not settle: are the stars those of the fluxes?")
    if fit.n_used < max(options.min_stars, n_useful // 2):
        why = f"{fit.n_used} of {n_useful} stars agree on a zero point, {options.min_stars} and half of them are needed"
        return Failure(Reason.TOO_FEW_MATCHES, why)
    return fit.result(options)


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """Stars (n) of an image: ``rows`` (n, 2), factors of color and field term."""

    fluxes: Fluxes
    magnitude: Float
    rows: Float
    useful: Mask

    @classmethod
    def from_fluxes(cls, fluxes: Fluxes, stars: StarTable, corner_deg: float, options: ZeroPointOptions) -> _Frame:
        count = len(fluxes.flux_dn)
        require(len(stars.ids) == count, f"{fluxes.name}: {count} fluxes need as many stars, got {len(stars.ids)}")
        require(bool(np.isfinite(stars.magnitude).all()), f"{fluxes.name}: a star has no magnitude")
        rows = Photometry(field_angle_deg=corner_deg).partials(
            color_bp_rp=stars.color_bp_rp, angle_rad=fluxes.angle_rad
        )
        useful = fluxes.useful & ~stars.is_double
        colored = useful & np.isfinite(stars.color_bp_rp)
        if options.color and colored.sum() >= options.min_stars:
            useful = colored
        return cls(fluxes, np.asarray(stars.magnitude), rows[:, 1:], useful)

    @property
    def scale(self) -> float:
        """Electrons per second over numbers."""
        return self.fluxes.gain_e_per_dn / self.fluxes.exposure_s

    def start_mag(self) -> float:
        """Zero point by the median of the bright stars, or by all light where there are fewer than three."""
        flux, sigma = self.fluxes.flux_dn, self.fluxes.sigma_dn
        bright = self.useful & (flux > _LEAST_SNR * sigma)
        if bright.sum() >= 3:
            return float(np.median(self.magnitude[bright] + 2.5 * np.log10(flux[bright] * self.scale)))
        unit = 10.0 ** (-0.4 * self.magnitude)
        light = float(np.sum((flux * unit / sigma**2)[self.useful]) / np.sum(((unit / sigma) ** 2)[self.useful]))
        return 2.5 * math.log10(light * self.scale) if light > 0.0 else math.nan

    def expected_dn(self, terms: Float) -> Float:
        """Expected fluxes (n,) by zero point, color and field term (3,)."""
        return np.asarray(10.0 ** (0.4 * (terms[0] + self.rows @ terms[1:] - self.magnitude)) / self.scale)

    def covariance(self, expected: Float, scatter_mag: float) -> Float:
        """Covariance (n, n) of the fluxes, with shot noise and scatter of the expected ones."""
        change = self.fluxes.shot_dn * (expected - np.maximum(self.fluxes.flux_dn, 0.0))
        relative = (scatter_mag / _MAG * expected) ** 2
        noise = self.fluxes.noise_covariance_dn2.copy()
        noise[np.diag_indices_from(noise)] += change + relative
        return noise


class _Fit:
    """Iteration: values (k + 2,), their information, the scatter, and the stars that are used."""

    def __init__(self, frames: Sequence[_Frame], start: Float, prior_sigma: Float) -> None:
        self.frames, self.prior_sigma, self.values = frames, prior_sigma, np.append(start, [0.0, 0.0])
        self.scatter_mag = _FIRST_SCATTER_MAG
        self.used = [frame.useful.copy() for frame in frames]
        self.residuals = [np.zeros(len(frame.magnitude)) for frame in frames]
        self.information = np.eye(len(self.values))

    @property
    def n_used(self) -> int:
        return sum(int(used.sum()) for used in self.used)

    def solve(self) -> bool:
        """Iterate until values, scatter and stars stand still."""
        for number in range(_ROUNDS):
            step, scatter, used, moved = self.step()
            same = all(np.array_equal(one, other) for one, other in zip(used, self.used, strict=True))
            self.values, self.scatter_mag = self.values + np.clip(step, -1.0, 1.0), scatter
            if number > 0:
                self.used = (
                    used if number < _FREE_ROUNDS else [old & new for old, new in zip(self.used, used, strict=True)]
                )
                if self.n_used == 0:
                    return False
            if moved < _SETTLED and same:
                return True
        return False

    def step(self) -> tuple[Float, float, list[Mask], float]:
        """Step of the values, new scatter, stars that are not outliers, and both changes over their sigma."""
        count = len(self.frames)
        information, right = np.zeros((count + 2, count + 2)), np.zeros(count + 2)
        information[[-2, -1], [-2, -1]] = self.prior_sigma**-2.0
        right[-2:] = -self.values[-2:] / self.prior_sigma**2
        excess, power, trace, used = 0.0, 0.0, 0.0, []
        for number, frame in enumerate(self.frames):
            expected = frame.expected_dn(self.values[[number, -2, -1]])
            covariance = frame.covariance(expected, self.scatter_mag)
            left = frame.fluxes.flux_dn - expected
            self.residuals[number] = left / np.sqrt(covariance.diagonal())
            used.append(frame.useful & (np.abs(self.residuals[number]) < _OUTLIER))
            kept = np.flatnonzero(self.used[number])
            inverse = np.linalg.inv(covariance[np.ix_(kept, kept)])
            slope = np.zeros((len(kept), count + 2))
            slope[:, number] = expected[kept] / _MAG
            slope[:, -2:] = slope[:, number, None] * frame.rows[kept]
            weighted = inverse @ slope
            information += slope.T @ weighted
            right += weighted.T @ left[kept]
            relative = (expected[kept] / _MAG) ** 2
            excess += float(relative @ (inverse @ left[kept]) ** 2)
            trace += float(relative @ inverse.diagonal())
            power += float(relative @ inverse**2 @ relative)
        self.information = information
        freedom = 1.0 - (count + np.sum(self.prior_sigma > _OFF)) / max(self.n_used, count + 3)
        variance = self.scatter_mag**2 + (excess - freedom * trace) / power
        scatter = math.sqrt(0.5 * (max(variance, 0.0) + self.scatter_mag**2))
        scatter = scatter if scatter > _LEAST_SCATTER_MAG else 0.0
        step = np.linalg.solve(information, right)
        moved = math.sqrt(float(step @ right)) + abs(scatter**2 - self.scatter_mag**2) * math.sqrt(0.5 * power)
        return np.asarray(step, float), scatter, used, moved

    def result(self, options: ZeroPointOptions) -> ZeroPoint:
        """The fitted value, of several images their mean."""
        count, fluxes = len(self.frames), [frame.fluxes for frame in self.frames]
        covariance = symmetric(np.asarray(np.linalg.inv(self.information), float))
        covariance[:count, :count] += np.diag([(_MAG * each.growth_sigma) ** 2 for each in fluxes])
        images, spread, mean = self.values[:count], 0.0, np.ones(1)
        if count > 1:
            weight = np.diag(1.0 / np.diag(covariance)[:count])
            centered = images - np.trace(weight @ np.diag(images)) / np.trace(weight)
            total = np.trace(weight)
            spread = max(
                0.0, (float(centered @ weight @ centered) - (count - 1)) / (total - np.trace(weight**2) / total)
            )
            mean = 1.0 / (np.diag(covariance)[:count] + spread)
            mean /= mean.sum()
        gather = np.zeros((3, count + 2))
        gather[0, :count], gather[1, -2], gather[2, -1] = mean, 1.0, 1.0
        joint = gather @ covariance @ gather.T
        joint[0, 0] += spread * (1.0 + float(mean @ mean)) if count > 1 else 0.0
        values = gather @ self.values
        free = self.prior_sigma > _OFF
        names = [name for name, is_free in zip(TERMS, (True, *free), strict=True) if is_free]
        chosen = np.ix_([True, *free], [True, *free])
        prior = np.array([math.inf, *self.prior_sigma])[[True, *free]]
        support = support_of(
            names, values[[True, *free]], np.zeros(len(names)), prior, joint[chosen], np.ones(len(names)), {TERMS[0]}
        )
        joint[~np.outer([True, *free], [True, *free])] = 0.0
        verdicts = {each.name: each.verdict for each in support}
        return ZeroPoint(
            photometry=Photometry(
                zero_point_e_s=10.0 ** (0.4 * float(values[0])),
                band=options.band,
                color_term=float(values[1]) if free[0] else 0.0,
                field_term_mag=float(values[2]) if free[1] else 0.0,
                field_angle_deg=fluxes[0].half_diagonal_deg,
                covariance_mag2=symmetric(joint),
                scatter_mag=self.scatter_mag,
                epoch=fluxes[0].epoch,
            ),
            supported=verdicts,
            images_mag=images,
            covariance_images_mag2=covariance,
            residuals=tuple(np.where(f.useful, r, np.nan) for f, r in zip(self.frames, self.residuals, strict=True)),
            used=tuple(self.used),
            n_used=self.n_used,
            n_rejected=sum(int(frame.useful.sum()) for frame in self.frames) - self.n_used,
            notes=tuple(_NOTES[name] for name in TERMS[1:] if verdicts.get(name) is ParameterVerdict.PRIOR_ONLY),
        )
