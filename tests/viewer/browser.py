"""A server of a run and a headless Chromium to look at it, for tests and benchmarks."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import uvicorn
from playwright.sync_api import Page, sync_playwright

from giantlike.campaign.store.records import AttitudeRecord, ImageRecord, ObservationRecord, TargetRecord
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.viewer import Session
from giantlike.viewer.server import LOOPBACK, application

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)
_TOKEN = "secret"


@contextmanager
def served(run: Path, other: Path | None = None) -> Iterator[str]:
    """Address of a server of the run, and of another one beside it."""
    app = application(Session(run), _TOKEN, None if other is None else Session(other))
    server = uvicorn.Server(uvicorn.Config(app, host=LOOPBACK, port=0, log_level="error"))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive()
        port = server.servers[0].sockets[0].getsockname()[1]
        yield f"http://{LOOPBACK}:{port}/?token={_TOKEN}"
    finally:
        server.should_exit = True
        thread.join()


@contextmanager
def chromium_page() -> Iterator[Page]:
    """An empty page of a headless Chromium."""
    with sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=CHROMIUM, args=list(_FLAGS))
        yield browser.new_context(viewport={"width": 1400, "height": 900}).new_page()
        browser.close()


def open_page(page: Page, address: str) -> float:
    """Open the bench and wait until its first image is shown; milliseconds since the address was called."""
    page.goto(address)
    page.wait_for_selector("body[data-ready=yes]", timeout=60000)
    spent: float = page.evaluate("performance.now()")
    return spent


def multiply(run: Path, count: int) -> None:
    """Make a run of so many images, whose records are those of its images over and over."""
    folder = RunFolder.open(run)
    kinds: tuple[type[ImageRecord], ...] = (AttitudeRecord, ObservationRecord, TargetRecord)
    whole: dict[str, list[ImageRecord]] = {}
    for kind in kinds:
        for light in folder.load_all(kind):
            full = folder.load(kind, light.file, light.subject)
            assert full is not None
            whole.setdefault(light.file, []).append(full)
    paths = {record.file: record.path for record in folder.load_all(AttitudeRecord)}
    originals = list(paths)
    files = [(f"image{number:04d}.fits", originals[number % len(originals)]) for number in range(count)]
    with folder.writing():
        folder.set_images([(file, paths[original]) for file, original in files])
        for number, (file, original) in enumerate(files):
            for record in whole[original]:
                folder.save(record.replace(file=file, index=number), "key")


def with_rejected_match(run: Path, file: str, place_px: list[float]) -> None:
    """Give the stars of an image a match that was thrown out."""
    folder = RunFolder.open(run)
    record = folder.load(AttitudeRecord, file)
    assert record is not None
    assert record.stars is not None
    with folder.writing():
        folder.save(record.replace(stars=record.stars.replace(rejected_px=[place_px])), "key")
