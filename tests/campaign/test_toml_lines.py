"""Lines of keys for messages: found for every name, also a broken one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tomli_w

from giantlike.campaign.check import check_campaign
from giantlike.campaign.file.toml_file import line_of, lines_of_keys
from giantlike.terrain import HeightMap
from tests.campaign_files import campaign_table, write_campaign

LINES = lines_of_keys("[a]\nb = 1\n[[c]]\nd = 2\n[[c]]\ne = 3\n")


@pytest.mark.parametrize(
    ("key", "line"),
    [("c[1].e", 6), ("c[1].e.f[3]", 6), ("c[1]", 5), ("c[1", None), ("c[", None), ("a.", 1), ("]", None)],
)
def test_the_search_for_a_line_ends_at_the_nearest_name(key: str, line: int | None) -> None:
    assert line_of(key, LINES) == line


def test_terrain_beside_an_atmosphere_is_told_with_the_line_of_its_target(tmp_path: Path) -> None:
    path, _ = write_campaign(tmp_path / "campaign", visits=1)
    table = campaign_table()
    latitude, longitude = np.radians(np.meshgrid(np.arange(80, -90, -20), np.arange(0, 360, 20), indexing="ij"))
    HeightMap.from_array(0.01 * np.sin(latitude + longitude), reference_radii_km=[1.0] * 3).save(tmp_path / "map.npz")
    round_body = {"shape": {"radii_km": [1.0, 1.0, 1.0]}, "estimators": ["moment"]}
    limb = {"terrain": str(tmp_path / "map.npz"), "atmosphere": "EARTH"}
    table["targets"] = [{"name": "ONE"} | round_body, {"name": "TWO"} | round_body | limb]
    path.write_text(tomli_w.dumps(table))
    told = [one for one in check_campaign(path) if "give either terrain or atmosphere" in one.text]
    assert len(told) == 1
    assert told[0].key == "targets[1]"
    assert told[0].line == lines_of_keys(path.read_text())["targets[1]"]
