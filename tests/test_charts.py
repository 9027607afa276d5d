"""Charts: round numbers along axes, points where the axes say, and few marks for many points."""

from __future__ import annotations

import base64
import re
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from giantlike.plotting import charts_figure
from giantlike.plotting.charts import Axis, Chart, ChartSheet, charts_svg
from giantlike.plotting.layers import Layer, MarkShape
from giantlike.plotting.residual_map import residual_map_svg

_SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.2e-5, 7.7e-5), (2.0e6, 2.1e6), (1023.5, -0.5), (-17.0, 1.0)])
def test_numbers_along_an_axis_are_round_even_and_on_it(low: float, high: float) -> None:
    axis = Axis(label="x", low=low, high=high)
    values, texts = zip(*axis.ticks(5), strict=True)
    steps = np.diff(values)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    assert steps[0] / 10.0 ** np.floor(np.log10(steps[0])) == pytest.approx(1.0) or round(
        steps[0] / 10.0 ** np.floor(np.log10(steps[0]))
    ) in (2, 5, 10)
    assert 2 <= len(values) <= 7
    assert min(low, high) <= min(values) <= max(values) <= max(low, high)
    np.testing.assert_allclose([float(text) for text in texts], values, rtol=1e-3, atol=1e-3 * steps[0])


def test_numbers_along_a_logarithmic_axis_are_powers_of_ten() -> None:
    axis = Axis.around("y", np.array([0.003, 40.0, np.nan]), logarithmic=True)
    assert [text for _, text in axis.ticks(5)] == ["0.01", "0.1", "1", "10"]
    np.testing.assert_allclose(axis.shares(np.array([axis.low, np.sqrt(axis.low * axis.high), axis.high])), [0, 0.5, 1])


def test_a_line_runs_from_corner_to_corner_and_a_bar_stands_upright() -> None:
    corners, bar = np.array([[1.0, 10.0], [3.0, 30.0]]), np.array([[2.0, 15.0], [2.0, 25.0]])
    x, y = Axis(label="x", low=1.0, high=3.0), Axis(label="y", low=10.0, high=30.0)
    layers = [
        Layer(points=corners, shape=MarkShape.LINE, color="red", label="<a>"),
        Layer(points=bar, shape=MarkShape.BARS, color="blue"),
    ]
    sheet = ChartSheet(charts=[Chart(title="", x=x, y=y, layers=layers)], width_in=1.0, height_in=2.0)
    drawn = ElementTree.fromstring(charts_svg(sheet, "a")).iter(f"{_SVG}path")
    by_color = {path.get("stroke"): path.get("d") or "" for path in drawn if path.get("stroke") in ("red", "blue")}
    assert by_color["blue"] == "M55.0 165.0V55.0"
    lines = re.findall(r'd="([^"]*)" fill="none" stroke="red"', charts_svg(sheet, "a"))
    assert "M0 220L110 0" in lines


@pytest.mark.slow
def test_a_million_points_are_as_many_marks_as_there_is_room_for() -> None:
    points = np.random.default_rng(1).uniform(size=(1_000_000, 2))
    axis = Axis(label="either", low=0.0, high=1.0)
    layer = Layer(points=points, shape=MarkShape.DOT, color="red", size=3.0)
    sheet = ChartSheet(charts=[Chart(title="", x=axis, y=axis, layers=[layer])], width_in=1.0, height_in=1.0)
    assert len(charts_svg(sheet, "a")) < 111 * 111 * 10


def _labeled(stacked: bool) -> ChartSheet:
    axis = Axis(label="along", low=0.0, high=1.0)
    points = np.array([[0.2, 0.9], [0.8, 0.95]])
    layers = [Layer(points=points, shape=MarkShape.DOT, color="red", size=3.0, label=f"kind {k}") for k in range(2)]
    charts = [Chart(title="", x=axis, y=axis, layers=layers) for _ in range(2)]
    return ChartSheet(charts=charts, width_in=3.0, height_in=1.5, stacked=stacked)


@pytest.mark.parametrize("stacked", [False, True])
def test_legends_stand_below_the_charts_and_cover_nothing(stacked: bool) -> None:
    svg = ElementTree.fromstring(charts_svg(_labeled(stacked), "a"))
    view = [float(number) for number in svg.get("viewBox", "").split()]
    groups = svg.findall(f"{_SVG}g")
    tops = {
        "kind" in "".join(group.itertext()): float(re.findall(r"[ (]([\d.]+)\)", group.get("transform", ""))[0])
        for group in groups
    }
    charts = [group for group in groups if "along" in "".join(group.itertext())]
    lowest = max(float(re.findall(r" ([\d.]+)\)", group.get("transform", ""))[0]) for group in charts) + 1.5 * 110
    assert tops[True] > lowest
    assert tops[True] < view[3]


@pytest.mark.slow
def test_stacked_charts_stand_above_each_other_in_matplotlib_too() -> None:
    above, below = (axis.get_position() for axis in charts_figure(_labeled(True)).axes)
    assert above.y0 > below.y1
    assert above.x0 == pytest.approx(below.x0)
    left, right = (axis.get_position() for axis in charts_figure(_labeled(False)).axes)
    assert right.x0 > left.x1
    figure = charts_figure(_labeled(True))
    figure.canvas.draw()
    last = figure.axes[-1]
    legend = last.get_legend()
    assert legend is not None
    box = legend.get_window_extent()
    assert box.y1 < last.get_window_extent().y0
    assert box.y0 >= 0.0


def test_a_map_of_residuals_is_red_where_the_image_is_brighter() -> None:
    columns, rows = (each.ravel() for each in np.meshgrid(np.arange(6), np.arange(4)))
    at = (np.column_stack([columns, rows]) * 2.0 + 10.5).astype(np.float64)
    svg = residual_map_svg(at, np.where(columns < 3, -1.0, 1.0), 2.0, "<t>", unit="%")
    picture = re.findall(r"data:image/png;base64,([^\"]*)", svg)[0]
    cells = cv2.imdecode(np.frombuffer(base64.b64decode(picture), np.uint8), cv2.IMREAD_COLOR)
    assert cells is not None
    assert cells.shape == (4, 6, 3)
    blue, red = cells[:, :3].astype(int), cells[:, 3:].astype(int)
    assert (blue[..., 0] > blue[..., 2]).all()
    assert (red[..., 2] > red[..., 0]).all()
    assert ElementTree.fromstring(svg) is not None


@pytest.mark.parametrize(("value", "low", "high"), [(0.0, -0.55, 0.55), (4.0, 1.8, 6.2), (-4.0, -6.2, -1.8)])
def test_an_axis_of_a_single_value_has_ticks_that_can_be_read(value: float, low: float, high: float) -> None:
    """The report of a campaign of one image had ticks of 1e-13."""
    axis = Axis.around("x", np.array([value]))
    assert (axis.low, axis.high) == pytest.approx((low, high))
