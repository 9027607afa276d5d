"""What a notebook shows: short words, a picture, axes to draw on, tables with units."""

import base64
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import giantlike as gl
from giantlike.campaign.store.results import RunResult
from giantlike.core.errors import InputError
from giantlike.viewer import Session
from tests.campaign_files import CAMERA
from tests.sizes import slow

LONGEST = 250


@pytest.fixture
def shown(run: Path) -> dict[str, object]:
    """One of each kind of value of a run."""
    session = Session(run)
    bench = session.workbench
    image = session.image("visit0_b_short.fits")
    stars = session.image("visit0_a_long.fits")
    assert bench.navigation is not None
    geometry = session.geometry("visit0_b_short.fits", image=image)["PEBBLE"]
    scene = gl.Scene(
        targets=(
            gl.Target(
                name="PEBBLE",
                shape=geometry.target.shape,
                ephemeris=geometry.target.ephemeris,
            ),
        )
    )
    return {
        "image": image,
        "camera": CAMERA,
        "scene": scene,
        "attitude": bench.navigation.solve(stars).unwrap(),
        "fix": gl.LimbMatching().estimate(image, CAMERA, scene).unwrap(),
        "run": session.result,
    }


KINDS = ("image", "camera", "scene", "attitude", "fix", "run")


@pytest.mark.parametrize("kind", KINDS)
def test_words_are_short_and_say_what_it_is(shown: dict[str, object], kind: str) -> None:
    text = repr(shown[kind])
    assert len(text) < LONGEST
    assert "array" not in text
    assert text.startswith(type(shown[kind]).__name__ + "(")


@pytest.mark.parametrize("kind", [slow(kind) if kind in ("image", "camera", "scene") else kind for kind in KINDS])
def test_a_notebook_shows_a_picture_with_the_words_below(shown: dict[str, object], kind: str) -> None:
    page = shown[kind]._repr_html_()  # type: ignore[attr-defined]
    found = re.search(r'src="data:image/png;base64,([^"]+)"', page)
    assert found is not None
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    assert picture.std() > 5.0
    assert f"<figcaption>{type(shown[kind]).__name__}(" in page


@pytest.mark.parametrize("kind", [kind if kind == "attitude" else slow(kind) for kind in KINDS])
def test_what_is_drawn_without_axes_is_shown_once(shown: dict[str, object], kind: str) -> None:
    pyplot.close("all")
    axes = shown[kind].plot()  # type: ignore[attr-defined]
    assert [pyplot.figure(number) for number in pyplot.get_fignums()] == [axes.figure]
    shown[kind]._repr_html_()  # type: ignore[attr-defined]
    assert len(pyplot.get_fignums()) == 1
    pyplot.close("all")


@pytest.mark.parametrize("kind", KINDS)
def test_everything_can_be_drawn_on_axes_of_your_own(shown: dict[str, object], kind: str) -> None:
    axes = Figure().add_subplot()
    assert shown[kind].plot(axes) is axes  # type: ignore[attr-defined]
    assert axes.has_data()


def test_a_scene_and_a_fix_are_drawn_over_their_image(shown: dict[str, object]) -> None:
    scene, fix, image = shown["scene"], shown["fix"], shown["image"]
    assert isinstance(scene, gl.Scene)
    assert isinstance(fix, gl.CenterFix)
    drawn: list[Axes] = [scene.plot(image=image, camera=CAMERA), fix.plot(image=image)]
    for axes in drawn:
        assert len(axes.images) == 1
        assert len(axes.lines) >= 1


def test_tables_have_units_and_masked_cells(shown: dict[str, object]) -> None:
    run = shown["run"]
    assert isinstance(run, RunResult)
    table = run.table()
    assert len(table) == len(run.observations)
    assert str(table["x_px"].unit) == "pix"
    assert str(table["range_km"].unit) == "km"
    assert set(table["estimator"]) == {"cross_correlation", "limb_matching"}
    assert len(run.table("attitudes")) == len(run.attitudes)
    with pytest.raises(InputError, match="attitudes and observations"):
        run.table("stars")
