"""Mistakes that ``check --images`` finds in each image before a run fails on them; the Moon by real kernels."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from giantlike.campaign.check import check_campaign
from tests.campaign.test_campaign_run import kernels, write_moon_campaign

__all__ = ["kernels"]

Change = Callable[[dict[str, Any]], Any]


def in_metres(table: dict[str, Any]) -> None:
    table["targets"][0]["shape"]["radii_km"] = [1737.4e3] * 3


MISTAKES: dict[str, tuple[Change, str]] = {
    "target that SPICE does not know": (
        lambda table: table["targets"][0].update(name="MOOM"),
        "MOOM",
    ),
    "spacecraft without an ephemeris": (lambda table: table["spice"].update(spacecraft="-64"), "-64"),
    "frame that does not exist": (lambda table: table["targets"][0].update(frame="IAU_MOOM"), "IAU_MOOM"),
    "no orientation model": (
        lambda table: table["spice"].update(kernels=[name for name in table["spice"]["kernels"] if "pck" not in name]),
        "IAU_MOON",
    ),
    "radii in metres": (in_metres, "1e+03 times the mean radius in the loaded PCK"),
}


@pytest.mark.real_data
def test_a_right_campaign_has_no_mistake(tmp_path: Path, kernels: list[str]) -> None:
    path = write_moon_campaign(tmp_path, kernels, [])
    assert [str(one) for one in check_campaign(path, all_images=True) if one.fatal] == []


@pytest.mark.real_data
@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_told_before_the_run(name: str, tmp_path: Path, kernels: list[str]) -> None:
    change, text = MISTAKES[name]
    path = write_moon_campaign(tmp_path, kernels, [])
    table = tomllib.loads(path.read_text())
    change(table)
    path.write_text(tomli_w.dumps(table))
    found = [str(one) for one in check_campaign(path, all_images=True) if one.fatal]
    assert any(text in one for one in found), found
