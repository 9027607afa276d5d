"""A campaign rerun as images arrive."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.store.results import RunResult
from giantlike.campaign.store.run_folder import stamp_of
from giantlike.core.errors import OpNavError


def watch_campaign(
    path: Path,
    run: Callable[[Campaign], RunResult],
    *,
    every_s: float,
    announce: Callable[[str], None],
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Run a campaign, and rerun it when its file, an image or the geometry table changes or arrives; until interrupted.

    Errors are reported once and retried, as are images that are still being written.
    """
    seen, told = "", ""
    while True:
        try:
            campaign = Campaign.load(path)
            now = _state(campaign)
            if now != seen:
                result = run(campaign)
                seen = now
                announce(f"{len(result.attitudes)} images, {len(result.failed_images)} failed; waiting for more")
            told = ""
        except OpNavError as error:
            if str(error) != told:
                told = str(error)
                announce(f"waiting: {' '.join(told.split())}")
        wait(every_s)


def _state(campaign: Campaign) -> str:
    """State of the watched files, to detect changes."""
    files = [campaign.path, campaign.geometry_file, campaign.camera_file, *(entry.path for entry in campaign.images)]
    return " ".join(f"{file.name} {stamp_of(file)}" for file in files if file is not None)
