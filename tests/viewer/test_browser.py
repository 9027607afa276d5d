"""The bench in a headless Chromium: marks on their places, layers, rejection and solution, a thousand images."""

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page

from giantlike.campaign.export import ExportFormat, ExportOptions, export_run
from giantlike.campaign.store.edits import read_edits
from giantlike.io.image_files import read_image_file
from giantlike.viewer.layers import LAYERS
from tests.viewer.browser import CHROMIUM, chromium_page, multiply, open_page, served, with_rejected_match
from tests.viewer.conftest import RockRun

pytestmark = pytest.mark.slow

TOKEN = "secret"
MARK_PX = 1.0  # on the screen
IMAGES = 1000


@pytest.fixture
def page() -> Iterator[Page]:
    if not CHROMIUM:
        pytest.skip("no Chromium is installed")
    problems: list[str] = []
    with chromium_page() as page:
        page.on("pageerror", lambda error: problems.append(str(error)))
        yield page
    assert problems == []


def _show(page: Page, file: str) -> None:
    page.click(f"#film button[title^='{file}']")
    page.wait_for_function("file => state.image && state.image.file === file", arg=file)


def _place_of(page: Page, x: float, y: float) -> tuple[float, float]:
    """Where a pixel of the image should be on the screen: the part in view fills its stage, centered, unstretched."""
    stage = page.locator("#stage").bounding_box()
    assert stage is not None
    left, top, columns, rows = page.evaluate("[state.box.x, state.box.y, state.box.w, state.box.h]")
    scale = min(stage["width"] / columns, stage["height"] / rows)
    middle = (stage["x"] + stage["width"] / 2, stage["y"] + stage["height"] / 2)
    return middle[0] + (x - left - columns / 2) * scale, middle[1] + (y - top - rows / 2) * scale


def _all_layers(page: Page, *, on: bool) -> None:
    if on and page.locator("#terminator").count():
        page.click("#terminator")
        page.wait_for_function("() => document.getElementById('message').textContent === ''")
    for box in page.locator("#layers input").all():
        box.set_checked(on)


def _assert_drawn(page: Page) -> set[str]:
    """Every mark and every vertex of every line is where it belongs; the layers that have any."""
    drawn = page.evaluate(
        """() => [...document.querySelectorAll('#marks > g')].flatMap((group, number) => {
            const layer = state.image.layers[number], line = group.querySelector('path.line');
            const shown = line ? line.getAttribute('d').slice(1).split('L').map(pair => {
                const at = new DOMPoint(...pair.split(' ').map(Number)).matrixTransform(line.getScreenCTM());
                return [at.x, at.y];
            }) : [...group.querySelectorAll('g.mark')].map(mark => {
                const box = mark.querySelector('circle, path').getBoundingClientRect();
                return [box.x + box.width / 2, box.y + box.height / 2];
            });
            if (shown.length !== layer.points.length) throw new Error(layer.title);
            return layer.points.map((point, place) => [layer.name, ...point, ...shown[place]]);
        })"""
    )
    origin, step = _place_of(page, 0.0, 0.0), _place_of(page, 1.0, 1.0)
    for name, x, y, screen_x, screen_y in drawn:
        assert abs(screen_x - (origin[0] + x * (step[0] - origin[0]))) < MARK_PX, name
        assert abs(screen_y - (origin[1] + y * (step[1] - origin[1]))) < MARK_PX, name
    return {mark[0] for mark in drawn}


def test_every_mark_of_every_layer_is_drawn_on_its_place(page: Page, run: Path, rock: RockRun) -> None:
    drawn = set()
    with_rejected_match(run, "visit0_a_long.fits", [37.25, 211.5])
    for folder, files in ((run, ("visit0_a_long.fits", "visit0_b_short.fits")), (rock.run, (rock.file,))):
        with served(folder) as address:
            open_page(page, address)
            for file in files:
                _show(page, file)
                _all_layers(page, on=True)
                drawn |= _assert_drawn(page)
                page.mouse.move(*_place_of(page, 100.0, 80.0))
                page.mouse.wheel(0, -400)
                page.wait_for_function("() => state.box.w < 0.8 * state.image.columns")
                _assert_drawn(page)
    assert drawn == set(LAYERS) - {"limb-rejected"}, "which has the shape and the code of limb points used"


def test_names_are_written_beside_stars_and_landmarks_and_used_ones_are_told_from_rejected(
    page: Page, run: Path, rock: RockRun
) -> None:
    named = "() => [...document.querySelectorAll('#marks g.named text')].map(each => each.textContent)"
    with served(run) as address:
        open_page(page, address)
        _show(page, "visit0_a_long.fits")
        brightest = page.evaluate(named)
        assert len(brightest) == 30
        assert all(re.fullmatch(r".*\(-?[0-9.]+\)", name) for name in brightest)
    with served(rock.run) as address:
        open_page(page, address)
        page.wait_for_selector("#layers input[data-layer=landmarks-rejected]")
        assert "L0002" in page.evaluate(named)
        looks = page.evaluate(
            """() => ['landmarks', 'landmarks-rejected'].map(name => {
                const group = document.querySelector(`#marks > g[data-layer=${name}]`);
                return [getComputedStyle(group).stroke, group.querySelector('g.mark').firstChild.tagName];
            })"""
        )
        assert looks[0][0] != looks[1][0]
        assert looks[0][1] != looks[1][1]


def test_the_picture_lies_under_the_marks_and_the_pointer_reads_the_pixel_it_points_at(page: Page, run: Path) -> None:
    with served(run) as address:
        open_page(page, address)
        _show(page, "visit0_a_long.fits")
        _all_layers(page, on=False)
        page.wait_for_function("() => document.getElementById('picture').style.visibility === ''")
        page.wait_for_timeout(300)  # the picture is painted after it has come
        shown = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert shown is not None
        stars = np.array(page.evaluate("state.image.layers.find(layer => layer.name === 'catalog').points"))
        apart = np.linalg.norm(stars[:, None] - stars, axis=2) + 99.0 * np.eye(len(stars))
        alone = (apart.min(axis=1) > 12.0) & (stars.min(axis=1) > 20.0) & (stars.max(axis=1) < 260.0)
        offsets = []
        for star in stars[alone][:12]:
            x, y = np.rint(_place_of(page, *star)).astype(int)
            part = shown[y - 7 : y + 8, x - 7 : x + 8].astype(float)
            part = np.maximum(part - np.median(part), 0.0)
            rows, columns = np.indices(part.shape)
            middle = np.array([(columns * part).sum(), (rows * part).sum()]) / part.sum() - 7.0 + [x + 0.5, y + 0.5]
            offsets.append(middle - _place_of(page, *star))
        assert len(offsets) >= 8
        assert np.abs(np.median(offsets, axis=0)).max() < 0.5 * MARK_PX

        _show(page, "visit0_b_short.fits")
        for kind in page.locator("#kind option").evaluate_all("all => all.map(each => each.value)"):
            page.select_option("#kind", kind)
            box = page.locator("#picture").bounding_box()
            assert box is not None
            corners = [*_place_of(page, -0.5, -0.5), *_place_of(page, 319.5, 279.5)]
            found = [box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"]]
            np.testing.assert_allclose(found, corners, rtol=0, atol=0.5 * MARK_PX)
        page.select_option("#kind", "image")
        pixels = read_image_file(run.parent / "images" / "visit0_b_short.fits").pixels
        column, row = (
            round(each) for each in page.evaluate("[state.image.fixes[0].x + 9, state.image.fixes[0].y - 4]")
        )
        page.mouse.move(*_place_of(page, column, row))
        page.wait_for_function("() => document.getElementById('readout').textContent.includes('range')", timeout=30000)
        words = page.locator("#readout").inner_text()
        numbers = re.match(r"x ([\d.]+)\s+y ([\d.]+) px\s+DN ([\d.]+)", words)
        assert numbers is not None, words
        np.testing.assert_allclose([float(number) for number in numbers.groups()[:2]], [column, row], rtol=0, atol=0.5)
        assert float(numbers[3]) == float(pixels[row, column])
        assert all(f"{name} " in words for name in ("range", "phase", "incidence", "emission", "latitude", "longitude"))


def test_a_layer_is_switched_off_and_on(page: Page, run: Path) -> None:
    with served(run) as address:
        open_page(page, address)
        _show(page, "visit0_a_long.fits")
        group = page.locator("#marks > g[data-layer=matches]")
        assert group.is_visible()
        page.locator("#layers input[data-layer=matches]").uncheck()
        assert not group.is_visible()
        page.locator("#layers input[data-layer=matches]").check()
        assert group.is_visible()


def test_a_star_is_rejected_the_image_solved_again_and_the_export_knows(page: Page, run: Path, tmp_path: Path) -> None:
    file = "visit0_a_long.fits"
    page.on("dialog", lambda dialog: dialog.accept("it is double"))
    export_run(run, tmp_path / "before.csv", ExportFormat.CSV, ExportOptions())
    with served(run) as address:
        open_page(page, address)
        _show(page, file)
        mark = page.locator("g[data-layer=matches] g.star").first
        star = mark.get_attribute("data-star")
        mark.locator("circle").dispatch_event("click")
        page.wait_for_function("() => document.getElementById('message').textContent.includes('star rejected')")
        assert [str(edit.star) for edit in read_edits(run).standing] == [star]
        page.click("#solve")
        page.wait_for_function(
            "() => document.getElementById('message').textContent.startsWith('solved')", timeout=120000
        )
        left = page.evaluate("state.image.layers.find(layer => layer.name === 'matches').star_ids.map(String)")
        assert star not in left
    export_run(run, tmp_path / "after.csv", ExportFormat.CSV, ExportOptions())
    before, after = ((tmp_path / f"{name}.csv").read_text() for name in ("before", "after"))
    assert before != after


def test_the_table_is_filtered_sorted_and_leads_to_images(page: Page, run: Path) -> None:
    with served(run) as address:
        open_page(page, address)
        page.fill("#filter", "limb_matching")
        names = page.locator("#rows tbody tr td:nth-child(3)").all_inner_texts()
        assert set(names) == {"limb_matching"}
        page.click("#rows tbody tr >> nth=0")
        page.wait_for_function("() => state.image.file === 'visit0_b_short.fits'")
        page.fill("#filter", "")
        page.click("#tab-compare")
        page.wait_for_selector("#rows tbody tr")
        assert page.locator("#rows tbody tr").first.inner_text().split()[1:4] == [
            "PEBBLE",
            "limb_matching",
            "cross_correlation",
        ]
        page.click("#tab-plots")
        page.evaluate("choose(0)")
        page.wait_for_function("() => state.index === 0")
        page.locator("#plots circle").first.dispatch_event("click")
        page.wait_for_function("() => state.image.file === 'visit0_b_short.fits'")


def test_the_table_of_the_report_is_sorted_by_a_click_and_every_card_is_printed_whole(page: Page, run: Path) -> None:
    page.goto((run / "report.html").as_uri())
    order = (
        "() => [...document.querySelectorAll('.sortable tbody tr')].map(row => parseFloat(row.cells[4].textContent))"
    )
    page.click(".sortable th >> nth=4")
    assert page.evaluate(order) == sorted(page.evaluate(order))
    page.click(".sortable th >> nth=4")
    assert page.evaluate(order) == sorted(page.evaluate(order), reverse=True)
    page.emulate_media(media="print")
    page.set_viewport_size({"width": 703, "height": 1032})  # A4 less its margins, at 96 px per inch
    wide = page.evaluate(
        """() => [...document.querySelectorAll('main *')].filter(each => !each.closest('svg'))
            .map(each => each.getBoundingClientRect().right)"""
    )
    assert max(wide) <= 703 + MARK_PX
    assert not page.locator("nav").is_visible()


def test_a_thousand_images_are_listed_and_the_last_one_opens(page: Page, run: Path) -> None:
    multiply(run, IMAGES)
    with served(run) as address:
        open_page(page, address)
        assert page.locator("#film button").count() == IMAGES
        _show(page, f"image{IMAGES - 1:04d}.fits")
        assert page.locator("#marks > g").count() > 0
