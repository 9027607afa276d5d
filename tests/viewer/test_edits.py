"""Decisions by users: edits that must match something, words of one line, and rejected things that stay visible."""

import json
from collections.abc import Mapping
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner, Result

from giantlike.campaign.store.edits import EDITS_FILE, Measuring, read_edits
from giantlike.campaign.store.records import AttitudeRecord
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.cli.app import app
from giantlike.viewer import Session, explain, layers_of
from giantlike.viewer.layers import REJECTED
from giantlike.viewer.server import application
from giantlike.viewer.session import verdict_of

TOKEN = "secret"
LONG, SHORT = "visit0_a_long.fits", "visit0_b_short.fits"
EXACT = 2**53  # integers beyond it are rounded by readers with double precision


def giantlike(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def client(run: Path) -> TestClient:
    client = TestClient(application(Session(run), TOKEN), base_url="http://127.0.0.1:8000")
    assert client.get(f"/?token={TOKEN}").status_code == 200
    return client


def _edit(client: TestClient, **wanted: Any) -> Any:
    return client.post("/api/edit", json=wanted, headers={"X-Token": TOKEN})


def _stars(run: Path) -> list[int]:
    record = RunFolder.open(run).load(AttitudeRecord, LONG)
    assert record is not None
    assert record.stars is not None
    return record.stars.star_ids


def _index(client: TestClient, file: str) -> int:
    return int(next(image["index"] for image in client.get("/api/run").json()["images"] if image["file"] == file))


def test_numbers_of_stars_leave_as_text_and_come_back_exactly(client: TestClient, run: Path) -> None:
    layers = client.get(f"/api/image/{_index(client, LONG)}").json()["layers"]
    shown = next(layer for layer in layers if layer["name"] == "matches")["star_ids"]
    known = _stars(run)
    assert shown == [str(number) for number in known]
    large = next(number for number in known if int(float(number)) != number)
    assert large > EXACT

    made = _edit(client, action="reject", what="star", file=LONG, star=str(large), why="double")
    assert made.status_code == 200, made.text
    assert made.json()[0]["star"] == str(large)
    assert read_edits(run).measuring() == {LONG: Measuring(rejected_stars=frozenset([large]))}
    assert json.loads((run / EDITS_FILE).read_text())["star"] == str(large)
    assert json.loads(giantlike("edit", run, "list", "--json").stdout)[0]["star"] == str(large)
    assert client.get(f"/api/image/{_index(client, LONG)}").json()["edits"][0]["star"] == str(large)
    rounded = _edit(client, action="reject", what="star", file=LONG, star=int(float(large)), why="double")
    assert rounded.status_code == 400
    assert str(large) in rounded.text


def test_an_edit_that_matches_nothing_is_refused_with_the_nearest(client: TestClient, run: Path) -> None:
    known = _stars(run)
    why = ("--why", "a trial")
    star = giantlike("edit", run, "reject", LONG, "--star", "12345", *why)
    assert star.exit_code == 2
    assert f"star 12345 is not one of its {len(known)} matched stars" in star.stderr
    assert str(min(known)) in star.stderr
    restored = giantlike("edit", run, "restore", LONG, *why)
    assert restored.exit_code == 2
    assert "there is no decision on the image; decided on: nothing" in restored.stderr
    assert _edit(client, action="restore", what="star", file=LONG, star=str(known[0]), why="x").status_code == 400
    fix = giantlike("edit", run, "reject", SHORT, "--target", "PEBBLE", "--estimator", "limb", *why)
    assert fix.exit_code == 2
    assert "PEBBLE by limb_matching" in fix.stderr
    assert read_edits(run).edits == ()

    assert giantlike("edit", run, "reject", LONG, "--star", str(known[0]), *why).exit_code == 0
    other = giantlike("edit", run, "restore", LONG, "--star", str(known[1]), *why)
    assert other.exit_code == 2
    assert f"star {known[0]}" in other.stderr
    assert giantlike("edit", run, "restore", LONG, "--star", str(known[0]), *why).exit_code == 0
    assert read_edits(run).standing == []


def test_an_image_may_be_named_by_its_beginning_where_only_one_fits(run: Path) -> None:
    several = giantlike("edit", run, "reject", "visit0", "--why", "smear")
    assert several.exit_code == 2
    assert LONG in several.stderr
    assert SHORT in several.stderr
    assert "nearest" in giantlike("edit", run, "reject", "visit9_b_short", "--why", "smear").stderr
    done = giantlike("edit", run, "reject", "visit0_b", "--why", "smear")
    assert done.exit_code == 0, done.stderr
    assert [edit.file for edit in read_edits(run).standing] == [SHORT]


@pytest.mark.parametrize(
    "why", ["a\n2026-01-01 bob: reject image x: forged", "a\u2028b", "a\x1b[2Jb", "x" * 501, " \t"]
)
def test_a_reason_is_one_short_line(client: TestClient, run: Path, why: str) -> None:
    assert giantlike("edit", run, "reject", SHORT, "--why", why).exit_code == 2
    assert _edit(client, action="reject", what="image", file=SHORT, why=why).status_code == 400
    assert giantlike("edit", run, "reject", SHORT, "--why", "smear", "--who", "ann\nbob").exit_code == 2
    assert not (run / EDITS_FILE).exists()


def test_a_newline_in_an_older_list_forges_no_line(run: Path) -> None:
    edit = {
        "action": "reject",
        "what": "image",
        "file": SHORT,
        "who": "ann",
        "when_utc": "2026",
        "why": "a\n2027 bob: all",
    }
    (run / EDITS_FILE).write_text(json.dumps(edit) + "\n")
    assert len(giantlike("edit", run, "list").stdout.splitlines()) == 1


_STAR = b'{"action": "reject", "what": "star", "file": "visit0_a_long.fits", "why": "x", "star": '
MALFORMED: Mapping[str, tuple[str, bytes, str]] = {
    "no JSON": ("/api/edit", b"nothing", "a JSON object is needed"),
    "no text": ("/api/edit", b"\xff\xfe\x00", "a JSON object is needed"),
    "a list": ("/api/edit", b"[]", "got a list"),
    "nothing": ("/api/solve", b"", "a JSON object is needed"),
    "deep": ("/api/edit", b"[" * 9000, "a JSON object is needed"),
    "long": ("/api/edit", b'"' + b"x" * 500_000 + b'"', "at most"),
    "half a letter": ("/api/edit", b'{"action": "reject", "what": "image", "file": "\\ud800", "why": "x"}', "no image"),
    "a number for a reason": ("/api/edit", b'{"action": "reject", "what": "image", "file": "x", "why": 1}', "why"),
    "no reason": ("/api/edit", b'{"action": "reject", "what": "image", "file": "visit0_b_short.fits"}', "why"),
    "a star of other digits": ("/api/edit", _STAR + b'"x"}', "star"),
    "a huge star": ("/api/edit", _STAR + b"1" + b"0" * 60 + b"}", "not one of"),
    "x = nan": ("/api/pixel/0?x=nan&y=1", b"", "x must be a number"),
    "x = inf": ("/api/pixel/0?x=1e999&y=1", b"", "x must be a number"),
    "x of letters": ("/api/pixel/0?x=left&y=1", b"", "x must be a number"),
    "no y": ("/api/pixel/0?x=1", b"", "y is missing"),
    "no chart": ("/chart/0.svg", b"", "which is missing"),
    "an image far out": ("/api/image/99999999999999999999", b"", "there is no image"),
}  # fmt: skip


@pytest.mark.parametrize("case", MALFORMED)
def test_a_malformed_request_is_refused_in_a_sentence(client: TestClient, case: str) -> None:
    path, body, words = MALFORMED[case]
    sends = path in ("/api/edit", "/api/solve")
    answer = client.post(path, content=body, headers={"X-Token": TOKEN}) if sends else client.get(path)
    assert answer.status_code == 400
    assert words in answer.text
    assert len(answer.text) < 1000
    assert "\n" not in answer.text


def test_a_token_of_other_letters_is_a_wrong_token(run: Path) -> None:
    client = TestClient(application(Session(run), TOKEN), base_url="http://127.0.0.1:8000")
    assert client.get("/?token=%C3%A9").status_code == 403


def test_runs_on_two_ports_of_one_browser_do_not_lock_each_other_out(run: Path) -> None:
    jar: SimpleCookie = SimpleCookie()  # a browser has one for all ports of a machine
    clients = {}
    for port, token in ((8001, "one"), (8002, "two")):
        clients[port] = TestClient(application(Session(run), token), base_url=f"http://127.0.0.1:{port}")
        jar.load(clients[port].get(f"/?token={token}").headers["set-cookie"])
    header = "; ".join(f"{name}={cookie.value}" for name, cookie in jar.items())
    for client in clients.values():
        client.cookies.clear()
        assert client.get("/api/run", headers={"Cookie": header}).status_code == 200


def test_the_page_runs_no_script_but_that_of_its_own_file(client: TestClient) -> None:
    answer = client.get("/")
    policy = {part.split()[0]: part for part in str(answer.headers["Content-Security-Policy"]).split("; ")}
    assert "unsafe" not in policy.get("script-src", policy["default-src"])
    assert answer.text.count("<script") == answer.text.count('<script src="view.js"></script>') == 1
    for name in ("view.js", "view.css"):
        part = client.get(f"/{name}")
        assert part.status_code == 200
        assert "https://" not in part.text
        assert part.text.count("http://") == part.text.count("http://www.w3.org/")


def test_a_rejected_star_stays_visible_where_it_was_before_and_after_it_is_solved_again(run: Path) -> None:
    record = RunFolder.open(run).load(AttitudeRecord, LONG)
    assert record is not None
    assert record.stars is not None
    star, place = record.stars.star_ids[3], record.stars.observed_px[3]
    assert giantlike("edit", run, "reject", LONG, "--star", str(star), "--why", "double").exit_code == 0
    for solved in (False, True):
        if solved:
            assert giantlike("run", run.parent / "campaign.toml", "--workers", "1").exit_code == 0
            assert star not in _stars(run)
        layers = {layer.name: layer for layer in layers_of(Session(run).seen(LONG))}
        shown = layers["rejected-stars"]
        assert shown.rejected
        assert list(shown.star_ids) == [star]
        np.testing.assert_allclose(shown.layer.points, [place], rtol=0, atol=1e-9)
        assert "double" in shown.labels[0]
        assert star not in layers["matches"].star_ids


def test_a_rejected_image_and_a_rejected_fix_stay_visible_as_rejected(run: Path) -> None:
    before = {(layer.name, len(layer.layer.points)) for layer in layers_of(Session(run).seen(SHORT))}
    fix = ("--target", "PEBBLE", "--estimator", "limb_matching")
    assert giantlike("edit", run, "reject", SHORT, *fix, "--why", "wrong edge").exit_code == 0
    seen = Session(run).seen(SHORT)
    layers = layers_of(seen)
    assert {(layer.name, len(layer.layer.points)) for layer in layers} == before
    marked = [layer for layer in layers if layer.rejected]
    assert {layer.name for layer in marked} >= {"fitted", "centers", "limb"}
    assert all("limb_matching" in layer.title and "wrong edge" in layer.title for layer in marked)
    assert {layer.layer.color for layer in marked} == {REJECTED}
    assert any(layer.name == "centers" and not layer.rejected for layer in layers)
    assert "limb_matching: rejected" in explain(seen)

    assert giantlike("edit", run, "restore", SHORT, *fix, "--why", "right after all").exit_code == 0
    for file in (SHORT, LONG):
        before = {(layer.name, len(layer.layer.points)) for layer in layers_of(Session(run).seen(file))}
        assert giantlike("edit", run, "reject", file, "--why", "smear").exit_code == 0
        seen = Session(run).seen(file)
        layers = layers_of(seen)
        assert {(layer.name, len(layer.layer.points)) for layer in layers} == before
        assert {layer.name for layer in layers if not layer.rejected} <= {"predicted"}
        assert verdict_of(seen.record, seen.observations) == "rejected"


def test_what_is_rejected_counts_as_rejected(run: Path) -> None:
    assert giantlike("edit", run, "reject", LONG, "--why", "smear").exit_code == 0
    status = giantlike("status", run)
    assert "attitudes: 3 of 3 done: 2 ok, 1 rejected" in status.stdout
    counts = json.loads(giantlike("status", run, "--json").stdout)["steps"]["attitudes"]["statuses"]
    assert counts == {"ok": 2, "rejected": 1}
    assert Session(run).result.failed_images == ()


def test_explain_has_the_order_of_all_other_commands(run: Path) -> None:
    first, option = giantlike("explain", run, "visit0_b"), giantlike("explain", "visit0_b", "--run", run)
    assert first.exit_code == option.exit_code == 0, first.stderr
    assert first.stdout == option.stdout
    assert SHORT in first.stdout
    assert "an IMAGE is needed; there are 3" in giantlike("explain", run).stderr
    assert "RUN IMAGE" in giantlike("explain", "visit0_b").stderr
    assert giantlike("explain", run, "visit0_b", "--run", run).exit_code == 2
