"""Campaign files: what is accepted, and the one line that says what is wrong."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from giantlike.atmosphere import Atmosphere
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.file.options import options_from_mapping
from giantlike.core.errors import DataError, InputError
from giantlike.presets import camera_preset
from giantlike.ray_tracing import Hapke, Lambert, LunarLambert, McEwen, Reflectance
from giantlike.shapes import Ellipsoid, TriangleMesh
from giantlike.stars.transfer import TransferMethod
from tests.campaign_files import CAMERA, RADII_KM, campaign_table

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
TEXT_KERNEL = "KPL/PCK\n\\begindata\nBODY999_RADII = ( 1 2 3 )\n\\begintext\n"


def write(folder: Path, table: dict[str, Any]) -> Path:
    """Write a campaign and everything that it names, none of it real images."""
    for name in ("images/a.fits", "images/b.fits"):
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"not read here")
    CAMERA.save(folder / "camera.toml")
    (folder / "rock.obj").write_text(TETRAHEDRON)
    (folder / "pck.tpc").write_text(TEXT_KERNEL)
    (folder / "geometry.csv").write_text(
        "file,target,target_x_km,target_y_km,target_z_km\na.fits,PEBBLE,0,0,30\nb.fits,PEBBLE,0,0,30\n"
    )
    path = folder / "campaign.toml"
    path.write_text(tomli_w.dumps(table))
    return path


def problem(folder: Path, change: Callable[[dict[str, Any]], Any]) -> str:
    """The error of a campaign file after a change, which must be one line that starts with the file."""
    table = campaign_table()
    change(table)
    path = write(folder, table)
    with pytest.raises(DataError) as caught:
        Campaign.load(path)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(str(path))
    return text.removeprefix(f"{path}: ")


def test_a_campaign_file_is_resolved_relative_to_itself(tmp_path: Path) -> None:
    table = campaign_table()
    table["stars"]["options"] = {"max_pixel_distance": 20.0}
    campaign = Campaign.load(write(tmp_path, table))
    assert campaign.output == tmp_path / "run"
    assert [image.key for image in campaign.images] == ["a.fits", "b.fits"]
    assert campaign.camera.to_mapping() == CAMERA.to_mapping()
    assert campaign.stars is not None
    assert campaign.stars.transfer.method is TransferMethod.INTERPOLATE
    assert campaign.stars.transfer.max_gap_s == math.inf
    assert campaign.stars.options.max_pixel_distance == 20.0
    assert campaign.stars.options.max_magnitude == 7.0
    (target,) = campaign.targets
    shape = target.load_shape()
    assert isinstance(shape, Ellipsoid)
    assert shape.radii_km.tolist() == list(RADII_KM)
    assert target.reflectance == McEwen()
    assert list(campaign.geometry) == ["a.fits", "b.fits"]
    assert campaign.warnings == ()


def test_infinity_is_a_number_where_one_is_expected(tmp_path: Path) -> None:
    table = campaign_table()
    table["stars"]["max_gap_s"] = math.inf
    campaign = Campaign.load(write(tmp_path, table))
    assert campaign.stars is not None
    assert campaign.stars.transfer.max_gap_s == math.inf


def test_only_campaign_images_and_camera_are_required(tmp_path: Path) -> None:
    table = campaign_table()
    smallest = {key: table[key] for key in ("campaign", "camera")} | {"images": {"files": ["images/*.fits"]}}
    campaign = Campaign.load(write(tmp_path, smallest))
    assert campaign.stars is None
    assert campaign.targets == ()
    assert not campaign.is_star_image(10.0)


def test_radii_of_a_planetary_constants_kernel_are_taken_by_name(tmp_path: Path) -> None:
    table = campaign_table()
    table["targets"][0] |= {"shape": {"radii": "pck"}, "spice_body": "999"}
    table["spice"] = {"kernels": ["pck.tpc"], "spacecraft": "-64"}
    (target,) = Campaign.load(write(tmp_path, table)).targets
    shape = target.load_shape()
    assert isinstance(shape, Ellipsoid)
    assert shape.radii_km.tolist() == [1.0, 2.0, 3.0]


def test_a_camera_may_be_a_preset_which_knows_the_order_of_its_rows(tmp_path: Path) -> None:
    table = campaign_table()
    table["camera"] = {"preset": "new_horizons_lorri"}
    campaign = Campaign.load(write(tmp_path, table))
    assert campaign.camera.name == "New Horizons LORRI"
    assert campaign.bottom_up
    table["camera"]["columns"] = 12
    with pytest.raises(DataError, match="give either preset, or file"):
        Campaign.load(write(tmp_path, table))


def test_uncertainties_of_targets_and_a_priori_attitudes_are_turned_into_radians(tmp_path: Path) -> None:
    table = campaign_table()
    table["images"]["attitude_sigma_deg"] = 0.5
    sigmas = {"scale": 1e-3, "pole_deg": 0.1, "spin_deg": 0.2, "ephemeris_km": 5.0, "albedo": 0.5}
    table["targets"][0]["uncertainty"] = sigmas
    campaign = Campaign.load(write(tmp_path, table))
    known = campaign.targets[0].uncertainty
    found = [known.scale, known.pole_rad, known.spin_rad, known.ephemeris_km, known.albedo]
    np.testing.assert_allclose(found, [1e-3, math.radians(0.1), math.radians(0.2), 5.0, 0.5], rtol=1e-12)
    covariance = campaign.apriori_covariance_rad2(campaign.images[0].key)
    assert covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), math.radians(0.5), rtol=1e-12)


def test_a_pole_may_be_unknown(tmp_path: Path) -> None:
    table = campaign_table()
    table["targets"][0] |= {"uncertainty": {"pole_deg": "unknown"}, "shape": {"radii_km": [1.0, 1.0, 0.9]}}
    known = Campaign.load(write(tmp_path, table)).targets[0].uncertainty
    assert known.pole_unknown
    assert known.pole_rad == 0.0


def test_rings_are_taken_from_a_name_or_from_radii(tmp_path: Path) -> None:
    table = campaign_table()
    for given, outer_km in (("SATURN", 140_600.0), ({"inner_km": 2, "outer_km": 3.5}, 3.5)):
        table["targets"][0]["rings"] = given
        rings = Campaign.load(write(tmp_path, table)).targets[0].limb.rings
        assert rings is not None
        assert rings.outer_km == outer_km


def test_a_height_map_is_found_and_opened_and_an_atmosphere_is_taken_from_its_name_or_numbers(tmp_path: Path) -> None:
    table = campaign_table()
    table["targets"][0] |= {"terrain": "map.npz", "terrain_sigma_km": 0.002}
    path = write(tmp_path, table)
    np.savez(tmp_path / "map.npz", heights_km=np.full((4, 8), 0.01), reference_radii_km=1.0)
    limb = Campaign.load(path).targets[0].limb
    opened = limb.height_map()
    assert opened is not None
    assert (opened.name, opened.sigma_km, limb.height_map() is opened) == ("map.npz", 0.002, True)
    del table["targets"][0]["terrain"]
    for given, altitude_km in (("MARS", 11.6), ({"altitude_km": 25.0, "sigma_km": 3.0}, 25.0)):
        table["targets"][0]["atmosphere"] = given
        known = Campaign.load(write(tmp_path, table)).targets[0].limb.atmosphere
        assert known is not None
        assert altitude_km in (known.scale_height_km, known.base_km)
    table["targets"][0]["atmosphere"] = {"scale_height_km": 8, "optical_depth": 0.1, "sigma_km": 8, "exponent": 4}
    full = Campaign.load(write(tmp_path, table)).targets[0].limb.atmosphere
    assert full == Atmosphere(scale_height_km=8.0, optical_depth=0.1, sigma_km=8.0, exponent=4.0)


@pytest.mark.parametrize(
    ("body", "air", "known", "airless"),
    [
        ("NEPTUNE", True, Atmosphere.of("NEPTUNE"), False),
        ("NEPTUNE", None, None, False),
        ("MOON", None, None, True),
        ("MOON", True, None, False),
        ("NEPTUNE", False, None, True),
    ],
)
def test_air_is_that_of_the_body_by_its_spice_name_where_the_file_does_not_say_more(
    tmp_path: Path, body: str, air: bool | None, known: Atmosphere | None, airless: bool
) -> None:
    table = campaign_table()
    table["targets"][0] |= {"spice_body": body} | ({} if air is None else {"air": air})
    limb = Campaign.load(write(tmp_path, table)).targets[0].limb
    assert limb.atmosphere == known
    assert (limb.air is False) == airless


def test_mesh_reflectance_and_estimator_options_are_taken_over(tmp_path: Path) -> None:
    table = campaign_table()
    table["targets"][0] |= {
        "shape": "rock.obj",
        "units": "m",
        "reflectance": {"model": "lambert"},
        "options": {"cross_correlation": {"search_px": 40}},
    }
    (target,) = Campaign.load(write(tmp_path, table)).targets
    shape = target.load_shape()
    assert isinstance(shape, TriangleMesh)
    assert shape.circumscribing_radius_km == 1e-3
    assert target.reflectance == Lambert()
    assert target.estimators[0].options.search_px == 40


def test_a_guessed_unit_is_a_warning_of_the_campaign(tmp_path: Path) -> None:
    table = campaign_table()
    table["targets"][0] |= {"shape": "rock.obj", "units": "auto"}
    campaign = Campaign.load(write(tmp_path, table))
    assert campaign.targets[0].units == "km"
    assert any("rock.obj: took the coordinates as km" in warning for warning in campaign.warnings)


@pytest.mark.parametrize(
    ("section", "law"),
    [
        (
            {"model": "hapke", "w": 0.1, "b0": 1, "h": 0.05, "theta_bar_deg": 20},
            Hapke(w=0.1, b0=1, h=0.05, theta_bar_deg=20),
        ),
        ({"model": "lunar_lambert", "weight": [1, -0.01]}, LunarLambert(weight=(1.0, -0.01))),
    ],
)
def test_a_reflectance_law_takes_its_parameters_from_the_file(
    tmp_path: Path, section: dict[str, Any], law: Reflectance
) -> None:
    table = campaign_table()
    table["targets"][0]["reflectance"] = section
    (target,) = Campaign.load(write(tmp_path, table)).targets
    assert target.reflectance == law


def test_a_camera_may_be_given_inline(tmp_path: Path) -> None:
    campaign = Campaign.load(write(tmp_path, campaign_table() | {"camera": CAMERA.to_mapping()}))
    assert campaign.camera_file is None
    assert campaign.camera.to_mapping() == CAMERA.to_mapping()


UNKNOWN_OR_MISSING: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda t: t.update(estimators=[]), "unknown key estimators; keys there are campaign, mission, images, camera"),
    (
        lambda t: t["images"].update(file="x"),
        "unknown key images.file .did you mean 'files'..; keys",
    ),
    (lambda t: t["stars"].update(max_magitude=9.0), "unknown key stars.max_magitude"),
    (
        lambda t: t["targets"][0].update(unit="km"),
        r"unknown key targets\[0\].unit .did you mean 'units'..; keys",
    ),
    (lambda t: t.pop("images"), "key images is missing"),
    (lambda t: t["campaign"].pop("output"), "key campaign.output is missing"),
    (lambda t: t.update(calibration={"estimate": []}), "calibration.estimate: must not be empty"),
    (
        lambda t: t.update(calibration={"estimate": ["f_px"]}),
        "calibration.estimate: a 'brown' model has no parameter 'f_px'",
    ),
    (lambda t: t.update(calibration={"estimate": ["fx_px"], "min_star": 1}), "unknown key calibration.min_star"),
]


@pytest.mark.parametrize(("change", "expected"), UNKNOWN_OR_MISSING)
def test_unknown_and_missing_keys_are_named(
    tmp_path: Path, change: Callable[[dict[str, Any]], Any], expected: str
) -> None:
    assert_matches(problem(tmp_path, change), expected)


WRONG_VALUES: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda t: t["stars"].update(max_magnitude="nine"), "stars.max_magnitude: expected a valid number, got 'nine'"),
    (lambda t: t["stars"].update(lost_in_space=1), "stars.lost_in_space: expected a valid boolean, got 1"),
    (lambda t: t["stars"].update(transfer="extrapolate"), "stars.transfer: expected 'replace', 'propagate' or"),
    (lambda t: t["stars"].update(max_gap_s=-1.0), r"\[stars\]: max_gap_s must be >= 0"),
    (lambda t: t["stars"].update(long_exposure_s=0.0), "stars.long_exposure_s: expected greater than 0"),
    (lambda t: t["stars"].update(options={"inlier": 1.0}), "stars.options: unknown option 'inlier'"),
    (lambda t: t["stars"].update(options={"seed": 1.5}), "stars.options.seed: expected a valid integer, got 1.5"),
    (lambda t: t["stars"].update(options={"min_matches": 1}), "stars.options: min_matches must be >= 3"),
    (lambda t: t["stars"].update(options={"lost_in_space": True}), "lost_in_space has a key of its own"),
    (lambda t: t["stars"].update(detection={"threshold_sigma": 0}), "stars.detection: threshold_sigma must be > 0"),
    (lambda t: t["images"].update(files=[]), r"images.files: must not be empty, got \[\]"),
    (lambda t: t["campaign"].update(output=""), "campaign.output: must not be empty, got ''"),
    (lambda t: t["images"].update(files="images/*.fits"), "images.files: expected a valid array, got 'images/"),
    (lambda t: t["images"].update(hdu=True), "images.hdu: expected a number or a name, got True"),
    (lambda t: t["targets"][0].update(estimators=["cross_corelation"]),
     r"targets\[0\].estimators: unknown estimator 'cross_corelation' .did you mean 'cross_correlation'"),
    (lambda t: t["targets"][0].update(options={"limb": {}}), r"targets\[0\].options: unknown estimator 'limb'"),
    (lambda t: t["targets"][0].update(options={"cross_correlation": {"serch_px": 4}}),
     r"targets\[0\].options.cross_correlation: unknown option 'serch_px' .did you mean 'search_px'..; options are"),
    (lambda t: t["targets"][0].update(options={"cross_correlation": {"search_px": "far"}}),
     r"targets\[0\].options.cross_correlation.search_px: expected a valid \w+, got 'far'"),
    (lambda t: t["targets"][0].update(options={"cross_correlation": {"search_px": -1}}),
     r"targets\[0\].options.cross_correlation: .*search_px"),
    (lambda t: t["targets"][0].update(estimators=["cross_correlation"], options={"limb_matching": {"bogus": 1}}),
     r"targets\[0\].options.limb_matching: unknown option 'bogus'"),
    (lambda t: t["targets"][0].update(estimators=["cross_correlation", "cross_correlation"]), "named twice"),
    (lambda t: t["targets"][0].update(units="mile"), r"targets\[0\].units: expected 'km', 'm' or 'auto', got 'mile'"),
    (lambda t: t["targets"][0].update(shape={"radii_km": [1.0, 2.0]}), r"targets\[0\].shape: expected a mesh file or"),
    (lambda t: t["targets"][0].update(shape={"radii_km": [1.0, 2.0, -1.0]}), "must be three positive and finite"),
    (lambda t: t["targets"][0].update(shape={"radii_km": [1.0, math.inf, 1.0]}), "must be three positive and finite"),
    (lambda t: t["targets"][0].update(shape={"radii_km": [1.0, math.nan, 1.0]}), "must be three positive and finite"),
    (lambda t: t["targets"][0].update(shape={"radii": "pck"}), r"targets\[0\].shape: .*radii of a PCK need \[spice\]"),
    (
        lambda t: t.update(
            spice={"kernels": ["pck.tpc"], "spacecraft": "-64"},
            targets=[t["targets"][0] | {"shape": {"radii": "pck"}, "spice_body": "599"}],
        ),
        r"targets\[0\].shape: .*no radii of 599",
    ),
    (lambda t: t["targets"][0].update(uncertainty={"pole_deg": 30}),
     r"targets\[0\].uncertainty.pole_deg: expected a number from 0 to 25, or \"unknown\", got 30"),
    (lambda t: t["targets"][0].update(uncertainty={"pole_deg": "unknown"}),
     r"targets\[0\].uncertainty.pole_deg: PEBBLE: unknown pole: an ellipsoid is needed, .* 12%, got 18%"),
    (lambda t: t["targets"][0].update(shape="rock.obj", uncertainty={"pole_deg": "unknown"}), "12%, got a mesh"),
    (lambda t: t["targets"][0].update(uncertainty={"scale": -1.0}), r"targets\[0\].uncertainty.scale: "),
    (lambda t: t["targets"][0].update(atmosphere="VULCAN"), r"targets\[0\].atmosphere: no atmosphere of 'VULCAN'"),
    (lambda t: t["targets"][0].update(air=False, atmosphere="EARTH"), "an airless body"),
    (lambda t: t["targets"][0].update(air="thin"), r"targets\[0\].air"),
    (lambda t: t["targets"][0].update(atmosphere={"altitude_km": 5}), "expected altitude_km and sigma_km"),
    (lambda t: t["targets"][0].update(atmosphere={"altitude_km": "high", "sigma_km": 1}), "altitude_km must be"),
    (lambda t: t["targets"][0].update(terrain="none.img"), r"targets\[0\].terrain: "),
    (lambda t: t["targets"][0].update(rings="EARTH"), "no rings of 'EARTH'"),
    (lambda t: t["targets"][0].update(rings={"inner_km": 3}), "table of inner_km and outer_km"),
    (lambda t: t["targets"][0].update(rings={"inner_km": 3, "outer_km": 2}), "inner < outer"),
    (lambda t: t["targets"][0].update(shape="rock.obj", rings="SATURN"), "goes with an ellipsoid"),
    (lambda t: t["targets"][0].update(terrain="camera.toml", atmosphere="EARTH"), "either terrain or atmosphere"),
    (lambda t: t["targets"][0].update(shape="rock.obj", atmosphere="EARTH"), "goes with an ellipsoid"),
    (lambda t: t["targets"][0].update(shape=5), r"targets\[0\].shape: expected a mesh file or"),
    (lambda t: t["targets"][0].update(reflectance={"model": "phong"}), r"targets\[0\].reflectance model must be one"),
    (lambda t: t["targets"].append(dict(t["targets"][0])), "targets: two targets have the name 'PEBBLE'"),
    (lambda t: t.update(camera={"file": "camera.toml", "columns": 5}), r"\[camera\]: give either file or"),
    (lambda t: t.update(camera={"columns": 5, "rows": 5}), r"\[camera\]: key 'model' is missing"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "expected"), WRONG_VALUES)
def test_wrong_values_are_named_with_what_was_expected(
    tmp_path: Path, change: Callable[[dict[str, Any]], Any], expected: str
) -> None:
    assert_matches(problem(tmp_path, change), expected)


MISSING_FILES: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda t: t["images"].update(files=["images/*.fits", "more/*.fits"]), "images.files: no file matches 'more/"),
    (lambda t: t["images"].update(geometry="geo.csv"), "images.geometry: there is no file 'geo.csv'"),
    (lambda t: t.update(camera={"file": "cam.toml"}), "camera.file: there is no file 'cam.toml'"),
    (lambda t: t["targets"][0].update(shape="bennu.obj"), r"targets\[0\].shape: there is no file 'bennu.obj'"),
    (lambda t: t["stars"].update(catalog="stars.csv"), "stars.catalog: there is no file 'stars.csv'"),
    (lambda t: t.update(spice={"kernels": ["pck.tpc", "de.bsp"], "spacecraft": "-64"}), "spice.kernels: .*de.bsp: "),
]


@pytest.mark.parametrize(("change", "expected"), MISSING_FILES)
def test_missing_files_are_named_with_the_key_that_names_them(
    tmp_path: Path, change: Callable[[dict[str, Any]], Any], expected: str
) -> None:
    assert_matches(problem(tmp_path, change), expected)


def assert_matches(text: str, expected: str) -> None:
    import re

    assert re.search(expected, text), text


def test_a_missing_campaign_file_and_one_that_is_no_toml_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none.toml: cannot read the campaign file"):
        Campaign.load(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("[campaign\nname = ")
    with pytest.raises(DataError, match=r"bad.toml: is not valid TOML: .*line 1"):
        Campaign.load(tmp_path / "bad.toml")


def test_a_date_where_text_is_expected_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, campaign_table())
    path.write_text(path.read_text().replace('name = "test"', "name = 2024-01-01"))
    with pytest.raises(DataError, match="dates and times are not expected here, got 2024-01-01"):
        Campaign.load(path)


def test_mistakes_in_the_files_that_a_campaign_names_carry_the_name_of_those_files(tmp_path: Path) -> None:
    path = write(tmp_path, campaign_table())
    (tmp_path / "geometry.csv").write_text("file,target_x\na.fits,1\n")
    with pytest.raises(DataError, match=r"geometry.csv: .*unknown column 'target_x'"):
        Campaign.load(path)
    path = write(tmp_path, campaign_table())
    (tmp_path / "camera.toml").write_text('columns = 5\nrows = "five"\n[model]\ntype = "pinhole"\n')
    with pytest.raises(DataError, match=r"camera.toml: "):
        Campaign.load(path)


def test_images_that_share_a_base_name_are_called_by_their_path(tmp_path: Path) -> None:
    path = write(tmp_path, campaign_table() | {"images": {"files": ["images/*.fits", "more/a.fits"]}})
    (tmp_path / "more").mkdir()
    (tmp_path / "more/a.fits").write_bytes(b"-")
    campaign = Campaign.load(path)
    assert [image.key for image in campaign.images] == ["images/a.fits", "b.fits", "more/a.fits"]


def test_an_image_that_several_patterns_match_is_taken_once_in_first_place(tmp_path: Path) -> None:
    path = write(tmp_path, campaign_table() | {"images": {"files": ["images/b.fits", "images/*.fits"]}})
    assert [image.key for image in Campaign.load(path).images] == ["b.fits", "a.fits"]


def test_a_target_that_nothing_places_is_worth_a_warning(tmp_path: Path) -> None:
    table = campaign_table()
    table["targets"].append(table["targets"][0] | {"name": "BOULDER"})
    (warning,) = Campaign.load(write(tmp_path, table)).warnings
    assert "BOULDER" in warning
    path = write(tmp_path, campaign_table())
    (tmp_path / "geometry.csv").write_text("file,target,sun_x,sun_y,sun_z\na.fits,PEBLE,0,0,1\n")
    warnings = Campaign.load(path).warnings
    assert any("'PEBLE' is not in the campaign" in text for text in warnings)


def test_rows_without_image_and_images_without_row_are_worth_a_warning(tmp_path: Path) -> None:
    path = write(tmp_path, campaign_table())
    header = "file,target,target_x_km,target_y_km,target_z_km\n"
    (tmp_path / "geometry.csv").write_text(f"{header}images/a.fits,PEBBLE,0,0,30\nb.fit,PEBBLE,0,0,30\n")
    rows, images = Campaign.load(path).warnings
    assert_matches(rows, r"geometry.csv: no image of the campaign has the name 'b.fit'; these rows are not used")
    assert_matches(images, r"geometry.csv: no row for 'b.fits', and no \[spice\]")
    table = campaign_table() | {"spice": {"kernels": ["pck.tpc"], "spacecraft": "-64"}}
    path = write(tmp_path, table)
    (tmp_path / "geometry.csv").write_text(f"{header}a.fits,PEBBLE,0,0,30\n")
    assert Campaign.load(path).warnings == ()
    (tmp_path / "geometry.csv").write_text(f"{header}c.fits,PEBBLE,0,0,30\n")
    (warning,) = Campaign.load(path).warnings
    assert "no row names an image" in warning


def test_exposure_decides_between_star_images_and_images_of_bodies(tmp_path: Path) -> None:
    table = campaign_table()
    campaign = Campaign.load(write(tmp_path, table))
    assert [campaign.is_star_image(t) for t in (1.0, 0.99, None)] == [True, False, False]
    assert [campaign.is_body_image(t) for t in (1.0, 0.99, None)] == [False, True, True]
    del table["stars"]["long_exposure_s"]
    campaign = Campaign.load(write(tmp_path, table))
    assert all(campaign.is_star_image(t) and campaign.is_body_image(t) for t in (1.0, 0.1, None))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inner:
    size: float = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outer:
    method: TransferMethod = TransferMethod.REPLACE
    pair: tuple[float, float] = (0.0, 1.0)
    inner: Inner = dataclasses.field(default_factory=Inner)
    limit: float | None = None


def test_option_tables_fill_enumerations_tuples_and_nested_options() -> None:
    table = {"method": "propagate", "pair": [1, 2.5], "inner": {"size": 3}, "limit": math.inf}
    options = options_from_mapping(Outer, table, "here")
    expected = Outer(method=TransferMethod.PROPAGATE, pair=(1, 2.5), inner=Inner(size=3), limit=np.inf)
    assert options == expected
    with pytest.raises(InputError, match=r"here.inner: unknown option 'sise' .did you mean 'size'..; options are size"):
        options_from_mapping(Outer, {"inner": {"sise": 3}}, "here")
    with pytest.raises(InputError, match=r"here.pair: expected"):
        options_from_mapping(Outer, {"pair": [1.0]}, "here")


REDUCED = {2: (512, 2.0), 1.6: (640, 1.6), 0.625: (640, 1.6), (640, 640): (640, 1.6), (300, 300): (300, 1024 / 300)}


@pytest.mark.parametrize("binned", REDUCED)
@pytest.mark.parametrize("source", ["preset", "file"])
def test_a_reduced_picture_sees_the_same_sky_as_the_whole_frame(tmp_path: Path, source: str, binned: Any) -> None:
    """A corner of a pixel of the picture is where it was in the frame."""
    full = camera_preset("cassini_nac").camera
    full.save(tmp_path / "whole.toml")
    chosen = {"preset": "cassini_nac"} if source == "preset" else {"file": "whole.toml"}
    value = list(binned) if isinstance(binned, tuple) else binned
    camera = Campaign.load(write(tmp_path, campaign_table() | {"camera": chosen | {"binned": value}})).camera
    size, factor = REDUCED[binned]
    assert (camera.columns, camera.rows) == (size, size)
    corners = np.array([[-0.5, -0.5], [100.5, 33.5]])  # of the picture
    np.testing.assert_allclose(
        camera.model.unproject(corners), full.model.unproject((corners + 0.5) * factor - 0.5), rtol=0, atol=1e-12
    )
    assert camera.psf is not None
    assert camera.psf.sigma_px == pytest.approx(0.54 / factor)
    assert camera.detector.estimated


def test_an_enlarged_picture_is_given_by_its_size(tmp_path: Path) -> None:
    table = campaign_table() | {"camera": {"preset": "galileo_ssi", "binned": [1600, 1600]}}
    camera = Campaign.load(write(tmp_path, table)).camera
    assert (camera.columns, camera.rows) == (1600, 1600)
    assert camera.model.focal_length_px == pytest.approx(2 * camera_preset("galileo_ssi").camera.model.focal_length_px)


@pytest.mark.parametrize(
    ("binned", "expected"),
    [
        (0, r"camera.binned: expected a number above 0 or \[columns, rows\], got 0"),
        (True, "camera.binned: expected a number above 0"),
        ([640, 480], "640 x 480 pixels are no reduction of 1024 x 1024: the picture was cut"),
        ([640, 6.5], "expected the columns and rows of the picture"),
    ],
)
def test_a_reduction_that_is_none_is_refused(tmp_path: Path, binned: Any, expected: str) -> None:
    text = problem(tmp_path, lambda t: t.update(camera={"preset": "cassini_nac", "binned": binned}))
    assert_matches(text, expected)


def test_gamma_and_other_keys_of_the_images_are_added_to_a_preset_a_file_or_a_mission(tmp_path: Path) -> None:
    """A picture made for display was coded, whatever its camera is."""
    known = {"detector": {"gamma": "sRGB", "read_noise_e": 2.0}, "psf": {"sigma_px": 1.1}}
    for chosen in ({"preset": "cassini_nac"}, {"file": "camera.toml"}, {}):
        table = campaign_table() | {"camera": chosen | known | ({"binned": 0.5} if chosen else {})}
        if not chosen:
            table["mission"] = {"name": "cassini_nac"}
        camera = Campaign.load(write(tmp_path, table)).camera
        assert camera.detector.gamma == "srgb"
        assert camera.detector.read_noise_e == 2.0
        assert not camera.detector.estimated
        assert camera.psf is not None
        assert camera.psf.sigma_px == 1.1  # of the picture as it is, after the reduction
    text = problem(tmp_path, lambda t: t.update(camera={"preset": "cassini_nac", "detector": {"gama": 2.2}}))
    assert_matches(text, r"\[camera\]: \[detector\]: unknown key 'gama'; the keys are")
    text = problem(tmp_path, lambda t: t.update(camera={"preset": "cassini_nac", "detector": 2.2}))
    assert_matches(text, "camera.detector: expected a table, got 2.2")
