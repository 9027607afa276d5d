"""Linear looks at data beside dense least squares: solutions, elimination of blocks, and scores of omitted ones."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.image_model.columns import Block, Columns, Prior, Solution, Use, split_noise

SHAPE = (9, 11)
ROUNDING = 1e-9  # of values of the order of 1, from normal matrices whose condition numbers are below 1e6
CAUSES = (Cause.REFLECTANCE, Cause.PSF)


def block(
    effect: str, count: int, seed: int, *, sigma: float = np.inf, mean: float = 0.0, cause: Cause = Cause.NOISE
) -> Block:
    matrix = np.random.default_rng(seed).normal(size=(count, *SHAPE))
    return Block(effect=effect, cause=cause, matrix=matrix, prior=Prior.of_sigmas([sigma] * count, mean))


PLACE = block("place", 3, 1)
LAWS = block("laws", 2, 2, sigma=0.3, mean=0.2, cause=Cause.REFLECTANCE)
BLUR = block("blur", 1, 3, sigma=0.5, cause=Cause.PSF)


def data_and_weights() -> tuple[Float, Float]:
    """Data of the order of the unknowns, a part of it unused."""
    random = np.random.default_rng(7)
    return random.normal(size=SHAPE), random.uniform(0.5, 2.0, SHAPE) * (random.random(SHAPE) < 0.8)


def solved(*blocks: Block) -> Solution:
    found = Columns.from_blocks(blocks, *data_and_weights()).solve()
    assert found is not None
    return found


def dense(*blocks: Block) -> tuple[Float, float]:
    """Unknowns by a dense solver, each known beforehand a further equation; and the chi-square that is left."""
    data, weights = data_and_weights()
    root = np.sqrt(weights).ravel()
    rows = [root[:, None] * np.concatenate([b.matrix.reshape(len(b.matrix), -1) for b in blocks]).T]
    right = [root * data.ravel()]
    information = np.concatenate([b.prior.information for b in blocks])
    rows.append(np.diag(np.sqrt(information)))
    right.append(np.sqrt(information) * np.concatenate([b.prior.mean for b in blocks]))
    design, target = np.concatenate(rows), np.concatenate(right)
    values = np.linalg.lstsq(design, target, rcond=None)[0]
    return values, float(np.sum((target - design @ values) ** 2))


def test_a_solution_is_that_of_dense_least_squares_with_the_prior_as_equations() -> None:
    found = solved(PLACE, LAWS, BLUR)
    expected, _ = dense(PLACE, LAWS, BLUR)
    assert_allclose(found.values, expected, rtol=0, atol=ROUNDING)
    assert_allclose(found["laws"], expected[3:5], rtol=0, atol=ROUNDING)
    assert_allclose(found.columns["blur"], BLUR.matrix, rtol=0, atol=0)


def test_unknowns_that_data_do_not_determine_have_no_solution() -> None:
    assert Columns.from_blocks([PLACE, block("twin", 3, 1)], *data_and_weights()).solve() is None


def test_a_block_that_is_scored_moves_the_model_to_where_both_are_solved_together() -> None:
    """The Schur complement, with a prior mean on either side that is not zero."""
    without, both = solved(PLACE, LAWS), solved(PLACE, LAWS, BLUR)
    score = without.score_omitted(BLUR)
    assert_allclose(score.values, both["blur"], rtol=0, atol=ROUNDING)
    assert_allclose(without.values + score.step, both.values[:5], rtol=0, atol=ROUNDING)
    covariance = np.linalg.inv(both.columns.information)
    assert_allclose(score.covariance, covariance[5:, 5:], rtol=0, atol=ROUNDING)
    expected = np.linalg.inv(covariance[:5, :5])
    own = score.own + np.diag(BLUR.prior.information)
    eliminated = without.columns.information - score.shared @ np.linalg.solve(own, score.shared.T)
    assert_allclose(eliminated, expected, rtol=0, atol=ROUNDING * np.abs(expected).max())


@pytest.mark.parametrize("omitted", [(BLUR,), (LAWS,), (BLUR, block("strain", 3, 4))])
def test_the_score_of_omitted_blocks_is_the_chi_square_that_a_refit_with_them_gains(omitted: tuple[Block, ...]) -> None:
    score = solved(PLACE).score_omitted(*omitted)
    held = sum(float(np.sum(one.prior.information * one.prior.mean**2)) for one in omitted)  # unknowns held at zero
    gained = dense(PLACE)[1] + held - dense(PLACE, *omitted)[1]
    assert score.chi_square == pytest.approx(gained, abs=ROUNDING)


def test_the_score_of_each_unknown_alone_is_that_of_a_refit_with_it_alone() -> None:
    strain = block("strain", 3, 4)
    values, sigmas = solved(PLACE, LAWS).score_omitted(strain).alone
    for number in range(3):
        one = Block(
            effect="one", cause=Cause.NOISE, matrix=strain.matrix[number][None], prior=Prior.of_sigmas([np.inf])
        )
        both = solved(PLACE, LAWS, one)
        assert values[number] == pytest.approx(both["one"][0], abs=ROUNDING)
        assert sigmas[number] == pytest.approx(np.linalg.inv(both.columns.information)[-1, -1] ** 0.5, abs=ROUNDING)


def test_a_considered_block_makes_the_covariance_of_drawn_errors() -> None:
    """Each unknown at one sigma, through the solution: their outer products add up."""
    considered = block("altitude", 2, 5, sigma=0.7)
    data, weights = data_and_weights()
    moved = []
    for error in 0.7 * considered.matrix:
        one, other = (Columns.from_blocks([PLACE, LAWS], each, weights).solve() for each in (data + error, data))
        assert one is not None
        assert other is not None
        moved.append(one.values - other.values)
    found = Columns.from_blocks([PLACE, LAWS], data, weights).consider(considered)
    assert_allclose(found, sum(np.outer(one, one) for one in moved), rtol=0, atol=ROUNDING)


def test_parts_of_a_covariance_add_up_and_the_last_is_that_of_known_effects() -> None:
    found = solved(PLACE, LAWS, BLUR).columns
    covariance = np.asarray(np.linalg.inv(found.information), dtype=np.float64)
    parts = split_noise(covariance, found.layout, CAUSES)
    assert_allclose(sum(parts.values()), covariance, rtol=0, atol=ROUNDING)
    alone = np.linalg.inv(solved(PLACE).columns.information)
    place = found.layout.span("place")
    assert_allclose(parts[Cause.NOISE][place, place], alone, rtol=0, atol=ROUNDING)
    assert Use.FITTED is PLACE.use
