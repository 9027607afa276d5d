"""The bench in a browser, asked without one: who is let in, what it answers, edits and solutions."""

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from starlette.testclient import TestClient

from giantlike.campaign.store.edits import read_edits
from giantlike.campaign.store.fix_differences import difference_of
from giantlike.viewer import Session
from giantlike.viewer.server import application
from tests.viewer.conftest import Made

TOKEN = "secret"


@pytest.fixture
def client(run: Path) -> TestClient:
    client = TestClient(application(Session(run), TOKEN), base_url="http://127.0.0.1:8000")
    assert client.get(f"/?token={TOKEN}").status_code == 200
    return client


def _post(client: TestClient, path: str, content: dict[str, Any]) -> Any:
    return client.post(path, json=content, headers={"X-Token": TOKEN})


def _index(client: TestClient, file: str) -> int:
    images = client.get("/api/run").json()["images"]
    return int(next(image["index"] for image in images if image["file"] == file))


def test_nobody_is_let_in_without_the_token_or_under_a_foreign_name(run: Path) -> None:
    app = application(Session(run), TOKEN)
    stranger = TestClient(app, base_url="http://127.0.0.1:8000")
    assert stranger.get("/").status_code == 403
    assert stranger.get("/api/run?token=guess").status_code == 403
    rebound = TestClient(app, base_url="http://evil.example:8000")
    assert rebound.get(f"/?token={TOKEN}").status_code == 403


def test_nothing_is_changed_without_the_header_that_other_pages_cannot_send(client: TestClient, run: Path) -> None:
    edit = {"action": "reject", "what": "image", "file": "visit0_b_short.fits", "why": "a trial"}
    assert client.post("/api/edit", json=edit).status_code == 403
    assert read_edits(run).edits == ()


def test_the_page_loads_nothing_from_elsewhere(client: TestClient) -> None:
    for name in ("", "view.js", "view.css"):
        page = client.get(f"/{name}").text
        assert "https://" not in page
        assert page.count("http://") == page.count("http://www.w3.org/")
    assert "default-src 'self'" in client.get("/").headers["Content-Security-Policy"]


def test_an_image_comes_with_layers_words_and_fixes(client: TestClient) -> None:
    image = client.get(f"/api/image/{_index(client, 'visit0_b_short.fits')}").json()
    assert {"predicted", "centers"} <= {layer["name"] for layer in image["layers"]}
    assert "Attitude: ok" in image["words"]
    assert all(fix["file"] == "visit0_b_short.fits" for fix in image["fixes"])


@pytest.mark.parametrize("kind", ["image", "template", "difference"])
def test_pictures_have_the_pixels_of_the_image(client: TestClient, kind: str) -> None:
    index = _index(client, "visit0_b_short.fits")
    target = client.get(f"/api/image/{index}").json()["targets"][0]
    answer = client.get(f"/picture/{index}.png", params={"kind": kind, "target": target, "stretch": "linear"})
    assert answer.status_code == 200, answer.text
    picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape[:2] == (280, 320)
    assert picture.std() > 1.0


def test_charts_and_the_readout_of_a_pixel(client: TestClient) -> None:
    index = _index(client, "visit0_b_short.fits")
    for chart in client.get(f"/api/image/{index}").json()["charts"]:
        asked = {name: value for name, value in chart.items() if name != "title"}
        answer = client.get(f"/chart/{index}.svg", params=asked)
        assert answer.status_code == 200, answer.text
        assert answer.text.startswith("<svg")
    fix = next(fix for fix in client.get(f"/api/image/{index}").json()["fixes"] if fix["x"] is not None)
    seen = client.get(f"/api/pixel/{index}", params={"x": fix["x"], "y": fix["y"]}).json()
    assert {"dn", "range", "phase", "incidence", "emission", "latitude", "longitude"} <= seen.keys()
    sky = client.get(f"/api/pixel/{index}", params={"x": 2, "y": 2}).json()
    assert set(sky) == {"dn", "ra", "dec"}


def test_mistakes_are_told_in_words(client: TestClient) -> None:
    assert "there is no image 99" in client.get("/api/image/99").text
    assert "there is no stretch" in client.get("/picture/0.png?stretch=odd").text
    assert "there is no argument" in client.get("/api/run?odd=1").text
    assert client.get("/api/run?odd=1").status_code == 400


def test_a_star_is_rejected_and_the_image_solved_again(client: TestClient, run: Path) -> None:
    file = "visit0_a_long.fits"
    index = _index(client, file)
    before = client.get(f"/api/image/{index}").json()
    matched = next(layer for layer in before["layers"] if layer["name"] == "matches")["star_ids"]
    star = matched[0]
    wanted = {"action": "reject", "what": "star", "file": file, "star": star, "why": "it is double"}
    assert _post(client, "/api/edit", wanted).status_code == 200
    assert _post(client, "/api/edit", wanted | {"why": " "}).status_code == 400

    _post(client, "/api/solve", {})
    until = time.monotonic() + 120.0
    while (now := client.get("/api/solve").json())["state"] == "at work" and time.monotonic() < until:
        time.sleep(0.1)

    assert now["state"] == "done", now
    after = next(layer for layer in client.get(f"/api/image/{index}").json()["layers"] if layer["name"] == "matches")
    assert star not in after["star_ids"]
    assert len(after["star_ids"]) >= 0.95 * len(matched) - 1
    assert [edit.why for edit in read_edits(run).standing] == ["it is double"]


def test_estimators_are_compared_over_the_whole_covariance_of_their_difference(client: TestClient, run: Path) -> None:
    rows = client.get("/api/compare").json()
    records = {(one.file, one.estimator): one for one in Session(run).result.observations}
    assert rows
    for row in rows:
        apart = difference_of(records[row["file"], row["estimator"]], records[row["file"], row["minus"]])
        assert apart is not None
        assert row["sigmas"] == pytest.approx(apart.sigmas)
        assert row["sigmas"] < 5.0
        assert row["d_range_percent"] is not None


def test_the_terminator_and_the_residual_map_are_drawn_when_they_are_asked_for(client: TestClient) -> None:
    index = _index(client, "visit0_b_short.fits")
    lines = client.get(f"/api/terminator/{index}").json()
    assert {line["name"] for line in lines} == {"terminator"}
    chart = next(chart for chart in client.get(f"/api/image/{index}").json()["charts"] if chart["which"] == "map")
    picture = client.get(f"/chart/{index}.svg", params={key: chart[key] for key in ("which", "target", "estimator")})
    assert "data:image/png" in picture.text
    refused = client.get(f"/chart/{index}.svg", params={"which": "map", "target": "PEBBLE", "estimator": "astrology"})
    assert refused.status_code == 400


def test_the_sky_under_the_pointer_and_a_profile_are_those_of_the_image(made: Made, client: TestClient) -> None:
    files = [image["file"] for image in client.get("/api/run").json()["images"]]
    index = files.index("visit0_a_long.fits")
    x, y = 30.5, 220.25
    seen = client.get(f"/api/pixel/{index}?x={x}&y={y}").json()
    ray = np.array([(x - 160.3) / 900.0, (y - 139.6) / 900.0, 1.0])  # the camera of the test, by hand
    east, north, up = made[1][files[index]].camera_from_inertial.as_matrix().T @ ray / np.linalg.norm(ray)
    assert seen["ra"] == pytest.approx(np.degrees(np.arctan2(north, east)) % 360.0, abs=1e-3)
    assert seen["dec"] == pytest.approx(np.degrees(np.arcsin(up)), abs=1e-3)
    answer = client.get(f"/chart/{index}.svg?which=profile&line=3,4,60,70")
    assert answer.status_code == 200
    assert "from (3.0, 4.0) to (60.0, 70.0)" in answer.text
    for line, words in (("1,2,3", "a line is x,y,x,y"), ("1,2,3,x", "line must be a number"), ("0,0,9,900", "leaves")):
        refused = client.get(f"/chart/{index}.svg?which=profile&line={line}")
        assert refused.status_code == 400
        assert words in refused.text
