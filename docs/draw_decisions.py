"""Pictures of the session on docs/decisions.md, by the steps that the page describes.

    python docs/draw_decisions.py demo-output          # writes docs/images/decisions_*.png

Needs what ``draw_session.py`` needs. The copy of the demo gets a wrong prediction for one image and a declared error of
the trajectory that is too small for another.
"""

from __future__ import annotations

import csv
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from draw_session import SIZE, WAIT_MS, solve, take, viewed
from playwright.sync_api import Page, sync_playwright

ERROR_KM = 0.9
"""By which the prediction of an image is wrong, across the line of sight."""
EPHEMERIS_KM = 0.8
"""Declared error of the trajectory."""
SUSPECT, ELSEWHERE, RIDGE = "rock_01_short.fits", "rock_08_short.fits", "rock_10_short.fits"
FIRST_POINT, POINTS = 40, 10
REASONS = {
    SUSPECT: "nothing else of this size is near; the template and the unresolved body agree to 0.01 px",
    ELSEWHERE: "the trajectory of this image is from before the maneuver",
    RIDGE: "a boulder on the limb that the shape does not have",
}
"""As on the page."""


def prepare(demo: Path) -> None:
    """Make one prediction wrong and declare the error of the trajectory, and run the campaign."""
    table = demo / "geometry.csv"
    rows = list(csv.DictReader(table.open(encoding="utf-8")))
    axes = [f"target_{axis}_km" for axis in "xyz"]
    (row,) = (row for row in rows if row["file"] == ELSEWHERE)
    position = np.array([float(row[name]) for name in axes])
    across = np.cross(position, [0.0, 0.0, 1.0])
    moved = position + ERROR_KM * across / np.linalg.norm(across)
    moved *= np.linalg.norm(position) / np.linalg.norm(moved)
    row |= {name: repr(float(value)) for name, value in zip(axes, moved, strict=True)}
    with table.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    campaign = demo / "campaign.toml"
    text = campaign.read_text(encoding="utf-8")
    rock = 'shape = "shapes/rock.obj"\n'
    assert rock in text, f"needed a target of shapes/rock.obj in {campaign}"
    declared = f"uncertainty = {{ ephemeris_km = {EPHEMERIS_KM} }}\n"
    campaign.write_text(text.replace(rock, rock + declared), encoding="utf-8")
    subprocess.run([sys.executable, "-m", "giantlike", "run", str(campaign)], check=False, stdout=subprocess.DEVNULL)


def show(page: Page, file: str) -> None:
    """Find an image by its name and show it."""
    page.select_option("#show", "all")
    page.fill("#find", file)
    page.click(f"#film button[title^='{file}']")
    page.wait_for_function("file => state.image && state.image.file === file", arg=file, timeout=WAIT_MS)
    page.fill("#find", "")
    page.wait_for_timeout(1000)


def screen(page: Page, x: float, y: float) -> list[float]:
    """Where a pixel of the image is on the screen."""
    at: list[float] = page.evaluate(
        """([x, y]) => {
            const at = new DOMPoint(x, y).matrixTransform(document.getElementById('marks').getScreenCTM());
            return [at.x, at.y];
        }""",
        [x, y],
    )
    return at


def zoom_to(page: Page, x: float, y: float, wheel: int) -> None:
    """Zoom in on a pixel with the wheel."""
    page.mouse.move(*screen(page, x, y))
    page.mouse.wheel(0, wheel)
    page.wait_for_timeout(1500)


def drag(page: Page, begin: list[float], end: list[float]) -> None:
    """Drag from a pixel to another one."""
    page.mouse.move(*screen(page, *begin))
    page.mouse.down()
    page.mouse.move(*screen(page, *end), steps=8)
    page.mouse.up()


def away(page: Page) -> None:
    """Take the pointer off the image, so that nothing is read there."""
    page.mouse.move(5, 5)
    page.wait_for_timeout(1000)


def said(page: Page, words: str) -> None:
    """Wait for words of the page."""
    page.wait_for_function(
        "words => document.getElementById('message').textContent.includes(words)", arg=words, timeout=WAIT_MS
    )
    print(page.inner_text("#message"))


def main() -> None:
    """Carry out the session."""
    truth = {row["file"]: row for row in csv.DictReader((Path(sys.argv[1]) / "truth.csv").open(encoding="utf-8"))}
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as tools:
        demo = Path(shutil.copytree(sys.argv[1], Path(folder) / "demo-output"))
        prepare(demo)
        chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
        browser = tools.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport=SIZE)
        page.on(
            "dialog", lambda dialog: dialog.accept(next(REASONS[file] for file in REASONS if file in dialog.message))
        )
        with viewed(demo / "run") as address:
            page.goto(address)
            page.wait_for_selector("body[data-ready=yes]", timeout=WAIT_MS)
            print(page.inner_text("#count"))
            page.fill("#who", "Ann")
            page.focus("#stage")
            page.keyboard.press("s")
            page.wait_for_function("file => state.image.file === file", arg=SUSPECT, timeout=WAIT_MS)
            page.wait_for_timeout(1000)
            center = page.evaluate("(fix => [fix.x, fix.y])(state.image.fixes.find(fix => fix.x))")
            zoom_to(page, *center, -2200)
            row = page.locator("#rows tr.chosen", has_text="cross_correlation")
            row.get_by_text("accept", exact=True).click()
            said(page, "fix accepted")
            away(page)
            take(page, "decisions_accept")

            show(page, ELSEWHERE)
            body = [float(truth[ELSEWHERE][name]) for name in ("x_px", "y_px")]
            page.get_by_text("drag ROCK").click()
            at = page.evaluate("state.moved.at")
            drag(page, [at[0] + 5, at[1] + 5], [body[0] + 7, body[1] + 3])
            away(page)
            take(page, "decisions_start")
            page.get_by_text("solve from here").click()
            said(page, "solved")
            print(page.evaluate("state.image.fixes.map(fix => [fix.estimator, fix.words, fix.x, fix.y])"), body)

            show(page, RIDGE)
            points = page.evaluate("state.image.layers.find(layer => layer.name === 'limb').points")
            some = np.array(points[FIRST_POINT : FIRST_POINT + POINTS])
            zoom_to(page, *some.mean(axis=0).tolist(), -1700)
            page.click("#draw")
            drag(page, (some.min(axis=0) - 0.4).tolist(), (some.max(axis=0) + 0.4).tolist())
            away(page)
            take(page, "decisions_limb")
            page.locator("#drawn button", has_text="limb point").first.click()
            said(page, "mask drawn")
            solve(page)
            print(page.inner_text("#message"))
        campaign = demo / "campaign.toml"
        command = [sys.executable, "-m", "giantlike", "dossier", str(demo / "run"), "--output", str(demo / "dossier")]
        subprocess.run([*command, "--campaign", str(campaign)], check=True)
        page.goto(f"file://{demo}/dossier/dossier.html#edits")
        page.wait_for_timeout(1000)
        take(page, "decisions_dossier")
        browser.close()


if __name__ == "__main__":
    main()
