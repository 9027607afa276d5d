"""Zero points from fluxes of catalog stars: errors that hold on independent star fields, and what stars cannot tell."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import giantlike as gl
from benchmarks.zero_point_truth import field, star_table
from giantlike.calibration.observability import ParameterVerdict
from giantlike.photometry import Fluxes, ZeroPoint, ZeroPointOptions, fit_zero_point

TRUTH = np.array([16.0, 0.08, -0.3])


def fluxes_of(
    magnitude: np.ndarray, color: np.ndarray, seed: int, *, shift: float = 0.0, scatter: float = 0.02
) -> Fluxes:
    """Fluxes without an image: known noise, stars of 0 to 3 degrees off the axis."""
    random, count = np.random.default_rng(seed), len(magnitude)
    angle = np.radians(3.0) * np.sqrt(random.uniform(0.0, 1.0, count))
    bright = TRUTH[0] + shift + TRUTH[1] * (color - 1.0) + TRUTH[2] * (angle / np.radians(3.0)) ** 2
    expected = 10.0 ** (0.4 * (bright - magnitude + random.normal(0.0, scatter, count))) / 2.0
    variance = 20.0**2 + expected / 2.0
    return Fluxes(
        points_px=np.zeros((count, 2)), flux_dn=expected + random.normal(0.0, np.sqrt(variance)),
        noise_covariance_dn2=np.diag(variance), shot_dn=np.full(count, 0.5), level_dn=np.zeros(count),
        flags=np.zeros(count, np.uint16), angle_rad=angle, width_px=0.8, growth=1.0, growth_sigma=0.0,
        exposure_s=1.0, gain_e_per_dn=2.0, half_diagonal_deg=3.0, name="a.fits",
    )  # fmt: skip


def fitted(*arguments: object) -> ZeroPoint:
    answer = fit_zero_point(*arguments)  # type: ignore[arg-type]
    assert isinstance(answer, ZeroPoint), answer
    return answer


def drawn(count: int, seed: int, faintest: float = 11.0) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng([7, seed])
    return random.uniform(6.0, faintest, count), np.clip(random.normal(1.0, 0.4, count), -0.2, 2.5)


def test_errors_of_zero_color_and_field_hold_also_where_most_stars_are_lost_in_noise() -> None:
    """Stars down to a tenth of the noise enter as they are: no bias by those that noise lifts above a threshold."""
    nees, scaled = [], []
    for seed in range(60):
        magnitude, color = drawn(80, seed, faintest=15.5)
        answer = fitted([fluxes_of(magnitude, color, seed)], star_table(magnitude, color))
        one = answer.photometry
        error = np.array([answer.value_mag, one.color_term, one.field_term_mag]) - TRUTH
        nees.append(error @ np.linalg.solve(answer.covariance_mag2, error) / 3.0)
        scaled.append(error / np.sqrt(answer.covariance_mag2.diagonal()))
    assert 0.75 < np.mean(nees) < 1.3
    assert (np.abs(np.mean(scaled, axis=0)) < 3.0 / math.sqrt(60)).all()


def test_errors_hold_on_independent_images_with_blends_wings_and_a_catalog_limit() -> None:
    nees = []
    for seed in range(12):
        answer, truth = field(seed)
        assert isinstance(answer, ZeroPoint)
        one = answer.photometry
        error = np.array([answer.value_mag, one.color_term, one.field_term_mag]) - truth
        nees.append(error @ np.linalg.solve(answer.covariance_mag2, error) / 3.0)
    assert 0.4 < np.mean(nees) < 1.75  # chi-square of 36, 99.9 %


def test_variable_stars_are_left_out_on_both_sides() -> None:
    magnitude, color = drawn(60, 1)
    fluxes = fluxes_of(magnitude, color, 1)
    flux = fluxes.flux_dn.copy()
    flux[:3] *= [3.0, 0.2, 2.0]
    answer = fitted([dataclasses.replace(fluxes, flux_dn=flux)], star_table(magnitude, color))
    assert answer.n_rejected >= 3
    assert not answer.used[0][:3].any()
    assert abs(answer.value_mag - TRUTH[0]) < 4.0 * math.sqrt(answer.covariance_mag2[0, 0])
    assert abs(answer.photometry.scatter_mag - 0.02) < 0.01


def test_stars_of_one_color_give_no_color_term_and_say_so() -> None:
    magnitude, _ = drawn(60, 2)
    color = np.full(60, 1.4)
    answer = fitted([fluxes_of(magnitude, color, 2)], star_table(magnitude, color))
    assert answer.supported["color_term"] is ParameterVerdict.PRIOR_ONLY
    assert answer.supported["field_term_mag"] is ParameterVerdict.SUPPORTED
    assert "no color term" in answer.notes[0]
    assert abs(answer.photometry.color_term) < 0.02
    assert float(answer.photometry.sigma_mag(color_bp_rp=1.4)) < 0.02
    assert float(answer.photometry.sigma_mag(color_bp_rp=0.8)) > 0.2  # what a star of another color may differ by
    plain = fitted(
        [fluxes_of(magnitude, color, 2)], star_table(magnitude, color), ZeroPointOptions(color=None, field=False)
    )
    assert set(plain.supported) == {"zero_point"}
    assert_allclose(plain.covariance_mag2[1:], 0.0, atol=1e-12)


def test_images_of_different_air_share_color_and_field_and_differ_in_their_zero_points() -> None:
    stars = [drawn(100, seed) for seed in range(4)]
    shifts = (0.0, 0.02, 0.20, 0.22)
    fluxes = [fluxes_of(*each, seed, shift=shift) for seed, (each, shift) in enumerate(zip(stars, shifts, strict=True))]
    answer = fitted(fluxes, [star_table(*each) for each in stars])
    sigma = np.sqrt(answer.covariance_images_mag2.diagonal())
    assert (np.abs(answer.images_mag - TRUTH[0] - shifts) < 4.0 * sigma[:4]).all()
    assert 0.08 < math.sqrt(answer.covariance_mag2[0, 0]) < 0.25  # for another image: the scatter of these


def test_a_zero_point_goes_through_json_and_a_camera_file(tmp_path: Path) -> None:
    magnitude, color = drawn(60, 3)
    answer = fitted([fluxes_of(magnitude, color, 3)], star_table(magnitude, color))
    assert answer.to_mapping()["photometry"] == answer.photometry.to_mapping()
    camera = dataclasses.replace(gl.Camera.from_fov(5.0, 64, 64), photometry=answer.photometry)
    camera.save(tmp_path / "camera.toml")
    again = gl.Camera.load(tmp_path / "camera.toml").photometry
    assert again is not None
    assert again.to_mapping() == answer.photometry.to_mapping()


def test_a_fit_that_still_moves_by_a_tenth_of_its_sigma_has_not_converged() -> None:
    """Eight stars whose scatter shrinks round by round: after all rounds zero point and scatter move by 4 mmag."""
    magnitude, color = drawn(8, 42, faintest=13.0)
    moving = fit_zero_point([fluxes_of(magnitude, color, 42, scatter=0.3)], star_table(magnitude, color))
    assert isinstance(moving, gl.Failure)
    assert moving.reason is gl.Reason.NOT_CONVERGED


def test_too_few_stars_no_light_and_wrong_tables_are_told() -> None:
    magnitude, color = drawn(5, 4)
    fluxes = fluxes_of(magnitude, color, 4)
    few = fit_zero_point([fluxes], star_table(magnitude, color))
    assert isinstance(few, gl.Failure)
    assert few.reason is gl.Reason.TOO_FEW_MATCHES
    dark = dataclasses.replace(fluxes, flux_dn=-np.abs(fluxes.flux_dn))
    none = fit_zero_point([dark], star_table(magnitude, color), ZeroPointOptions(min_stars=3))
    assert isinstance(none, gl.Failure)
    assert none.reason is gl.Reason.NO_SIGNAL
    for tables, message in (
        (star_table(magnitude[:4], color[:4]), "a.fits: 5 fluxes need as many stars, got 4"),
        ([], "1 tables are needed"),
        (star_table(np.full(5, np.nan), color), "a star has no magnitude"),
    ):
        with pytest.raises(gl.InputError, match=message):
            fit_zero_point([fluxes], tables)
    with pytest.raises(gl.InputError, match="min_stars"):
        ZeroPointOptions(min_stars=2)
