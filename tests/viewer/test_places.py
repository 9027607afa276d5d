"""Every layer of an image against the truth: what would be drawn a pixel off fails here, and in the browser test."""

import base64
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from giantlike.campaign.file.config import Campaign
from giantlike.catalogs import apparent_directions, proper_names
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.plotting.residuals import correlation_surface_figure
from giantlike.processing.correlate import find_peak
from giantlike.viewer import Session, layers_of
from giantlike.viewer.answers import Answers
from giantlike.viewer.charts import correlation_chart, residual_chart
from giantlike.viewer.comparison import limb_residuals, match_of
from giantlike.viewer.planes import backplanes_of
from giantlike.viewer.session import SeenImage
from tests.campaign_files import APRIORI_OFFSET_KM, BODY_TURN, CAMERA, OBSERVER, RADII_KM, Truth, sky
from tests.viewer.conftest import SPECKLED_PX, Made, RockRun

SHORT, LONG = "visit0_b_short.fits", "visit0_a_long.fits"
STAR_PX = 0.3  # of single stars, the faintest of which have a sigma of 0.1 px
PREDICTED_PX = 0.05  # of what follows from the attitude alone
FIX_PX = 0.3  # of outlines at a fix
LIMB_PX = 0.6  # of single limb points
LANDMARK_PX = 0.5  # of single ones, which scatter by 0.14 px: facets of this shape are 2 px wide
PATCH_PX = 25  # a landmark is that wide: noise beside its place hides it too


@pytest.fixture(scope="module")
def session(made: Made) -> Session:
    return Session(Campaign.load(made[0]).output)


@pytest.fixture(scope="module")
def short(session: Session) -> SeenImage:
    return session.seen(SHORT)


@pytest.fixture(scope="module")
def truth(made: Made) -> Truth:
    return made[1][SHORT]


def outside_px(points: Float, position_camera_km: Float) -> Float:
    """Distances (n,) of points from the outline of the ellipsoid at a position, positive outside, to first order.

    A ray d from the camera touches the ellipsoid x A x = 1 at c where (c A d)^2 = (d A d) (c A c - 1).
    """
    turn = BODY_TURN.as_matrix()
    matrix = turn @ np.diag(1.0 / np.array(RADII_KM) ** 2) @ turn.T

    def excess(at: Float) -> Float:
        rays = CAMERA.model.unproject(at)
        across = np.einsum("ni,ij,nj->n", rays, matrix, rays)
        value: Float = across * (position_camera_km @ matrix @ position_camera_km - 1.0)
        return value - (rays @ matrix @ position_camera_km) ** 2

    step = 0.01
    slope = np.stack([(excess(points + e) - excess(points - e)) / (2.0 * step) for e in step * np.eye(2)], axis=1)
    distance: Float = excess(points) / np.linalg.norm(slope, axis=1)
    return distance


def points_of(seen: SeenImage, name: str) -> Float:
    return np.concatenate([layer.layer.points for layer in layers_of(seen, [name])])


def test_stars_detected_matched_and_of_the_catalog_are_where_the_sky_has_them(session: Session, made: Made) -> None:
    seen = session.seen(LONG)
    layers = {layer.name: layer for layer in layers_of(seen)}
    assert seen.record.epoch_utc is not None
    stars = sky().stars
    order = np.argsort(stars.ids)
    for name, off_px in (("catalog", PREDICTED_PX), ("matches", STAR_PX)):
        ids = np.array(layers[name].star_ids)
        known = stars.select(order[np.searchsorted(stars.ids, ids, sorter=order)])
        directions = apparent_directions(
            known,
            et_from_time(time_from_utc(seen.record.epoch_utc)),
            observer_position_km=OBSERVER.position_km,
            observer_velocity_km_s=OBSERVER.velocity_km_s,
        )
        truth_px = CAMERA.model.project(rotate(made[1][LONG].camera_from_inertial, directions))
        off = layers[name].layer.points - truth_px
        assert np.quantile(np.abs(off), 0.95) < off_px, "all but blends"
        assert np.abs(np.median(off, axis=0)).max() < PREDICTED_PX
        if name == "catalog":
            assert [label.split()[-1] for label in layers[name].names] == [f"({m:.1f})" for m in known.magnitude]
            assert np.all(np.diff(known.magnitude) >= 0.0), "the brightest are named first"
            proper = [(k, name) for k, name in enumerate(proper_names(known)) if name]
            assert proper
            assert all(layers[name].names[k].startswith(f"{called} (") for k, called in proper)
            assert all(layers[name].labels[k].startswith(f"{called}, {ids[k]} (") for k, called in proper)
    apart = layers["matches"].layer.points[:, None] - layers["detections"].layer.points
    assert np.linalg.norm(apart, axis=2).min(axis=1).max() < PREDICTED_PX, "each match is a detection"


def test_rejected_matches_are_crosses_where_they_were_seen(session: Session) -> None:
    seen = session.seen(LONG)
    thrown_out = [[37.25, 211.5], [250.0, 19.75]]
    stars = {**seen.points[seen.record.subject]["stars"], "rejected_px": thrown_out}
    (layer,) = layers_of(replace(seen, points={seen.record.subject: {"stars": stars}}), ["rejected"])
    assert layer.layer.points.tolist() == thrown_out


def test_outlines_predicted_and_fitted_and_limb_points_lie_on_the_body(short: SeenImage, truth: Truth) -> None:
    told = truth.position_camera_km + APRIORI_OFFSET_KM
    assert np.abs(outside_px(points_of(short, "predicted"), told)).max() < PREDICTED_PX
    assert np.abs(outside_px(points_of(short, "fitted"), truth.position_camera_km)).max() < FIX_PX
    limb = outside_px(points_of(short, "limb"), truth.position_camera_km)
    assert np.abs(limb).max() < LIMB_PX
    assert abs(np.median(limb)) < PREDICTED_PX


def test_the_ellipse_of_a_center_is_that_of_three_sigma(short: SeenImage) -> None:
    layers = {layer.title: layer.layer.points for layer in layers_of(short, ["centers"])}
    for fix in short.observations:
        off = layers[f"{fix.target}: {fix.estimator} ({fix.status}), 3 sigma"] - np.array(fix.center_px)
        squared = np.einsum("ni,ij,nj->n", off, np.linalg.inv(np.array(fix.covariance_px2)), off)
        np.testing.assert_allclose(squared, 9.0, rtol=1e-6)


def test_backplanes_show_the_body_in_the_pixels_that_see_it(session: Session, truth: Truth) -> None:
    planes = backplanes_of(session, SHORT)
    rows, columns = np.indices(planes.body.shape)
    off = outside_px(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float), truth.position_camera_km)
    clear = np.abs(off) > FIX_PX
    np.testing.assert_array_equal((planes.body.ravel() == 0)[clear], (off < 0.0)[clear])


def test_the_readout_is_of_the_pixel_under_the_pointer(session: Session, truth: Truth) -> None:
    answers = Answers(session)
    index, pixels, planes = session.files.index(SHORT), session.pixels(SHORT).pixels, backplanes_of(session, SHORT)
    column, row = np.rint(CAMERA.model.project(truth.position_camera_km)).astype(int) + np.array([9, -4])
    for x, y in ((column - 0.4, row - 0.4), (column + 0.4, row + 0.4)):
        seen = answers.pixel(index, str(x), str(y))
        assert seen["dn"] == float(pixels[row, column])
        assert seen["range"] == planes.range_km[row, column]
        assert np.radians(seen["longitude"]) == pytest.approx(planes.longitude_rad[row, column], abs=1e-12)
    assert len({float(pixels[row + dy, column + dx]) for dy in (-1, 0, 1) for dx in (-1, 0, 1)}) > 6


def test_template_and_difference_lie_on_the_image(session: Session) -> None:
    index, match = session.files.index(SHORT), match_of(session, SHORT, "PEBBLE")
    pictures = {
        kind: decoded(Answers(session).picture(index, kind, "linear", target="PEBBLE"))
        for kind in ("image", "template", "difference")
    }
    here = likeness(pictures["template"], pictures["image"])
    for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        assert likeness(np.roll(pictures["template"], shift, axis=(0, 1)), pictures["image"]) < here
    assert (
        likeness(pictures["difference"][match.region], match.difference_dn[match.region]) > 0.98
    )  # what is beyond the ends of the gray scale is cut


def test_the_residual_map_has_its_cells_where_the_image_differs(session: Session, short: SeenImage) -> None:
    fix = next(one for one in short.observations if short.points[one.subject]["residuals"]["cell_px"])
    kept = short.points[fix.subject]["residuals"]
    difference = match_of(session, SHORT, fix.target, fix.estimator).difference_dn
    at, cell = np.array(kept["at_px"]), float(kept["cell_px"])

    pixels = np.indices(difference.shape)[::-1].reshape(2, -1).T
    edge = at.min(axis=0) - cell / 2

    def mean_around(shift: tuple[float, float]) -> Float:
        """Mean of the difference over each cell, moved by so many cells."""
        wanted, found = (np.floor((each - edge) / cell - offset) for each, offset in ((at, (0, 0)), (pixels, shift)))
        inside = ((found >= 0) & (found < 99)).all(axis=1)
        number = (found[inside] @ [1, 99]).astype(int)
        sums, counts = (
            np.bincount(number, each, 99**2) for each in (difference.ravel()[inside], np.ones(inside.sum()))
        )
        means: Float = (sums / np.maximum(counts, 1))[(wanted @ [1, 99]).astype(int)]
        return means

    values = np.array(kept["values"])
    here = likeness(values, mean_around((0.0, 0.0)))
    assert here > 0.7
    for shift in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        assert likeness(values, mean_around(shift)) < 0.5 * here
    beside = [likeness(values, mean_around(shift)) for shift in ((0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4))]
    assert max(beside) < here, "a pixel off"

    svg = residual_chart(session, SHORT, fix.target, fix.estimator)
    found = re.search(r'<image y="0.0" width="([\d.]+)" height="([\d.]+)".*?base64,([^"]+)"', svg)
    assert found is not None
    picture = decoded(base64.b64decode(found[3]))
    redder = picture[..., 2].astype(float) - picture[..., 0]
    units = np.array([float(found[1]) / picture.shape[1], float(found[2]) / picture.shape[0]])
    ticks = re.findall(r'<text x="([\d.-]+)" y="([\d.]+)" text-anchor="(middle|end)">([\d.]+)</text>', svg)
    below = f"{float(found[2]) + 12.0:.1f}"
    along_x = np.array([(x, value) for x, y, anchor, value in ticks if y == below], dtype=float)
    along_y = np.array([(y, value) for _, y, anchor, value in ticks if anchor == "end"], dtype=float)
    column = on_axis(along_x, at[:, 0]) / units[0] - 0.5
    row = (on_axis(along_y, at[:, 1]) - 3.0) / units[1] - 0.5
    cells = np.rint([row, column]).astype(int)
    assert np.abs(cells - [row, column]).max() < 0.1
    assert likeness(redder[tuple(cells)], values) > 0.9  # beyond the ends of the scale colors are equal


def test_the_correlation_peaks_at_the_shift_that_brings_the_template_home(session: Session) -> None:
    match = match_of(session, SHORT, "PEBBLE")
    moved = replace(match.template, corner_px=match.template.corner_px + np.array([3, -2]))
    surface = replace(match, template=moved).correlation(half_px=6)
    peak = find_peak(surface)
    assert peak is not None
    np.testing.assert_allclose(peak.offset_px - 6.0, [-3.0, 2.0], rtol=0, atol=0.2)
    axis = correlation_surface_figure(surface, peak.offset_px - 6.0, "").axes[0]
    left, right, bottom, top = axis.images[0].get_extent()
    shown = np.asarray(axis.images[0].get_array())
    row, column = np.unravel_index(np.argmax(shown), shown.shape)
    x = left + (column + 0.5) / shown.shape[1] * (right - left)
    y = top + (row + 0.5) / shown.shape[0] * (bottom - top)
    np.testing.assert_allclose(np.asarray(axis.lines[-1].get_xydata())[0], [x, y], rtol=0, atol=0.5)
    title = re.search(r"peak at \(([+-][\d.]+), ([+-][\d.]+)\) px", correlation_chart(session, SHORT, "PEBBLE"))
    assert title is None or max(abs(float(number)) for number in title.groups()) < FIX_PX


def test_residuals_along_the_limb_turn_with_the_angle_as_a_shift_does(session: Session, short: SeenImage) -> None:
    fix = next(one for one in short.observations if one.estimator == "limb_matching")
    before = limb_residuals(session, SHORT, fix)
    assert fix.position_camera_km is not None
    assert fix.center_px is not None
    shift_px = np.array([0.6, 0.8])
    moved = CAMERA.model.unproject(np.array(fix.center_px) + shift_px)
    position = moved * fix.position_camera_km[2] / moved[2]
    after = limb_residuals(session, SHORT, fix.replace(position_camera_km=position.tolist()))
    angle = np.radians(before.angle_deg)
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    np.testing.assert_allclose(after.distance_px - before.distance_px, -outward @ shift_px, rtol=0, atol=0.3)


def test_landmarks_used_are_where_the_body_has_them_and_others_are_told_apart(rock: RockRun) -> None:
    seen = Session(rock.run).seen(rock.file)
    (used,) = layers_of(seen, ["landmarks"])
    (rejected,) = layers_of(seen, ["landmarks-rejected"])

    assert used.title == "BODY: landmarks of surface_features"
    assert [label.split(":")[0] for label in used.labels] == list(used.names)
    np.testing.assert_allclose(used.layer.points, rock.px(used.names), rtol=0, atol=LANDMARK_PX)
    (fix,) = seen.observations
    assert (len(used.names), len(rejected.names)) == (fix.n_used, fix.n_rejected)
    assert fix.n_rejected
    assert set(rejected.labels) == {f"{name}: not found" for name in rejected.names}
    assert not set(rejected.names) & set(used.names)
    assert (rejected.layer.shape, rejected.layer.color) != (used.layer.shape, used.layer.color)
    np.testing.assert_allclose(rejected.layer.points, rock.px(rejected.names), rtol=0, atol=LANDMARK_PX)
    for axis, (low, high) in enumerate(SPECKLED_PX):
        assert rejected.layer.points[:, axis].min() > low - PATCH_PX
        assert rejected.layer.points[:, axis].max() < high + PATCH_PX


def decoded(content: bytes) -> NDArray[np.uint8]:
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return np.asarray(picture, dtype=np.uint8)


def likeness(one: NDArray[np.generic], other: NDArray[np.generic]) -> float:
    return float(np.corrcoef(one.ravel().astype(float), other.ravel().astype(float))[0, 1])


def on_axis(ticks: Float, values: Float) -> Float:
    """Places of values on an axis that has numbers (n, 2) at places."""
    (start, low), (stop, high) = ticks[[0, -1]]
    places: Float = start + (values - low) * (stop - start) / (high - low)
    return places
