"""Undeclared markings of a surface: a smooth random field that multiplies the light of a body.

The field is a Gaussian process of unknown amplitude and correlation length, approximated by cosines over a square
around the body with variances from its spectral density [1]_. Products of cosines are sums of cosines, so that
sums over pixels for all pairs of modes follow from one small transform of the image of weights.

References
----------
.. [1] Solin and Sarkka (2020), Hilbert space methods for reduced-rank Gaussian process regression, Statistics and
   Computing 30, 419, abstract: eigenfunctions of the Laplacian with variances by the spectral density. Here they are
   cosines, whose slope vanishes at the edge of the square, and their variances add up to 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.values import Value

HALF_WIDTH = 1.25  # half width of the square, radii of the body: its edge lies outside of a body that is off center
_MODES = 9  # number of cosines along each axis: the shortest wavelength is 0.6 radii
LENGTHS = (0.25, 0.5, 1.0)  # correlation lengths, radii, to average over: a prior, up to markings as large as the body
AMPLITUDES = np.concatenate([[0.0], np.geomspace(0.004, 3.0**-0.5, 9)])
"""Standard deviations relative to the light to average over: up to albedos uniform from 0 to twice their mean."""
MEDIAN_AMPLITUDE, AMPLITUDE_FACTOR = 0.10, 2.5
"""Median and geometric standard deviation of the prior of the amplitude: a first guess, not from published maps."""
UNMARKED = 0.1  # prior probability of a surface without undeclared markings: a guess, as the amplitude


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MarkingModes(Value):
    """Cosine modes of a field that multiplies light, on the pixels of a box."""

    light: Float  # (h, w); signal of the body that the field multiplies
    along_x: Float  # along_x, along_y: (m, w) and (m, h); cosines along each axis
    along_y: Float
    frequencies: Float  # (m,); angular frequencies of the cosines, in units of 1 / radius
    radius_px: float

    @classmethod
    def across(cls, light: Float, center_px: Float, radius_px: float, modes: int = _MODES) -> MarkingModes:
        """Return the modes across a body. ``light`` (h, w); ``center_px``: center of the body from the first pixel."""
        order = np.arange(modes)
        norm = np.where(order == 0, 1.0, math.sqrt(2.0))[:, None]
        phases = [
            (np.arange(size) - middle) / (2.0 * HALF_WIDTH * radius_px) + 0.5
            for size, middle in zip(light.shape[::-1], center_px, strict=True)
        ]
        along_x, along_y = (norm * np.cos(np.pi * order[:, None] * np.clip(phase, 0.0, 1.0)) for phase in phases)
        frequencies: Float = np.pi / (2.0 * HALF_WIDTH) * order.astype(np.float64)
        return cls(light=light, along_x=along_x, along_y=along_y, frequencies=frequencies, radius_px=radius_px)

    def brighter(self, factor: float) -> MarkingModes:
        """Return the modes on light that is brighter by a factor."""
        return replace(self, light=factor * self.light)

    @property
    def count(self) -> int:
        """Number of modes in two dimensions."""
        return len(self.along_x) ** 2

    def image(self, coefficients: Float) -> Float:
        """Light (..., h, w) that coefficients (..., modes) add."""
        size = len(self.along_x)
        grid = coefficients.reshape(*coefficients.shape[:-1], size, size)
        return np.asarray(self.light * (self.along_y.T @ grid @ self.along_x))

    def products(self, images: Float) -> Float:
        """Sums (..., modes) over the pixels of images (..., h, w) times each mode."""
        grid = self.along_y @ (images * self.light) @ self.along_x.T
        return np.asarray(grid.reshape(*images.shape[:-2], self.count))

    def gram(self, weights: Float) -> Float:
        """Weighted sums (modes, modes) over the pixels of the products of modes."""
        size = len(self.along_x)
        weighted = weights * self.light**2
        pairs_x, pairs_y = ((one[:, None] * one[None]).reshape(size * size, -1) for one in (self.along_x, self.along_y))
        sums = (pairs_y @ weighted @ pairs_x.T).reshape(size, size, size, size)  # y, y', x, x'
        return np.ascontiguousarray(sums.transpose(0, 2, 1, 3)).reshape(self.count, self.count)

    @property
    def spectra(self) -> Float:
        """Variances (lengths, modes) of fields of unit variance for all correlation lengths."""
        return np.stack([self.spectrum(length) for length in LENGTHS])

    @property
    def first_variances(self) -> Float:
        """Variances (modes,) for the first iterations, whose residuals do not yet show markings."""
        return MEDIAN_AMPLITUDE**2 * self.spectrum(LENGTHS[1])

    def spectrum(self, length: float) -> Float:
        """Variances (modes,) of the modes of a field of unit variance and a squared-exponential correlation.

        ``length``: correlation length over the radius.
        """
        along = np.exp(-0.5 * (length * self.frequencies) ** 2)
        variances = np.outer(along / along.sum(), along / along.sum()).ravel()
        variances[0] = 0.0  # constant: the brightness of the body, which is fitted
        return variances


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FieldSums(Value):
    """Weighted sums over the pixels of the modes of a field and of the columns fitted with them."""

    gram: Float  # (m, m); of the modes
    cross: Float  # (k, m); of the columns and the modes
    scores: Float  # (m,); of the modes and the values
    information: Float  # (k, k); of the columns, with their prior
    right: Float  # (k,); of the columns and the values, with the mean of the prior
    squares: float = 0.0  # of the values, and of the mean of the prior divided by its standard deviation

    def variances(self, spectra: Float) -> Float:
        """Return the variances (m,) of the modes, averaged over amplitudes and lengths by their likelihood.

        The likelihood is that of the values with the columns integrated out (restricted likelihood).
        """
        variances = AMPLITUDES**2
        explained, log_volumes = self._explain_by_fields(spectra, variances)
        log_likelihood = 0.5 * (explained - log_volumes) + np.log(prior_of_amplitudes())
        chances = np.exp(log_likelihood - log_likelihood.max())
        return np.asarray(np.einsum("la,a,lm->m", chances / chances.sum(), variances, spectra))

    def log_evidence(self, spectra: Float, parts: float) -> float:
        """Return the logarithm of the restricted likelihood, averaged over amplitudes, lengths and the scale of noise.

        ``spectra`` (n, m).
        """
        explained, log_volumes = self._explain_by_fields(spectra, AMPLITUDES**2)
        left = self.squares - float(self.right @ np.linalg.solve(self.information, self.right)) - explained
        chances = prior_of_amplitudes() / len(spectra)
        misfit = parts * (np.log(np.maximum(left, 1e-300) / parts) + 1.0)
        log_likelihood = -0.5 * (misfit + log_volumes) + np.log(chances)
        return float(np.logaddexp.reduce(log_likelihood, axis=None) - 0.5 * np.linalg.slogdet(self.information)[1])

    def _explain_by_fields(self, spectra: Float, variances: Float) -> tuple[Float, Float]:
        """Squares explained by fields, and their contributions to the log determinant: (lengths, amplitudes)."""
        solved = np.linalg.solve(self.information, np.column_stack([self.cross, self.right]))
        gram, scores = self.gram - self.cross.T @ solved[:, :-1], self.scores - self.cross.T @ solved[:, -1]
        explained, log_volumes = np.empty((2, len(spectra), len(variances)))
        for number, spectrum in enumerate(spectra):
            root = np.sqrt(spectrum)
            values, vectors = np.linalg.eigh(root[:, None] * gram * root)
            shares = variances[:, None] * np.maximum(values, 0.0)
            gains = variances[:, None] * (vectors.T @ (root * scores)) ** 2
            explained[number] = np.sum(gains / (1.0 + shares), axis=1)
            log_volumes[number] = np.sum(np.log1p(shares), axis=1)
        return explained, log_volumes

    def solve(self, variances: Float) -> FieldSolution:
        """Solve for the columns and the modes under given variances (m,) of the modes."""
        root = np.sqrt(variances)
        whitened = np.eye(len(root)) + root[:, None] * self.gram * root
        right = root[:, None] * np.column_stack([self.cross.T, self.scores])
        solved = np.linalg.solve(whitened, right)
        steps, own = root[:, None] * solved[:, :-1], root * solved[:, -1]
        information = self.information - self.cross @ steps
        return FieldSolution(
            information=0.5 * (information + information.T),
            right=self.right - self.cross @ own,
            steps=steps,
            own=own,
            scatter=solved[:, :-1].T @ solved[:, :-1],
            variances=variances,
            whitened=whitened,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FieldSolution(Value):
    """Normal equations of the columns with the field eliminated.

    whitened: (m, m); information on the modes in units of their standard deviations, that of their prior included.
    """

    information: Float  # (k, k)
    right: Float  # (k,)
    steps: Float  # (m, k); change of the modes by the columns: modes are ``own - steps @ parameters``
    own: Float  # (m,)
    scatter: Float  # (k, k); covariance of the scores of the columns by the field
    variances: Float  # (m,); of the modes
    whitened: Float

    def find_absorbed_squares(self, scatter: Float) -> float:
        """Return the weighted squares of errors that the field absorbs.

        ``scatter`` (m, m): covariance of the weighted products of the modes and the errors.
        """
        root = np.sqrt(self.variances)
        return float(np.vdot(np.linalg.inv(self.whitened), root[:, None] * scatter * root))

    def find_lost_information(self, products: Float) -> Float:
        """Loss of information (j, j) by the field, of columns with weighted products (j, m) with its modes."""
        scaled = np.sqrt(self.variances) * products
        return np.asarray(scaled @ np.linalg.solve(self.whitened, scaled.T))


def prior_of_amplitudes() -> Float:
    """Prior probabilities of :data:`AMPLITUDES`."""
    logs = np.log(AMPLITUDES[1:] / MEDIAN_AMPLITUDE) / math.log(AMPLITUDE_FACTOR)
    density = np.exp(-0.5 * logs**2)
    return np.concatenate([[UNMARKED], (1.0 - UNMARKED) * density / density.sum()])
