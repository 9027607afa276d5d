"""The bench in a headless Chromium: marks on their places, layers, rejection and solution, a thousand images."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page

from giantlike.campaign.export import ExportFormat, ExportOptions, export_run
from giantlike.campaign.store.edits import read_edits
from tests.bench.browser import CHROMIUM, chromium_page, multiply, open_page, served

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
    """Where a pixel of the image should be on the screen: the image fills its stage, centered, unstretched."""
    stage = page.locator("#stage").bounding_box()
    assert stage is not None
    columns, rows = page.evaluate("[state.image.columns, state.image.rows]")
    scale = min(stage["width"] / columns, stage["height"] / rows)
    left = stage["x"] + (stage["width"] - scale * columns) / 2
    top = stage["y"] + (stage["height"] - scale * rows) / 2
    return left + (x + 0.5) * scale, top + (y + 0.5) * scale


def test_every_mark_of_every_layer_is_drawn_on_its_place(page: Page, run: Path) -> None:
    drawn = set()
    with served(run) as address:
        open_page(page, address)
        for file in ("visit0_a_long.fits", "visit0_b_short.fits"):
            _show(page, file)
            if page.locator("#terminator").count():
                page.click("#terminator")
                page.wait_for_selector("#layers input[data-layer=terminator]")
            while page.locator("#layers input:not(:checked)").count():
                page.locator("#layers input:not(:checked)").first.check()
            marks = page.evaluate(
                """() => [...document.querySelectorAll('#marks > g')].flatMap((group, number) => {
                    const layer = state.image.layers[number];
                    return [...group.querySelectorAll('g.mark')].map((mark, place) => {
                        const box = mark.querySelector('circle, path').getBoundingClientRect();
                        return [layer.name, ...layer.points[place], box.x + box.width / 2, box.y + box.height / 2];
                    });
                })"""
            )
            for name, x, y, screen_x, screen_y in marks:
                wanted = _place_of(page, x, y)
                assert abs(screen_x - wanted[0]) < MARK_PX, name
                assert abs(screen_y - wanted[1]) < MARK_PX, name
            drawn |= {mark[0] for mark in marks}
            outlines = page.evaluate(
                """() => [...document.querySelectorAll('#marks > g')].flatMap((group, number) => {
                    const line = group.querySelector('path.line'), layer = state.image.layers[number];
                    if (!line) return [];
                    const box = line.getBoundingClientRect();
                    const low = axis => Math.min(...layer.points.map(point => point[axis]));
                    return [[layer.name, low(0), low(1), box.x, box.y]];
                })"""
            )
            for name, x, y, screen_x, screen_y in outlines:
                wanted = _place_of(page, x, y)
                assert abs(screen_x - wanted[0]) < 2 * MARK_PX, name
                assert abs(screen_y - wanted[1]) < 2 * MARK_PX, name
            drawn |= {line[0] for line in outlines}
    assert {"detections", "catalog", "matches", "predicted", "fitted", "centers", "limb", "terminator"} <= drawn


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
