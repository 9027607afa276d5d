"""Plots of accuracy and speed from the tables of the benchmarks, as SVG.

    python benchmarks/plots.py FOLDER

Nothing is measured here: the numbers are those of the tables in benchmarks/results, so that the plots are as old as
these. ``make docs`` makes the page of them anew.
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("svg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

HERE = Path(__file__).resolve().parent
SIZE_IN = (7.0, 4.2)
COLORS = ("#2066a8", "#d1495b", "#3a7d44", "#e09f3e", "#7b4b94", "#20a39e", "#555555", "#a0522d", "#b5b500", "#000000")
MEDIAN = 0.6745
"""Median of the sizes of normal errors over their sigma."""
Row = dict[str, str]


def rows_of(name: str, *columns: str) -> list[Row]:
    """Rows of a table of benchmarks/results, in order.

    Parameters
    ----------
    name : str
        Name of the file, without its ending.
    *columns : str
        Headings that it must have.

    Returns
    -------
    list of dict of str to str
        Cells by heading.

    Raises
    ------
    LookupError
        A column is missing: the table was changed, and its plot is to be changed too.
    """
    path = HERE / "results" / f"{name}.csv"
    with path.open(newline="", encoding="utf-8") as file:
        table = csv.DictReader(file)
        missing = set(columns) - set(table.fieldnames or ())
        if missing:
            raise LookupError(f"benchmarks/results/{name}.csv has no columns {', '.join(sorted(missing))}")
        return list(table)


def number(cell: str) -> float:
    """First number of a cell; NaN where there is none."""
    found = re.search(r"\d[\d,]*(\.\d+)?(e[-+]?\d+)?", cell)
    return float(found[0].replace(",", "")) if found else float("nan")


def error_and_sigma(axes: Axes) -> str:
    """Center errors beside stated sigmas, every case of the stress benchmark."""
    rows = rows_of("stress", "case", "estimator", "center error, px", "stated, px")
    for estimator, color in zip(dict.fromkeys(row["estimator"] for row in rows), COLORS, strict=False):
        own = [row for row in rows if row["estimator"] == estimator]
        stated = [number(row["stated, px"]) for row in own]
        axes.plot(stated, [number(row["center error, px"]) for row in own], ".", color=color, label=estimator)
    ends = np.array([0.003, 3.0])
    axes.plot(ends, MEDIAN * ends, color="black", linewidth=0.8)
    axes.set(xscale="log", yscale="log", xlabel="stated sigma, px", ylabel="error of the center, px (median)")
    axes.legend(fontsize=8)
    return (
        "Every case of the [stress benchmark](../../benchmarks/stress.md), a point for each estimator: bodies whose "
        "shape, light, camera or image differs from what is declared. The line is where errors have the median that "
        "their sigma predicts; above it the sigma is too small."
    )


def consistency(axes: Axes) -> str:
    """Squared errors over covariances, by estimator."""
    rows = rows_of("stress", "case", "estimator", "NEES/dof of ok")
    names = list(dict.fromkeys(row["estimator"] for row in rows))
    for place, name in enumerate(names):
        values = [number(row["NEES/dof of ok"]) for row in rows if row["estimator"] == name]
        axes.plot(values, [place] * len(values), "|", color=COLORS[0], markersize=12)
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set(xscale="log", xlabel="squared error over covariance, per degree of freedom", yticks=range(len(names)))
    axes.set_yticklabels(names)
    return "The same cases: squared errors of `ok` fixes over their covariances. 1 is right, less is conservative."


def star_times(axes: Axes) -> str:
    """Time of detection by the number of stars, beside other tools."""
    rows = rows_of("star_times", "stars in the frame", "detect / all", "sep", "photutils DAOFIND")
    stars = [number(row["stars in the frame"]) for row in rows]
    tools = {"detect / all": "giantlike", "sep": "sep", "OpenCV": "OpenCV", "photutils DAOFIND": "photutils DAOFIND"}
    for (column, label), color in zip(tools.items(), COLORS, strict=False):
        axes.plot(stars, [number(row[column]) for row in rows], ".-", color=color, label=label)
    axes.set(xscale="log", xlabel="stars in the frame", ylabel="CPU, ms")
    axes.legend(fontsize=8)
    return (
        "Time to find the stars of an image, by their number. The other tools give no covariances and are not asked "
        "for neighbors, particles or saturation ([benchmarks](../../benchmarks/README.md))."
    )


def campaign_times(axes: Axes) -> str:
    """Time of a campaign by the number of its images."""
    rows = rows_of("campaign_one_process", "images, one process", "CPU, s", "memory, MB")
    images = [number(row["images, one process"]) for row in rows]
    axes.plot(images, [number(row["CPU, s"]) for row in rows], ".-", color=COLORS[0])
    axes.set(xscale="log", yscale="log", xlabel="images of a campaign", ylabel="CPU, s, one process")
    memory = axes.twinx()
    memory.plot(images, [number(row["memory, MB"]) for row in rows], ".--", color=COLORS[1])
    memory.set(ylim=(0, None), ylabel="memory, MB (dashed)")
    return "A campaign of star images and of bodies by its number of images: time (left) and memory (right, dashed)."


PLOTS: tuple[Callable[[Axes], str], ...] = (error_and_sigma, consistency, star_times, campaign_times)


def write_plots(folder: Path) -> None:
    """Write the plots and their page.

    Parameters
    ----------
    folder : Path
        Made if missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    parts = ["# Plots of the benchmarks\n\nMade of the tables of `benchmarks/results`, as old as these.\n"]
    for plot in PLOTS:
        figure, axes = plt.subplots(figsize=SIZE_IN, layout="constrained")
        with matplotlib.rc_context({"svg.hashsalt": plot.__name__}):
            words = plot(axes)
            axes.grid(visible=True, alpha=0.3)
            figure.savefig(folder / f"{plot.__name__}.svg", metadata={"Date": None})
        plt.close(figure)
        title = (plot.__doc__ or "").splitlines()[0].rstrip(".")
        parts.append(f"## {title}\n\n![{title}]({plot.__name__}.svg)\n\n{words}\n")
    page, text = folder / "index.md", "\n".join(parts)
    if not page.is_file() or page.read_text(encoding="utf-8") != text:
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_plots(Path(sys.argv[1]))
