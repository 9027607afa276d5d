"""A finished run to look at."""

import shutil
from pathlib import Path

import pytest

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from tests.campaign_files import Truth, write_campaign


@pytest.fixture(scope="package")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Truth]]:
    """Campaign file of a finished run, and the truth of its images."""
    path, truth = write_campaign(tmp_path_factory.mktemp("bench"), visits=1)
    run_campaign(Campaign.load(path), workers=1)
    return path, truth


@pytest.fixture
def campaign(made: tuple[Path, dict[str, Truth]], tmp_path: Path) -> Path:
    """Campaign file of a copy of that run, to be edited."""
    shutil.copytree(made[0].parent, tmp_path / "copy")
    return tmp_path / "copy" / made[0].name


@pytest.fixture
def run(campaign: Path) -> Path:
    return Campaign.load(campaign).output
