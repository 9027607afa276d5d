"""Positions from lines of sight: exact without errors, as good as their covariance says with them, refused when bad."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

import giantlike as gl
from giantlike.camera_models import PinholeModel
from giantlike.catalogs import StarTable, apparent_directions
from giantlike.core.arrays import Float, unit
from giantlike.core.causes import Cause
from giantlike.core.detector import Detector
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Quality, Reason
from giantlike.core.time import time_from_et
from giantlike.core.units import ARCSEC_PER_RAD, AU_KM, RAD_PER_ARCSEC, RAD_PER_DEG
from giantlike.independent import apparent_geometry
from giantlike.io.camera_sip import camera_of_sip
from giantlike.processing import Detections, detect_sources
from giantlike.triangulation import (
    Sightline,
    StarEphemeris,
    TriangulatedPosition,
    TriangulationOptions,
    locate,
    sightline_of_fix,
    sightline_of_pixel,
    triangulate,
)
from giantlike.triangulation.positions import TriangulationMethod
from giantlike.triangulation.sightlines import without_aberration

METHODS = list(TriangulationMethod)
ET = 600_000_000.0
PLACE = np.array([0.4, -1.1, -0.5]) * AU_KM
VELOCITY = np.array([25.0, 9.0, 3.0])
SIGMA = 2.0 * RAD_PER_ARCSEC
ROUNDING_KM = 1e-3  # float64 over 1e9 km is 1e-7 km; light times that settle to 1e-12 of the range leave 1e-3 km


class _Moving:
    """A body on a straight line, for truth in closed form."""

    origin = "SOLAR SYSTEM BARYCENTER"

    def __init__(self, position_km: Float, velocity_km_s: Float) -> None:
        self.start, self.velocity = position_km, velocity_km_s

    def state(self, et: float) -> tuple[Float, Float]:
        return self.start + self.velocity * (et - ET), self.velocity

    def inertial_from_body(self, et: float) -> Rotation:
        return Rotation.identity()


BODIES = {
    "venus": _Moving(np.array([-0.6, 0.3, 0.2]) * AU_KM, np.array([-10.0, -33.0, -5.0])),
    "mars": _Moving(np.array([1.3, -0.5, -0.3]) * AU_KM, np.array([6.0, 23.0, 4.0])),
    "jupiter": _Moving(np.array([-4.0, 2.9, 1.3]) * AU_KM, np.array([-5.0, -10.0, 1.0])),
}


def _across(direction: Float) -> Float:
    """Covariance (3, 3) of a unit vector that is off by one unit along each axis across it."""
    return np.asarray(np.eye(3) - np.outer(direction, direction))


def _line(target: str, direction: Float, *, image: str = "a", et: float = ET, sigma: float = SIGMA) -> Sightline:
    return Sightline(
        target=target, image=image, et=et, direction_inertial=direction, covariance_rad2=sigma**2 * _across(direction)
    )


def _seen(targets: dict[str, _Moving], *, epochs: tuple[float, ...] = (0.0,)) -> list[Sightline]:
    """Lines as a moving camera sees moving bodies, from an independent computation with events of light."""
    lines = []
    for k, (name, body) in enumerate(targets.items()):
        et = ET + epochs[k % len(epochs)]
        place = PLACE + VELOCITY * (et - ET)
        direction, _ = apparent_geometry(lambda s, body=body: body.state(s)[0], place, VELOCITY, et)  # type: ignore[misc]
        lines.append(_line(name, unit(direction), image=f"image {et}", et=et))
    return lines


def _position(answer: TriangulatedPosition | gl.Failure) -> TriangulatedPosition:
    assert isinstance(answer, TriangulatedPosition), answer
    return answer


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("epochs", [(0.0,), (-40_000.0, 0.0, 80_000.0)])
def test_lines_without_errors_meet_where_the_moving_camera_is(
    method: TriangulationMethod, epochs: tuple[float, ...]
) -> None:
    lines = _seen(BODIES, epochs=epochs)
    fix = _position(locate(lines, BODIES, ET, velocity_km_s=VELOCITY, options=TriangulationOptions(method=method)))
    assert_allclose(fix.position_km, PLACE, rtol=0, atol=ROUNDING_KM)
    assert fix.et == ET


def test_light_time_and_aberration_left_out_would_be_seen() -> None:
    """The steps matter: each moves the position by a hundred times the tolerance above, and far more."""
    lines = _seen(BODIES)
    now = np.array([body.state(ET)[0] for body in BODIES.values()])
    without_light_time = _position(triangulate(without_aberration(lines, VELOCITY), now))
    assert np.linalg.norm(without_light_time.position_km - PLACE) > 1e3
    kept = [dataclasses.replace(line, aberration=False) for line in lines]
    with_aberration = _position(locate(kept, BODIES, ET, velocity_km_s=VELOCITY))
    assert np.linalg.norm(with_aberration.position_km - PLACE) > 1e3


def _measured(rng: np.random.Generator, attitude: Float, ephemeris: Float) -> tuple[list[Sightline], Float]:
    """Lines of two images with noise, one attitude error for each image, and places with one error for each target."""
    truths = {name: body.start for name, body in BODIES.items()} | {"moon": BODIES["mars"].start + 4e5}
    believed = {name: place + rng.multivariate_normal(np.zeros(3), ephemeris) for name, place in truths.items()}
    lines, places = [], []
    for image, names in (("a", ("venus", "mars", "moon")), ("b", ("jupiter", "mars"))):
        turn = Rotation.from_rotvec(rng.multivariate_normal(np.zeros(3), attitude))
        for name in names:
            true = unit(truths[name] - PLACE)
            sigma = SIGMA * (1.0 if name == "mars" else 3.0)
            seen = unit(true + _across(true) @ rng.normal(0.0, sigma, 3))
            lines.append(
                dataclasses.replace(
                    _line(name, unit(rotate(turn, seen)), image=image, sigma=sigma),
                    covariance_attitude_rad2=attitude,
                    aberration=False,
                )
            )
            places.append(believed[name])
    return lines, np.array(places)


ATTITUDE = (5.0 * RAD_PER_ARCSEC) ** 2 * np.diag([1.0, 1.0, 9.0])
EPHEMERIS = 1500.0**2 * np.array([[1.0, 0.3, 0.0], [0.3, 2.0, 0.0], [0.0, 0.0, 0.5]])


def _nees(method: TriangulationMethod, runs: int, *, declared: bool = True) -> Float:
    rng = np.random.default_rng(20261122)
    squares = []
    for _ in range(runs):
        lines, places = _measured(rng, ATTITUDE, EPHEMERIS)
        if not declared:
            lines = [dataclasses.replace(line, covariance_attitude_rad2=np.zeros((3, 3))) for line in lines]
        known = {line.target: EPHEMERIS for line in lines} if declared else {}
        fix = _position(
            triangulate(lines, places, ephemeris_covariances_km2=known, options=TriangulationOptions(method=method))
        )
        error = fix.position_km - PLACE
        squares.append(float(error @ np.linalg.solve(fix.covariance_km2, error)))
    return np.array(squares)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.monte_carlo(few=60, full=300)
def test_errors_are_as_large_as_the_covariance_says(method: TriangulationMethod, draws: int) -> None:
    squares = _nees(method, draws)
    low, high = (float(chi2.ppf(share, 3 * draws)) for share in (1e-4, 1.0 - 1e-4))
    assert low < squares.sum() < high
    # Gate on the tail as well: 1 % of the draws lie beyond the 99 % quantile, give or take.
    assert np.sum(squares > chi2.ppf(0.99, 3)) <= binom.ppf(1.0 - 5e-4, draws, 0.01)


def test_attitude_and_ephemeris_left_out_of_the_covariance_would_be_seen() -> None:
    assert _nees(TriangulationMethod.LOST, 50, declared=False).mean() > 6.0


def test_the_parts_of_the_covariance_sum_and_come_from_where_they_should() -> None:
    lines, places = _measured(np.random.default_rng(1), ATTITUDE, EPHEMERIS)
    fix = _position(triangulate(lines, places, ephemeris_covariances_km2={"mars": EPHEMERIS}))
    assert_allclose(np.sum(list(fix.parts.values()), axis=0), fix.covariance_km2, rtol=1e-9, atol=0)
    assert set(fix.parts) == {Cause.NOISE, Cause.ATTITUDE, Cause.EPHEMERIS}
    assert all(np.trace(part) > 0 for part in fix.parts.values())
    assert fix.degrees_of_freedom == 7


def test_the_linear_method_is_as_good_as_the_iterative_one() -> None:
    """LOST is optimal to first order: both answers differ by a small part of a sigma."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        lines, places = _measured(rng, ATTITUDE, EPHEMERIS)
        both = [_position(triangulate(lines, places, options=TriangulationOptions(method=m))) for m in METHODS]
        apart = both[0].position_km - both[1].position_km
        assert apart @ np.linalg.solve(both[1].covariance_km2, apart) < 0.02**2


def test_three_lines_of_one_image_take_out_a_shared_turn() -> None:
    """Differences of directions do not feel the attitude: a large error of it costs less than noise times geometry."""
    names = ("mars", "venus", "jupiter")
    places = np.array([BODIES[name].start for name in names])
    turn = Rotation.from_rotvec(np.array([2.0, -3.0, 1.0]) * 60.0 * RAD_PER_ARCSEC)
    lines = [
        dataclasses.replace(
            _line(name, unit(rotate(turn, unit(place - PLACE)))),
            covariance_attitude_rad2=np.eye(3) * (300.0 * RAD_PER_ARCSEC) ** 2,
            aberration=False,
        )
        for name, place in zip(names, places, strict=True)
    ]
    declared = _position(triangulate(lines, places))
    ignored = _position(
        triangulate([dataclasses.replace(line, covariance_attitude_rad2=np.zeros((3, 3))) for line in lines], places)
    )
    assert np.linalg.norm(declared.position_km - PLACE) < 0.01 * np.linalg.norm(ignored.position_km - PLACE)
    assert Quality.LARGE_RESIDUALS in ignored.flags
    assert Quality.LARGE_RESIDUALS not in declared.flags


def _still(target: str, place: Float, observer: Float = PLACE) -> Sightline:
    return dataclasses.replace(_line(target, unit(place - observer)), aberration=False)


def test_geometry_that_gives_no_position_is_refused() -> None:
    mars = BODIES["mars"].start
    beyond = PLACE + 3.0 * (mars - PLACE)
    cases = [
        ([_still("mars", mars), _still("beyond", beyond)], [mars, beyond], "parallel"),
        ([_still("mars", mars), _still("mars", mars)], [mars, mars], "parallel"),
        # Two moons of one planet, two sigmas of an angle apart: the range is not known.
        ([_still("mars", mars), _still("moon", mars + 4e3)], [mars, mars + 4e3], "known to"),
        # Two bodies taken for each other.
        (
            [_still("a", BODIES["venus"].start), _still("b", mars)],
            [2 * PLACE - BODIES["venus"].start, 2 * PLACE - mars],
            "behind",
        ),
    ]
    for lines, places, text in cases:
        for method in METHODS:
            answer = triangulate(lines, np.array(places), options=TriangulationOptions(method=method))
            assert isinstance(answer, gl.Failure)
            assert answer.reason is Reason.DEGENERATE_GEOMETRY
            assert text in answer.detail


def test_misuse_is_refused_with_what_to_do() -> None:
    mars, venus = BODIES["mars"].start, BODIES["venus"].start
    good = [_still("mars", mars), _still("venus", venus)]
    with pytest.raises(InputError, match="at least two lines"):
        triangulate(good[:1], [mars])
    with pytest.raises(InputError, match="take stellar aberration out first, it is in the lines to mars"):
        triangulate([dataclasses.replace(good[0], aberration=True), good[1]], [mars, venus])
    with pytest.raises(InputError, match="positions_km must have shape"):
        triangulate(good, [mars])
    with pytest.raises(InputError, match="no line goes to: moon"):
        triangulate(good, [mars, venus], ephemeris_covariances_km2={"moon": EPHEMERIS})
    with pytest.raises(InputError, match="needs a covariance above zero"):
        triangulate([dataclasses.replace(good[0], covariance_rad2=np.zeros((3, 3))), good[1]], [mars, venus])
    with pytest.raises(InputError, match="no ephemeris of venus; there are mars"):
        locate(good, {"mars": BODIES["mars"]}, ET, velocity_km_s=VELOCITY)


# from images --------------------------------------------------------------------------------------------------

CAMERA = gl.Camera(
    name="wide", columns=1000, rows=800, model=PinholeModel(fx_px=1500.0, fy_px=1480.0, cx_px=499.5, cy_px=399.5)
)


def _image(**changes: object) -> gl.Image:
    image = gl.Image(
        pixels=np.zeros((800, 1000)),
        name="frame",
        epoch=time_from_et(ET),
        camera_from_inertial=Rotation.from_rotvec([0.4, -1.1, 0.2]),
        attitude_covariance_rad2=np.diag([1.0, 4.0, 100.0]) * 1e-12,
    )
    return dataclasses.replace(image, **changes)  # type: ignore[arg-type]


def test_a_pixel_becomes_a_line_with_the_covariance_of_its_errors() -> None:
    image, center, spread = _image(), np.array([820.0, 130.0]), np.array([[0.04, 0.01], [0.01, 0.02]])
    line = sightline_of_pixel("mars", center, spread, image, CAMERA)
    assert isinstance(line, Sightline)
    rng = np.random.default_rng(5)
    centers = rng.multivariate_normal(center, spread, 4000)
    assert image.camera_from_inertial is not None
    seen = rotate(image.camera_from_inertial.inv(), unit(CAMERA.model.unproject(centers)))
    assert_allclose(np.cov(seen.T), line.covariance_rad2, rtol=0, atol=0.08 * np.max(line.covariance_rad2))
    assert_allclose(line.covariance_rad2 @ line.direction_inertial, 0.0, atol=1e-20)
    assert image.attitude_covariance_rad2 is not None
    errors = rng.multivariate_normal(np.zeros(3), image.attitude_covariance_rad2, 4000)
    true = (Rotation.from_rotvec(errors) * image.camera_from_inertial).inv()
    moved = rotate(true, np.repeat(unit(CAMERA.model.unproject(center))[None], 4000, axis=0))
    turn = np.cross(np.eye(3), line.direction_inertial)  # e x direction, by column of e
    assert_allclose(
        np.cov(moved.T), turn.T @ line.covariance_attitude_rad2 @ turn, rtol=0, atol=0.1 * np.max(np.cov(moved.T))
    )


def test_an_image_without_attitude_or_epoch_gives_no_line() -> None:
    place, spread = [100.0, 100.0], np.eye(2)
    for changes, reason in (
        ({"camera_from_inertial": None}, Reason.NO_ATTITUDE),
        ({"epoch": None}, Reason.NO_EPOCH),
    ):
        answer = sightline_of_pixel("mars", place, spread, _image(**changes), CAMERA)
        assert isinstance(answer, gl.Failure)
        assert answer.reason is reason
    fix = gl.CenterFix(
        estimator="unresolved",
        target="mars",
        center_px=np.array(place),
        covariance_px2=spread,
        predicted_px=np.array(place),
        residuals=np.zeros(1),
        n_used=1,
        n_rejected=0,
        score=1.0,
        parts={Cause.NOISE: spread, Cause.CAMERA: 3.0 * spread},
    )
    line = sightline_of_fix(fix, _image(), CAMERA)
    alone = sightline_of_pixel("mars", place, 4.0 * spread, _image(), CAMERA)
    assert isinstance(line, Sightline)
    assert isinstance(alone, Sightline)
    assert_allclose(line.covariance_rad2, alone.covariance_rad2, rtol=1e-12)


# stars --------------------------------------------------------------------------------------------------------


def _star(row: dict[str, str]) -> StarTable:
    columns = (
        "ra_deg",
        "dec_deg",
        "pm_ra_mas_yr",
        "pm_dec_mas_yr",
        "parallax_mas",
        "radial_velocity_km_s",
        "epoch_jyear",
    )
    return StarTable(
        ids=np.array([1]),
        **{name: np.array([float(row[name])]) for name in columns},
        magnitude=np.array([10.0]),
        color_bv=np.array([np.nan]),
        sigma_mas=np.array([0.1]),
        sigma_pm_mas_yr=np.array([0.1]),
    )


BARNARD = {
    "ra_deg": "269.4485", "dec_deg": "4.7394", "pm_ra_mas_yr": "-801.6", "pm_dec_mas_yr": "10362.4",
    "parallax_mas": "546.98", "radial_velocity_km_s": "-110.5", "epoch_jyear": "2016.0",
}  # fmt: skip


def test_a_star_is_seen_from_afar_where_its_catalog_puts_it() -> None:
    """Against the star catalog's own computation, which follows ERFA: the fastest star, from 100 au, over a decade."""
    star = _star(BARNARD)
    ephemeris = StarEphemeris(star)
    observer = np.array([60.0, -70.0, 40.0]) * AU_KM
    for et in (5.1e8, 8.2e8):
        direction, _ = apparent_geometry(lambda s: ephemeris.state(s)[0], observer, np.zeros(3), et)
        expected = apparent_directions(star, et, observer_position_km=observer)[0]
        assert np.linalg.norm(direction - expected) < 1e-3 * RAD_PER_ARCSEC


def test_a_star_without_parallax_is_no_place() -> None:
    with pytest.raises(InputError, match="parallax above zero"):
        StarEphemeris(_star({**BARNARD, "parallax_mas": "0"}))


PUBLISHED_ERROR_AU = 0.44
"""Of the position of New Horizons by its two stars (data README); header vectors of the spacecraft are the truth."""


@pytest.mark.slow
@pytest.mark.real_data
def test_new_horizons_finds_itself_by_two_stars_as_well_as_published(data_dir: Path) -> None:
    """Our centroids; attitude by the world coordinates of the headers, which are a fit to Gaia stars of the field."""
    folder = data_dir / "stars"
    with (folder / "lorri_stars.csv").open() as table:
        ephemerides = {row["name"]: StarEphemeris(_star(row)) for row in csv.DictReader(table)}
    with (folder / "lorri_measured.csv").open() as table:
        rows = list(csv.DictReader(table))
    lines, observers = [], []
    for row in rows:
        image = gl.Image.open(folder / row["file"], bottom_up=True)
        header = image.metadata
        solved = camera_of_sip(header, columns=256, rows=256)
        camera = gl.Camera(name="lorri", columns=256, rows=256, model=solved.camera.model)
        sources = detect_sources(image.pixels, detector=Detector(), mask=image.mask)
        assert isinstance(sources, Detections)
        published = np.array([float(row["x_px"]), 255.0 - float(row["y_px"])])
        nearest = int(np.argmin(np.linalg.norm(sources.points_px - published, axis=1)))
        floor_px = float(header["RMS"]) / np.sqrt(2.0)  # per axis: what the stars of the field scatter by
        east, north, turn = (float(header[key]) * RAD_PER_DEG for key in ("SDRA", "SDDEC", "SDTHETA"))
        covariance = np.diag([north, east, turn]) ** 2
        line = sightline_of_pixel(
            row["star"],
            sources.points_px[nearest],
            sources.covariance_px2[nearest] + floor_px**2 * np.eye(2),
            image.with_attitude(solved.camera_from_inertial, covariance_rad2=covariance),
            camera,
        )
        assert isinstance(line, Sightline)
        # The stars that the world coordinates were fitted to were taken without aberration, so it is out already.
        lines.append(dataclasses.replace(line, aberration=False))
        observers.append(image.observer)
    truth = observers[0]
    assert truth is not None
    for method in METHODS:
        fix = _position(
            locate(
                lines,
                ephemerides,
                lines[0].et,
                velocity_km_s=truth.velocity_km_s,
                options=TriangulationOptions(method=method),
            )
        )
        error = fix.position_km - truth.position_km
        assert np.linalg.norm(error) < PUBLISHED_ERROR_AU * AU_KM
        assert error @ np.linalg.solve(fix.covariance_km2, error) < chi2.ppf(0.99, 3)
        assert np.sqrt(np.trace(fix.covariance_km2)) < 1.0 * AU_KM
        assert np.max(np.abs(fix.residuals_rad)) * ARCSEC_PER_RAD < 1.0
        assert fix.flags is Quality.NONE
