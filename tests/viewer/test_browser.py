"""The bench in a headless Chromium: marks on their places, layers, rejection and solution, a thousand images."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page, Route
from scipy.spatial import cKDTree

from giantlike.campaign.export import ExportFormat, ExportOptions, export_run
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.edits import Measuring, read_edits
from giantlike.campaign.store.records import AttitudeRecord
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.catalogs import load_catalog
from giantlike.core.frames import direction_from_radec
from giantlike.io.image_files import read_image_file
from giantlike.viewer.layers import LAYERS
from tests.campaign_files import CAMERA
from tests.viewer.browser import CHROMIUM, chromium_page, multiply, open_page, served, with_rejected_match
from tests.viewer.conftest import Made, RockRun, make_suspect
from tests.viewer.test_decisions import predict_elsewhere

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
    others = {"limb-rejected", "rejected-stars", "start", "mask"}  # with the code of layers that are drawn
    assert drawn == set(LAYERS) - others


def test_two_runs_are_shown_in_turn_at_the_same_place(page: Page, run: Path) -> None:
    file, place, other = "visit0_a_long.fits", [37.25, 211.5], run.with_name("other")
    shutil.copytree(run, other)
    with_rejected_match(other, file, place)
    has_mark = (
        f"() => ofSide().layers.some(layer => '{place}' === '[' + String(layer.points[0]).replace(',', ', ') + ']')"
    )
    with served(run, other) as address:
        open_page(page, address)
        _show(page, file)
        page.mouse.move(*_place_of(page, 100.0, 80.0))
        page.mouse.wheel(0, -400)
        page.wait_for_function("() => state.box.w < 0.8 * state.image.columns")
        box = page.evaluate("state.box")
        assert not page.evaluate(has_mark)
        page.click("#other")
        page.wait_for_function("() => state.side")
        assert page.evaluate(has_mark)
        assert page.evaluate("document.querySelectorAll('#marks > g').length === state.other.layers.length")
        assert page.get_attribute("#picture", "href").startswith("/other/picture/")  # type: ignore[union-attr]
        assert page.evaluate("state.box") == box
        page.click("#blink-runs")
        for side in ("!state.side", "state.side", "!state.side"):
            page.wait_for_function(f"() => {side}")
        page.click("#blink-runs")
        assert not page.evaluate("state.side")
        assert page.evaluate("state.box") == box


def test_names_are_written_beside_stars_and_landmarks_and_used_ones_are_told_from_rejected(
    page: Page, run: Path, rock: RockRun
) -> None:
    named = "() => [...document.querySelectorAll('#marks g.named text')].map(each => each.textContent)"
    with served(run) as address:
        open_page(page, address)
        _show(page, "visit0_a_long.fits")
        brightest = page.evaluate(named)
        assert 10 <= len(brightest) <= 30
        assert all(re.fullmatch(r".*\(-?[0-9.]+\)", name) for name in brightest)
    with served(rock.run) as address:
        open_page(page, address)
        page.wait_for_selector("#layers input[data-layer=landmarks-rejected]")
        names = page.evaluate(named)
        assert len(names) >= 3
        assert all(re.fullmatch(r"L\d{4}", name) for name in names)
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


def _stars(run: Path, file: str) -> list[int]:
    record = RunFolder.open(run).load(AttitudeRecord, file)
    assert record is not None
    assert record.stars is not None
    return record.stars.star_ids


def _separations(run: Path, file: str) -> dict[int, float]:
    """Angle, rad, of each star around an image from the next one of the catalog, which could take its place."""
    record = RunFolder.open(run).load(AttitudeRecord, file)
    assert record is not None
    assert record.fov_deg is not None
    assert record.ra_deg is not None
    assert record.dec_deg is not None
    axis = direction_from_radec(record.ra_deg, record.dec_deg)
    stars = load_catalog("default").cone(axis, np.radians(record.fov_deg), max_magnitude=9.0)
    directions = direction_from_radec(stars.ra_deg, stars.dec_deg)
    apart = np.asarray(cKDTree(directions).query(directions, k=2)[0])
    return dict(zip(stars.ids.tolist(), apart[:, 1].tolist(), strict=True))


def _said(page: Page, words: str, timeout: float = 30000) -> None:
    page.wait_for_function(
        "words => document.getElementById('message').textContent.includes(words)", arg=words, timeout=timeout
    )


def _click_star(page: Page, layer: str, star: int) -> None:
    page.locator(f"g[data-layer={layer}] g.star[data-star='{star}']").locator("circle, path").dispatch_event("click")


def test_a_star_is_rejected_the_image_solved_again_and_the_export_knows(page: Page, run: Path, tmp_path: Path) -> None:
    file = "visit0_a_long.fits"
    page.on("dialog", lambda dialog: dialog.accept("it is double"))
    export_run(run, tmp_path / "before.csv", ExportFormat.CSV, ExportOptions())
    matched = _stars(run, file)
    star = max((number for number in matched if int(float(number)) != number), key=_separations(run, file).__getitem__)
    with served(run) as address:
        open_page(page, address)
        _show(page, file)
        _click_star(page, "matches", star)
        _said(page, "star rejected")
        assert read_edits(run).measuring() == {file: Measuring(rejected_stars=frozenset([star]))}
        page.click("#solve")
        _said(page, "solved", timeout=120000)
        assert set(_stars(run, file)) == set(matched) - {star}
        count = page.evaluate("state.image.layers.find(layer => layer.name === 'matches').star_ids.length")
        assert count == len(matched) - 1
        assert page.locator("#decisions div").inner_text().count(str(star)) == 1
        _click_star(page, "rejected-stars", star)
        _said(page, "star restored")
        assert read_edits(run).standing == []
    export_run(run, tmp_path / "after.csv", ExportFormat.CSV, ExportOptions())
    before, after = ((tmp_path / f"{name}.csv").read_text() for name in ("before", "after"))
    assert before != after


def test_a_rejected_image_and_its_fixes_are_drawn_as_rejected_and_restored(page: Page, run: Path) -> None:
    page.on("dialog", lambda dialog: dialog.accept("smear"))
    with served(run) as address:
        open_page(page, address)
        _show(page, "visit0_b_short.fits")
        count = page.locator("#marks > g").count()
        page.click("#reject-image")
        _said(page, "image rejected")
        assert page.locator("#marks > g").count() == count
        assert page.locator("#marks > g.rejected[data-layer=centers]").count() > 0
        assert page.locator("#film button.chosen.rejected").count() == 1
        assert set(page.locator("#rows tr.chosen td:nth-child(4)").all_inner_texts()) == {"rejected"}
        page.click("#decisions button")
        _said(page, "image restored")
        assert page.locator("#marks > g.rejected").count() == 0


@pytest.mark.parametrize(("width", "height"), [(1600, 900), (1366, 768), (1024, 768)])
def test_the_column_of_rejections_lies_inside_the_window(page: Page, run: Path, width: int, height: int) -> None:
    page.set_viewport_size({"width": width, "height": height})
    with served(run) as address:
        open_page(page, address)
        buttons = page.locator("#rows td.do button")
        assert buttons.count() == 2
        for button in buttons.all():
            box = button.bounding_box()
            assert box is not None
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= width
            middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
            assert page.evaluate("([x, y]) => document.elementFromPoint(x, y)?.textContent", middle) == "reject"
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_the_table_follows_the_image(page: Page, run: Path) -> None:
    multiply(run, 120)
    with served(run) as address:
        open_page(page, address)
        for file in ("image0118.fits", "image0001.fits"):
            _show(page, file)
            row, seen = page.locator("#rows tr.chosen").last.bounding_box(), page.locator("#rows").bounding_box()
            assert row is not None
            assert seen is not None
            assert seen["y"] < row["y"]
            assert row["y"] + row["height"] <= seen["y"] + seen["height"]
            assert file in page.locator("#rows tr.chosen").first.inner_text()


def test_panels_are_resized_by_pointer_and_by_arrow_keys(page: Page, run: Path) -> None:
    with served(run) as address:
        open_page(page, address)
        _all_layers(page, on=True)
        index = page.evaluate("state.index")
        for panel, key, move in (
            ("film", "ArrowRight", (60, 0)),
            ("side", "ArrowLeft", (-60, 0)),
            ("table", "ArrowUp", (0, -60)),
        ):
            size = list[float]()
            split = page.locator(f"#split-{panel}")
            for change in ("nothing", "pointer", "key"):
                if change == "pointer":
                    box = split.bounding_box()
                    assert box is not None
                    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
                    page.mouse.move(x, y)
                    page.mouse.down()
                    page.mouse.move(x + move[0], y + move[1], steps=4)
                    page.mouse.up()
                elif change == "key":
                    split.press(key)
                box = page.locator(f"#{panel}").bounding_box()
                assert box is not None
                size.append(box["height"] if panel == "table" else box["width"])
            assert size[1] - size[0] == pytest.approx(60, abs=4)
            assert size[2] - size[1] == pytest.approx(16, abs=2)
        assert page.evaluate("state.index") == index
        _assert_drawn(page)


def test_plots_over_the_campaign_have_axes_error_bars_and_time(page: Page, run: Path) -> None:
    multiply(run, 12)
    with served(run) as address:
        open_page(page, address)
        page.click("#tab-plots")
        plots = page.locator("#plots > svg")
        assert plots.count() == 3
        for number, quantity in enumerate(("o-c x, px", "o-c y, px", "o-c range, %")):
            plot = plots.nth(number)
            assert plot.locator("text.title").text_content() == f"PEBBLE: {quantity}"
            assert plot.locator("path.axis").count() == 1
            texts = plot.locator("text").all_text_contents()
            assert any(re.fullmatch(r"UTC.*", text) for text in texts)
            assert sum(bool(re.fullmatch(r"-?[\d.]+", text)) for text in texts) >= 3
            assert any(re.fullmatch(r"\d\d:\d\d.*|\d{4}-\d\d-\d\d", text) for text in texts)
            assert plot.locator("path.bar").count() == plot.locator("circle").count() == 8
        # the bar and the dot are where value and sigma are, by the numbers at the axis
        found = page.evaluate(
            r"""() => {
                const plot = document.querySelector('#plots > svg');
                const fix = state.run.fixes.find(each => each.dx !== null);
                const line = [...plot.querySelectorAll('text[text-anchor=end]')].map(
                    each => [Number(each.textContent), each.getAttribute('y') - 4]
                ).filter(each => !Number.isNaN(each[0]));
                const [low, high] = [line[0], line.at(-1)], step = (high[1] - low[1]) / (high[0] - low[0]);
                const y = value => low[1] + (value - low[0]) * step;
                const bar = plot.querySelector('path.bar').getAttribute('d').match(/[\d.]+/g).map(Number);
                const dot = Number(plot.querySelector('circle').getAttribute('cy'));
                return [dot - y(fix.dx), bar[1] - y(fix.dx - fix.sigma_x), bar[2] - y(fix.dx + fix.sigma_x)];
            }"""
        )
        assert np.abs(found).max() < 0.5


def test_charts_are_dark_like_the_page(page: Page, run: Path) -> None:
    with served(run) as address:
        open_page(page, address)
        for file in ("visit0_a_long.fits", "visit0_b_short.fits"):
            _show(page, file)
            for button in page.locator("#charts button").all():
                page.evaluate("document.getElementById('chart').replaceChildren()")
                button.click()
                page.wait_for_selector("#chart svg", timeout=60000)
                page.wait_for_timeout(200)
                shown = cv2.imdecode(np.frombuffer(page.locator("#chart svg").screenshot(), np.uint8), cv2.IMREAD_COLOR)
                assert shown is not None
                edge = np.concatenate([shown[:, :3].reshape(-1, 3), shown[:2].reshape(-1, 3)])
                assert np.median(edge) < 60
                assert shown.max() > 150, "its text can be read"


def test_the_keyboard_zooms_and_steps_through_marks_and_leaves_menus_alone(page: Page, run: Path) -> None:
    page.on("dialog", lambda dialog: dialog.accept("by key"))
    with served(run) as address:
        open_page(page, address)
        _show(page, "visit0_a_long.fits")
        index, wide = page.evaluate("[state.index, state.box.w]")
        page.focus("#stretch")
        page.keyboard.press("ArrowDown")
        page.keyboard.press("ArrowRight")
        assert page.evaluate("state.index") == index
        page.focus("#stage")
        page.keyboard.press("+")
        page.keyboard.press("+")
        assert page.evaluate("state.box.w") == pytest.approx(wide / 1.25**2)
        page.keyboard.press("Shift+ArrowRight")
        page.keyboard.press("-")
        page.keyboard.press("0")
        assert page.evaluate("state.box.w") == wide

        _all_layers(page, on=False)
        page.locator("#layers input[data-layer=matches]").check()
        points, labels = page.evaluate(
            "(layer => [layer.points, layer.labels])(state.image.layers.find(layer => layer.name === 'matches'))"
        )
        for key, place in (("n", 0), ("n", 1), ("p", 0), ("p", len(points) - 1), ("n", 0)):
            page.keyboard.press(key)
            assert labels[place] in page.locator("#readout").inner_text()
            ring = page.locator("#selected circle").bounding_box()
            assert ring is not None
            middle = (ring["x"] + ring["width"] / 2, ring["y"] + ring["height"] / 2)
            np.testing.assert_allclose(middle, _place_of(page, *points[place]), rtol=0, atol=MARK_PX)
        star = page.evaluate("state.selected.layer.star_ids[state.selected.place]")
        page.keyboard.press("Enter")
        _said(page, "star rejected")
        assert [str(edit.star) for edit in read_edits(run).standing] == [star]
        page.focus("#stage")
        page.keyboard.press("ArrowDown")
        page.wait_for_function("before => state.index === before + 1", arg=index)


def test_names_beside_stars_do_not_cover_each_other(page: Page, run: Path) -> None:
    with served(run) as address:
        open_page(page, address)
        _show(page, "visit0_a_long.fits")
        for _ in range(3):
            boxes = np.array(
                page.evaluate(
                    """() => [...document.querySelectorAll('#marks g.named text')].map(each => {
                        const box = each.getBoundingClientRect();
                        return [box.left, box.top, box.right, box.bottom];
                    })"""
                )
            )
            assert len(boxes) >= 5
            apart = np.maximum(boxes[:, None, :2], boxes[None, :, :2]) - np.minimum(
                boxes[:, None, 2:], boxes[None, :, 2:]
            )
            over = (apart < -1.0).all(axis=2)  # rounding of glyphs
            assert over.sum() == len(boxes), "each covers itself alone"
            page.keyboard.press("+")


def test_slow_answers_show_a_sign_of_work_and_an_ended_server_a_clear_message(page: Page, run: Path) -> None:
    with served(run) as address:
        open_page(page, address)
        _show(page, "visit0_b_short.fits")
        page.wait_for_function("() => !document.getElementById('busy').classList.contains('on')", timeout=30000)
        held: list[Route] = []
        page.route("**/api/terminator/*", lambda route: held.append(route))
        page.click("#terminator")
        page.wait_for_selector("#busy.on")
        assert page.locator("#busy").inner_text() == "tracing the terminator"
        assert page.locator("#terminator").is_disabled()
        held[0].continue_()
        page.wait_for_function("() => !document.getElementById('busy').classList.contains('on')", timeout=60000)
    page.click("#film button >> nth=0")
    _said(page, "giantlike view has ended: start it again")


def test_two_runs_are_open_in_one_browser(page: Page, run: Path, rock: RockRun) -> None:
    with served(run) as first, served(rock.run) as second:
        open_page(page, first)
        other = page.context.new_page()
        open_page(other, second)
        _show(page, "visit0_b_short.fits")
        page.reload()
        page.wait_for_selector("body[data-ready=yes]", timeout=60000)
        assert other.evaluate("state.run.name") == "rock"
        assert page.evaluate("state.run.name") == "test"


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


def test_a_suspect_fix_is_accepted_with_name_and_reason_and_the_list_shows_the_state_of_review(
    page: Page, run: Path
) -> None:
    make_suspect(run, "visit0_b_short.fits", ("PEBBLE", "limb_matching"))
    make_suspect(run, "visit0_b_short.fits", ("PEBBLE", "cross_correlation"))
    make_suspect(run, "visit0_c_long.fits", flag="large_residuals")
    page.on("dialog", lambda dialog: dialog.accept("the crescent is right"))
    shown = "() => [...document.querySelectorAll('#film button')].filter(one => one.offsetParent).map(one => one.title)"
    with served(run) as address:
        open_page(page, address)
        page.focus("#stage")
        for file in ("visit0_b_short.fits", "visit0_c_long.fits", "visit0_b_short.fits"):
            page.keyboard.press("s")
            page.wait_for_function("file => state.image.file === file", arg=file)
        page.fill("#who", "Ann")
        page.locator("#rows tr", has_text="limb_matching").get_by_text("accept", exact=True).click()
        _said(page, "fix accepted")
        (edit,) = read_edits(run).standing
        assert (edit.action, edit.estimator, edit.who, edit.why) == (
            *("accept", "limb_matching", "Ann", "the crescent is right"),
        )
        row = page.locator("#rows tr", has_text="limb_matching")
        assert "accepted by Ann on" in row.locator("td.why").inner_text()
        assert row.locator("td.t-accepted").inner_text() == "accepted"
        assert (
            "accepted: PEBBLE by limb_matching: the crescent is right (Ann)" in page.locator("#decisions").inner_text()
        )
        assert "It was accepted by Ann" in page.locator("#words").inner_text()

        page.select_option("#show", "accepted")
        assert page.evaluate(shown) == ["visit0_b_short.fits: accepted"]
        page.select_option("#show", "suspect")
        assert page.evaluate(shown) == ["visit0_c_long.fits: suspect"]
        page.keyboard.press("s")  # the menu has the focus, and keeps the key
        page.focus("#stage")
        page.keyboard.press("s")
        page.wait_for_function("() => state.image.file === 'visit0_c_long.fits'")
        page.click("#discuss")
        _said(page, "review to discuss")
        page.select_option("#show", "to discuss")
        assert page.evaluate(shown) == ["visit0_c_long.fits: suspect"]
        page.click("#accept-attitude")
        _said(page, "attitude accepted")
        assert page.inner_text("#accept-attitude") == "restore attitude"
        page.click("#discuss")
        _said(page, "review restored")
        page.select_option("#show", "all")
        page.fill("#find", "A_LONG")
        assert page.evaluate(shown) == ["visit0_a_long.fits: ok"]
        page.fill("#find", "")
        page.select_option("#show", "unseen")
        assert page.evaluate(shown) == ["visit0_a_long.fits: ok"]


def test_an_outline_is_dragged_onto_the_body_and_the_image_solved_from_there(
    page: Page, campaign: Path, run: Path, made: Made
) -> None:
    file = "visit0_b_short.fits"
    predict_elsewhere(campaign)
    run_campaign(Campaign.load(campaign), workers=1)
    truth = CAMERA.model.project(made[1][file].position_camera_km)
    page.on("dialog", lambda dialog: dialog.accept("it is over there"))
    with served(run) as address:
        open_page(page, address)
        _show(page, file)
        assert page.locator("#film button.chosen.failed").count() == 1
        page.get_by_text("drag PEBBLE").click()
        at = page.evaluate("state.moved.at")
        page.mouse.move(*_place_of(page, at[0] + 3, at[1] - 2))
        page.mouse.down()
        page.mouse.move(*_place_of(page, *(truth + np.array([4.0, -3.0]))), steps=5)
        page.mouse.up()
        dragged = page.evaluate("state.moved.at")
        np.testing.assert_allclose(dragged, truth + np.array([1.0, -1.0]), rtol=0, atol=0.5)
        page.get_by_text("solve from here").click()
        _said(page, "solved", timeout=120000)
        (edit,) = read_edits(run).standing
        assert (edit.action, edit.target, edit.why) == ("start", "PEBBLE", "it is over there")
        np.testing.assert_allclose(edit.at_px or [], dragged, rtol=0, atol=1e-6)
        assert page.locator("#film button.chosen.ok").count() == 1
        assert page.locator("#marks > g[data-layer=start] path.line").count() == 1
        found = page.evaluate("state.image.fixes.map(fix => [fix.x, fix.y])")
        np.testing.assert_allclose(found, [truth, truth], rtol=0, atol=0.1)
        assert "set: the start of PEBBLE at (" in page.locator("#decisions").inner_text()


def test_limb_points_in_a_drawn_area_and_points_selected_in_the_table_are_rejected(page: Page, run: Path) -> None:
    file = "visit0_b_short.fits"
    page.on("dialog", lambda dialog: dialog.accept("a ridge"))
    with served(run) as address:
        open_page(page, address)
        _show(page, file)
        points = np.array(page.evaluate("state.image.layers.find(layer => layer.name === 'limb').points"))
        corners = np.array([points[:, 0].max() - 3.5, points[:, 1].min() - 5.0]), np.array([250.0, 180.0])
        inside = ((points > corners[0]) & (points < corners[1])).all(axis=1).sum()
        assert 5 < inside < len(points)
        page.click("#draw")
        page.mouse.move(*_place_of(page, *corners[0]))
        page.mouse.down()
        page.mouse.move(*_place_of(page, *corners[1]), steps=4)
        page.mouse.up()
        texts = page.locator("#drawn button").all_inner_texts()
        assert texts[:2] == ["mask it", f"reject {inside} limb points of limb_matching"]
        page.locator("#drawn button >> nth=1").click()
        _said(page, "mask drawn")
        assert len(read_edits(run).measuring()[file].areas["PEBBLE", "limb_matching"]) == inside
        assert page.locator("#marks > g[data-layer=mask]").count() == inside

        page.click("#tab-points")
        page.wait_for_selector("#rows tbody tr")
        assert page.locator("#rows tbody tr").count() > inside
        page.fill("#filter", "star")
        names = page.locator("#rows tbody tr td:nth-child(6)").all_inner_texts()[:2]
        page.locator("#rows tbody tr >> nth=0").click()
        page.wait_for_function("() => document.querySelector('#selected circle') !== null")
        for row in range(2):
            page.locator(f"#rows tbody tr >> nth={row}").locator("input").check()
        page.click("#reject-points")
        _said(page, "2 points rejected")
        stars = {str(edit.star) for edit in read_edits(run).standing if edit.star is not None}
        assert stars == set(names)
        page.click("#solve")
        _said(page, "solved", timeout=120000)
        left = page.evaluate("state.run.fixes.find(fix => fix.estimator === 'limb_matching').outcome")
        assert left == "ok"
        _show(page, file)
        used = np.array(page.evaluate("state.image.layers.find(layer => layer.name === 'limb').points"))
        assert not ((used > corners[0]) & (used < corners[1])).all(axis=1).any()


def test_the_page_shows_sky_zoom_profile_and_residuals_by_color(page: Page, run: Path) -> None:
    with served(run) as address:
        open_page(page, address)
        _show(page, "visit0_a_long.fits")
        before = float(page.inner_text("#zoom").split()[0])
        page.mouse.move(*_place_of(page, 100.0, 80.0))
        sky = "() => /ra [0-9.]+ deg +dec [-0-9.]+ deg/.test(document.getElementById('readout').textContent)"
        page.wait_for_function(sky)
        page.mouse.wheel(0, -400)
        zoomed = "before => parseFloat(document.getElementById('zoom').textContent) > 1.5 * before"
        page.wait_for_function(zoomed, arg=before)
        page.keyboard.press("0")
        page.locator("#opacity").fill("0.4")
        assert page.evaluate("getComputedStyle(document.getElementById('marks')).opacity") == "0.4"
        page.check("#by-residual")
        hues = page.evaluate(
            """() => [...document.querySelectorAll('#marks > g[data-layer=matches] g.mark')].map((mark, place) =>
                [state.image.layers.find(layer => layer.name === 'matches').sigmas[place], mark.style.stroke])"""
        )
        colors = {color for sigmas, color in hues if sigmas < 0.3} | {color for sigmas, color in hues if sigmas > 1.5}
        assert len(colors) > 1

        page.mouse.move(*_place_of(page, 100.0, 80.0))
        page.mouse.down(button="right")
        page.mouse.move(*_place_of(page, 160.0, 50.0), steps=4)
        page.mouse.up(button="right")
        look = page.evaluate("document.getElementById('picture').style.filter")
        factors = [float(number) for number in re.findall(r"[\d.]+", look)]
        assert len(factors) == 2
        assert min(factors) > 1.05
        page.select_option("#stretch", "log")
        assert page.evaluate("document.getElementById('picture').style.filter") == ""

        page.click("#draw")
        page.mouse.move(*_place_of(page, 40.0, 60.0))
        page.mouse.down()
        page.mouse.move(*_place_of(page, 140.0, 160.0), steps=4)
        page.mouse.up()
        page.get_by_text("profile from corner to corner").click()
        page.wait_for_selector("#chart svg")
        assert "along the line, px" in page.locator("#chart svg").inner_html()
