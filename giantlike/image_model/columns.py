"""Linear models of data: unknowns in named blocks, their weighted least squares, and score tests of omitted blocks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.values import Value
from giantlike.image_model.field import FieldSolution, FieldSums, MarkingModes

UNDECLARED = 0.1  # prior probability of each undeclared effect, as for a surface without markings
_CONDITION_LIMIT = 1e12  # of the scaled normal matrix: four digits of float64 are left


class Use(StrEnum):
    """How an effect enters a model."""

    FITTED = "fitted"  # estimated along with the place
    CONSIDERED = "considered"  # in the covariance only: its size is declared, and residuals must not decide on it
    WHEN_SEEN = "when_seen"  # averaged over on and off, by the odds of either


@dataclass(frozen=True, slots=True, eq=False)
class Prior(Value):
    """Prior of independent unknowns."""

    mean: Float  # (k,)
    information: Float  # (k,); inverse variances; 0 for free unknowns

    @property
    def parts(self) -> tuple[Float, Float]:
        """Mean and information."""
        return self.mean, self.information

    @classmethod
    def of_sigmas(cls, sigmas: Float | Sequence[float], mean: Float | float = 0.0) -> Prior:
        """Return the prior of standard deviations (k,), infinite for free unknowns."""
        return cls(np.zeros(len(sigmas)) + mean, np.asarray(sigmas, dtype=np.float64) ** -2.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block(Value):
    """Unknowns of one effect."""

    effect: str
    cause: Cause  # of the errors of the solution by ignorance of the effect
    matrix: Float  # (k, ...); derivative of the data by each unknown
    prior: Prior
    use: Use = Use.FITTED


@dataclass(frozen=True)
class Layout:
    """Order of the unknowns of a model: the name of each effect, its cause and the number of its unknowns."""

    effects: tuple[tuple[str, Cause, int], ...]

    @cached_property
    def count(self) -> int:
        """Number of unknowns."""
        return sum(size for _, _, size in self.effects)

    @cached_property
    def causes(self) -> tuple[Cause, ...]:
        """Causes of the effects that have unknowns, each once, in their order."""
        return tuple(dict.fromkeys(cause for _, cause, size in self.effects if size))

    @cached_property
    def _spans(self) -> dict[str, slice]:
        """Entries of each effect."""
        ends = np.cumsum([size for _, _, size in self.effects]).tolist()
        return {name: slice(end - size, end) for (name, _, size), end in zip(self.effects, ends, strict=True)}

    def span(self, first: str, last: str | None = None) -> slice:
        """Return the entries of an effect, or of all from one to another."""
        return slice(self._spans[first].start, self._spans[last or first].stop)

    def part(self, first: str, last: str) -> Layout:
        """Return the order of the unknowns from one effect to another alone."""
        names = [name for name, _, _ in self.effects]
        return Layout(self.effects[names.index(first) : names.index(last) + 1])

    def of_cause(self, cause: Cause) -> NDArray[np.int64]:
        """Return the entries whose effects have a cause."""
        _, causes, sizes = zip(*self.effects, strict=True)
        return np.flatnonzero(np.repeat([each is cause for each in causes], sizes))

    def without(self, effect: str) -> NDArray[np.int64]:
        """Return the entries of all other effects."""
        return np.delete(np.arange(self.count), self._spans[effect])

    def vector(self, values: Mapping[str, float | Sequence[float]], *, other: float = 0.0) -> Float:
        """Return a vector (k,) of values by effect, with one value for all effects without."""
        result = np.full(self.count, other)
        for effect, value in values.items():
            result[self._spans[effect]] = value
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Columns(Value):
    """A linear model of data: ``data = matrix^T unknowns + field + noise``.

    markings: A random field in the data in addition to the unknowns, which is eliminated; data are images then.
    variances: (m,); of the modes of the field; by default they follow from the data, see
        :meth:`~giantlike.image_model.field.FieldSums.variances`.

    projected: (k, ...); derivatives by the unknowns, with their projection on the field subtracted.
    """

    layout: Layout  # of the rows of ``matrix``
    matrix: Float  # (k, ...); derivative of the data by each unknown
    prior: Prior
    data: Float  # (...)
    weights: Float  # (...); inverse variances; 0 where data is not used
    markings: MarkingModes | None = None
    variances: Float | None = None
    projected: Float = field(init=False)
    information: Float = field(init=False)  # (k, k); normal matrix, the prior included and the field eliminated
    right: Float = field(init=False)  # (k,); right-hand side of the normal equations
    eliminated: FieldSolution | None = field(init=False)  # normal equations with the field eliminated
    sums: FieldSums = field(init=False)  # sums from which these follow

    def __post_init__(self) -> None:
        matrix, prior = self.matrix.reshape(len(self.matrix), -1), self.prior
        scaled, weighted = matrix * np.sqrt(self.weights).ravel(), self.weights * self.data
        modes = self.markings
        sums = FieldSums(
            gram=np.zeros((0, 0)) if modes is None else modes.gram(self.weights),
            cross=np.zeros((len(matrix), 0)) if modes is None else modes.products(self.matrix * self.weights),
            scores=np.zeros(0) if modes is None else modes.products(weighted),
            # of an array with itself: half of the products
            information=scaled @ scaled.T + np.diag(prior.information),
            right=matrix @ weighted.ravel() + prior.information * prior.mean,
            squares=float(np.vdot(weighted, self.data) + prior.information @ prior.mean**2),
        )
        information, right, projected, solved = sums.information, sums.right, self.matrix, None
        if modes is not None:
            solved = sums.solve(sums.variances(modes.spectra) if self.variances is None else self.variances)
            information, right = solved.information, solved.right
            projected = self.matrix - modes.image(solved.steps.T)
        found = {"sums": sums, "projected": projected, "information": information, "right": right, "eliminated": solved}
        for name, value in found.items():
            object.__setattr__(self, name, value)
        Value.__post_init__(self)

    @classmethod
    def from_blocks(cls, blocks: Sequence[Block], data: Float, weights: Float) -> Columns:
        """Return the model with the unknowns of blocks."""
        return cls(*_stack_blocks(blocks), data, weights)

    def extend(self, blocks: Sequence[Block]) -> Columns:
        """Return the model with the unknowns of further blocks after its own."""
        layout, matrix, prior = _stack_blocks(blocks)
        return replace(
            self,
            layout=Layout(self.layout.effects + layout.effects),
            matrix=np.concatenate([self.matrix, matrix]),
            prior=Prior(*(np.concatenate(both) for both in zip(self.prior.parts, prior.parts, strict=True))),
        )

    @property
    def rows(self) -> Float:
        """Derivatives (k, n) by each unknown, with their projection on the field subtracted."""
        return self.projected.reshape(len(self.projected), -1)

    def __getitem__(self, effect: str) -> Float:
        """Derivatives (j, ...) by the unknowns of an effect."""
        return self.matrix[self.layout.span(effect)]

    def solve(self) -> Solution | None:
        """Return the weighted least-squares solution; None where the data do not determine the unknowns."""
        scale = np.sqrt(np.maximum(np.diag(self.information), 1e-300))
        scaled = self.information / scale / scale[:, None]
        if not _condition(scaled) <= _CONDITION_LIMIT:
            return None
        return Solution(self, np.asarray(np.linalg.solve(scaled, self.right / scale) / scale))

    @property
    def mode_variances(self) -> Float | None:
        """Variances (m,) of the modes of the field; None without one."""
        return None if self.eliminated is None else self.eliminated.variances

    @property
    def field_scatter(self) -> Float:
        """Covariance (k, k) of the scores of the unknowns by the field; zero without one."""
        none = np.zeros_like(self.information)
        return none if self.eliminated is None else self.eliminated.scatter

    def log_evidence(self, parts: float) -> float:
        """Return the logarithm of the likelihood of the data, unknowns and field integrated out.

        ``parts``: number of independent values among the data, as errors of a model are alike over whole regions.
        """
        share, known, sums = parts / max(int(np.count_nonzero(self.weights)), 1), self.prior, self.sums
        of_prior = known.information * known.mean
        tempered = FieldSums(
            gram=share * sums.gram,
            cross=share * sums.cross,
            scores=share * sums.scores,
            information=share * sums.information + (1.0 - share) * np.diag(known.information),
            right=share * sums.right + (1.0 - share) * of_prior,
            squares=share * sums.squares + (1.0 - share) * float(of_prior @ known.mean),
        )
        spectra = np.zeros((1, 0)) if self.markings is None else self.markings.spectra
        log_prior = 0.5 * float(np.sum(np.log(known.information[known.information > 0.0])))
        return tempered.log_evidence(spectra, parts) + log_prior

    def odds_of(self, blocks: Sequence[Block], parts: float) -> float:
        """Return the logarithm of the odds of the model with further blocks against the one without.

        ``parts`` as for :meth:`log_evidence`.
        """
        return self.extend(blocks).log_evidence(parts) - self.log_evidence(parts)

    def propagate(self, scatter: Float) -> Float:
        """Return the covariance (k, k) of the unknowns from the covariance of their scores."""
        inverse = np.linalg.inv(self.information)
        return np.asarray(inverse @ scatter @ inverse)

    def gain(self, first: str, last: str) -> Float:
        """Return the change (j, ...) of the unknowns from one effect to another with the data."""
        some = np.linalg.inv(self.information)[self.layout.span(first, last)]
        return np.asarray((some @ (self.rows * self.weights.ravel())).reshape(-1, *self.data.shape))

    def consider(self, block: Block) -> Float:
        """Return the covariance (k, k) of the unknowns by a block that is not estimated (consider covariance).

        With the gain ``G`` of the unknowns by the data it is ``G A P A^T G^T``.
        """
        errors = (block.matrix.T * block.prior.information**-0.5).T
        scores = self.rows @ (self.weights * errors).reshape(len(errors), -1).T
        return self.propagate(scores @ scores.T)


@dataclass(frozen=True, eq=False)
class Solution(Value):
    """Least-squares solution of a linear model."""

    columns: Columns
    values: Float  # (k,)

    @cached_property
    def model(self) -> Float:
        """Data (...) by the model."""
        return np.asarray(np.tensordot(self.values, self.columns.matrix, 1) + self.marks)

    @cached_property
    def modes(self) -> Float:
        """Coefficients (m,) of the field; none without one."""
        solved = self.columns.eliminated
        return np.zeros(0) if solved is None else np.asarray(solved.own - solved.steps @ self.values)

    @cached_property
    def marks(self) -> Float:
        """Data (...) by the field."""
        markings = self.columns.markings
        return np.zeros_like(self.columns.data) if markings is None else markings.image(self.modes)

    @property
    def penalized_squares(self) -> float:
        """Squared residuals and squared unknowns, each divided by its variance, which the solution minimizes."""
        columns, prior = self.columns, self.columns.prior
        squares = float(np.sum(columns.weights * self.residuals**2))
        squares += float(prior.information @ (self.values - prior.mean) ** 2)
        return squares + self.mode_squares

    @property
    def mode_squares(self) -> float:
        """Squared modes of the field divided by their variances."""
        variances = self.columns.mode_variances
        if variances is None:
            return 0.0
        free = variances > 0.0
        return float(np.sum(self.modes[free] ** 2 / variances[free]))

    @cached_property
    def residuals(self) -> Float:
        """Data minus model (...)."""
        return np.asarray(self.columns.data - self.model)

    def __getitem__(self, effect: str) -> Float:
        """Unknowns (j,) of an effect."""
        return self.values[self.columns.layout.span(effect)]

    def score_omitted(self, *blocks: Block) -> Score:
        r"""Return the joint score test of blocks that were left out of the model.

        With ``B`` the derivatives by their unknowns, ``A`` those of the model, ``W`` the weights, ``r`` the residuals
        and ``H`` the information of the model, the gradient is ``B^T W r`` and the information, by the Schur
        complement, ``B^T W B - B^T W A H^-1 A^T W B``. Both are exact at the solution, where the model's own gradient
        vanishes.
        """
        _, matrix, prior = _stack_blocks(blocks)
        weighted, markings = self.columns.weights * matrix, self.columns.markings
        flat = weighted.reshape(len(matrix), -1)
        own, shared = matrix.reshape(len(matrix), -1) @ flat.T, self.columns.rows @ flat.T
        if markings is not None and self.columns.eliminated is not None:
            own = own - self.columns.eliminated.find_lost_information(markings.products(weighted))
        return Score(self.columns, matrix, flat @ self.residuals.ravel(), shared, own, prior)


@dataclass(frozen=True, eq=False)
class Score(Value):
    """Score test of m unknowns that were left out of a model of k."""

    columns: Columns  # the model
    matrix: Float  # (m, ...); derivatives of the data by the unknowns that were left out
    gradient: Float  # (m,); of half the chi-square, with its sign reversed, by the unknowns where they are zero
    shared: Float  # (k, m); products of the derivatives by the unknowns of the model and by those left out, weighted
    own: Float  # (m, m); as above, among the unknowns left out
    prior: Prior  # of the unknowns left out

    @cached_property
    def moves(self) -> Float:
        """Change (k, m) of the unknowns of the model with those left out."""
        return np.asarray(-np.linalg.solve(self.columns.information, self.shared), dtype=np.float64)

    @cached_property
    def information(self) -> Float:
        """Information (m, m) of the data on the unknowns, with the unknowns of the model free."""
        return np.asarray(self.own + self.shared.T @ self.moves)

    @property
    def condition(self) -> float:
        """Condition number of the normal matrix of both together, scaled."""
        own = self.own + np.diag(self.prior.information)
        both = np.block([[self.columns.information, self.shared], [self.shared.T, own]])
        scale = np.sqrt(np.diag(both))
        return _condition(both / np.outer(scale, scale)) if scale.all() else np.inf

    @property
    def covariance(self) -> Float:
        """Covariance (m, m) of the unknowns."""
        return np.asarray(np.linalg.inv(self.information + np.diag(self.prior.information)), dtype=np.float64)

    @property
    def values(self) -> Float:
        """Unknowns (m,) with the block in the model."""
        return np.asarray(self.covariance @ self._pull)

    @property
    def step(self) -> Float:
        """Change (k,) of the unknowns of the model with the block in it."""
        return np.asarray(self.moves @ self.values)

    @property
    def chi_square(self) -> float:
        """Decrease of chi-square by the block; m on average for pure noise without a prior."""
        return float(self._pull @ self.values)

    @property
    def alone(self) -> tuple[Float, Float]:
        """Each unknown (m,) without the others and without prior, and its standard deviation (m,)."""
        information = np.maximum(np.diag(self.information), 1e-300)
        return self.gradient / information, np.asarray(information**-0.5, dtype=np.float64)

    @property
    def gain_alone(self) -> Float:
        """Change (m, ...) of each unknown with the data, without the others and without prior."""
        free = self.matrix + np.tensordot(self.moves.T, self.columns.matrix, 1)
        information = np.maximum(np.diag(self.information), 1e-300)
        return np.asarray((self.columns.weights * free).T / information).T

    def omission_covariance(self, chance: float) -> Float:
        """Return the covariance (k, k) of the unknowns of the model by effects of a given probability.

        It is the mean square of the change of the unknowns with the block in the model.
        """
        values = self.values
        return np.asarray(chance * self.moves @ (self.covariance + np.outer(values, values)) @ self.moves.T)

    @property
    def _pull(self) -> Float:
        """Gradient (m,), the prior included."""
        return self.gradient + self.prior.information * self.prior.mean


def _stack_blocks(blocks: Sequence[Block]) -> tuple[Layout, Float, Prior]:
    """Layout, derivatives (k, ...) and prior of the unknowns of blocks."""
    layout = Layout(tuple((block.effect, block.cause, len(block.matrix)) for block in blocks))
    prior = Prior(*(np.concatenate(part) for part in zip(*(block.prior.parts for block in blocks), strict=True)))
    matrix = blocks[0].matrix if len(blocks) == 1 else np.concatenate([block.matrix for block in blocks])
    return layout, matrix, prior


def _condition(scaled: Float) -> float:
    """Condition number of a scaled normal matrix; infinite where it is not finite."""
    return float(np.linalg.cond(scaled)) if np.isfinite(scaled).all() else np.inf


def chance_of_odds(log_odds: float, before: float = UNDECLARED) -> float:
    """Posterior probability of an effect from its log Bayes factor and its prior probability."""
    return float(0.5 * (1.0 + np.tanh(0.5 * (log_odds + np.log(before / (1.0 - before))))))


def when_seen(
    values: Float, covariance: Float, effect: slice, prior: Prior, before: float = UNDECLARED
) -> tuple[Float, Float]:
    """Average an estimate with and without an effect that an exact model does not need.

    ``values`` (k,) and ``covariance`` (k, k) are posterior to ``prior``, at whose mean the effect is absent. The Bayes
    factor is the ratio of the prior to the posterior density there, of Savage and Dickey.
    """
    own = covariance[effect, effect]
    if not own.size:
        return values, covariance
    off, gain = values[effect] - prior.mean[effect], np.linalg.solve(own, covariance[effect]).T
    log_odds = 0.5 * (off @ np.linalg.solve(own, off) + np.linalg.slogdet(own * prior.information[effect])[1])
    chance, moved = chance_of_odds(float(log_odds), before), gain @ off
    without = covariance - gain @ covariance[effect]
    both = chance * covariance + (1.0 - chance) * without + chance * (1.0 - chance) * np.outer(moved, moved)
    return values - (1.0 - chance) * moved, 0.5 * (both + both.T)


def split_noise(covariance: Float, layout: Layout, causes: Iterable[Cause]) -> dict[Cause, Float]:
    """Split a covariance from noise by the effects that cause it.

    ``covariance`` (k, k); returns dict of Cause to (k, k).
    """
    parts = dict[Cause, Float]()
    for cause in causes:
        group = layout.of_cause(cause)
        if len(group):
            inverse = np.linalg.pinv(covariance[np.ix_(group, group)], hermitian=True)
            parts[cause] = covariance[:, group] @ inverse @ covariance[group]
            covariance = covariance - parts[cause]
    return parts | {Cause.NOISE: covariance}
