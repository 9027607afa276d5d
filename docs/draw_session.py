"""Pictures of the session on docs/sessions.md, by the steps that the page describes.

    python docs/draw_session.py demo-output            # writes docs/images/session_doubt.png and session_decision.png

Needs the folder of ``giantlike demo``, which is copied and left as it is, and Chromium with playwright (the extra
``dev``). The page of ``giantlike view`` is opened and clicked as a user would.
"""

from __future__ import annotations

import io
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from PIL import Image
from playwright.sync_api import Page, sync_playwright

IMAGES = Path(__file__).parent / "images"
BODY = "rock_05_short.fits"
WHY = "26 limb points on a crescent 30 px across: the template, which has all the light, stands for this image"
"""As on the page."""
SIZE = {"width": 1180, "height": 720}
WAIT_MS = 180_000
ZOOM = -2200  # of the wheel
COLORS = 256


def _wait_for(address: str) -> None:
    """Wait until the server of an address, which is printed before it listens, takes connections."""
    place = urlsplit(address)
    for _ in range(WAIT_MS // 100):
        try:
            socket.create_connection((str(place.hostname), int(place.port or 80))).close()
        except ConnectionRefusedError:
            time.sleep(0.1)
        else:
            return
    sys.exit(f"nothing listens at {address}")


@contextmanager
def viewed(run: Path) -> Iterator[str]:
    """Address of the page of a run."""
    command = [sys.executable, "-m", "giantlike", "view", str(run), "--no-browser"]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as server:
        assert server.stdout is not None
        try:
            for line in server.stdout:
                found = re.search(r"http://\S+", line)
                if found:
                    _wait_for(found[0])
                    yield found[0]
                    return
            sys.exit("giantlike view ended without an address")
        finally:
            server.terminate()


def solve(page: Page) -> None:
    """Press `solve again` and wait."""
    page.click("#solve")
    page.wait_for_function("() => document.getElementById('message').textContent.startsWith('solved')", timeout=WAIT_MS)


def show_body(page: Page) -> None:
    """Click the row of the body, and zoom in with the wheel."""
    page.fill("#filter", BODY.removesuffix("_short.fits"))
    page.click("#rows tbody tr >> nth=0")
    page.wait_for_function("file => state.image && state.image.file === file", arg=BODY, timeout=WAIT_MS)
    page.wait_for_timeout(1000)
    center = page.evaluate("[state.image.fixes.find(fix => fix.x).x, state.image.fixes.find(fix => fix.x).y]")
    place = page.evaluate(
        """([x, y]) => {
            const view = document.getElementById('view');
            const at = new DOMPoint(x, y).matrixTransform(document.getElementById('marks').getScreenCTM());
            return [at.x, at.y];
        }""",
        center,
    )
    page.mouse.move(*place)
    page.mouse.wheel(0, ZOOM)
    page.wait_for_function("() => document.getElementById('readout').textContent.includes('range')", timeout=WAIT_MS)
    page.wait_for_timeout(1000)


def take(page: Page, name: str) -> None:
    """Write a picture of the page with few colors."""
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB").quantize(COLORS)
    picture.save(IMAGES / f"{name}.png", optimize=True)
    print(f"{name}.png: {(IMAGES / f'{name}.png').stat().st_size} bytes")


def main() -> None:
    """Carry out the session."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as tools:
        demo = Path(shutil.copytree(sys.argv[1], Path(folder) / "demo-output"))
        campaign = demo / "campaign.toml"
        text = campaign.read_text(encoding="utf-8")
        changed = re.sub(r'("unresolved",\s*)("cross_correlation")', r'\1"moment", \2', text, count=1)
        assert changed != text, f"needed unresolved and cross_correlation among the estimators of {campaign}"
        campaign.write_text(changed, encoding="utf-8")
        chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
        browser = tools.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport=SIZE)
        page.on("dialog", lambda dialog: dialog.accept(WHY))
        with viewed(demo / "run") as address:
            page.goto(address)
            page.wait_for_selector("body[data-ready=yes]", timeout=WAIT_MS)
            solve(page)
            show_body(page)
            page.click("#terminator")
            page.wait_for_function("() => document.getElementById('message').textContent === ''", timeout=WAIT_MS)
            page.click("text=ROCK: along the limb")
            page.wait_for_selector("#chart svg", timeout=WAIT_MS)
            page.click("#tab-compare")
            page.wait_for_selector("#rows tbody tr", timeout=WAIT_MS)
            page.locator("#layers input[data-layer=fitted]").check()
            page.wait_for_timeout(1000)
            take(page, "session_doubt")
            page.click("#tab-fixes")
            row = page.locator("#rows tbody tr", has_text="limb_matching").first
            row.locator("button").click()
            page.wait_for_function(
                "() => document.getElementById('message').textContent.includes('rejected')", timeout=WAIT_MS
            )
            solve(page)
            page.locator("#layers input[data-layer=fitted]").check()
            page.wait_for_timeout(3000)
            take(page, "session_decision")
        browser.close()


if __name__ == "__main__":
    main()
