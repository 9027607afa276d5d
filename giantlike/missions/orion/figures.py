"""The figures of the paper, reproduced; photographs of hardware (Figs. 6 to 8) are left out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Rectangle
from matplotlib.tri import Triangulation

from giantlike.core.arrays import Float
from giantlike.dynamics import moon_position_km
from giantlike.missions.orion.constants import EARTH_KM, earth_errors, focal_px, moon_errors, table
from giantlike.missions.orion.crescents import CRESCENT_KM
from giantlike.missions.orion.delivery import Study
from giantlike.missions.orion.gimbal import Grid, lens
from giantlike.missions.orion.images import EstimatorErrors, Photograph
from giantlike.missions.orion.models import AXES, spread_px
from giantlike.missions.orion.return_plan import hours_before_entry
from giantlike.missions.replay import ReplayFigure
from giantlike.plotting.style import BLUE, GRAY, GREEN, INK, ORANGE, RED, SERIES, drawing

WIDE, SQUARE = (6.4, 3.6), (4.8, 4.4)  # inches


def _axes(size: tuple[float, float] = WIDE, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """An empty figure and its panels."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(1, columns)))


def trajectory_figure(study: Study) -> ReplayFigure:
    """Fig. 1: the way back with passes and corrections."""
    with drawing():
        figure, (axes,) = _axes()
        ets = np.array([step.et for leg in study.plan.legs for step in leg.steps])
        path = np.array([step.mean[:3] for leg in study.plan.legs for step in leg.steps]) / 1e3
        moon = np.array([moon_position_km(et) for et in ets.tolist()]) / 1e3
        axes.plot(path[:, 0], path[:, 1], color=INK, linewidth=1.0, label="Orion")
        axes.plot(moon[:, 0], moon[:, 1], color=GRAY, linewidth=1.0, label="Moon")
        imaged = np.array([leg.steps[-1].mean[:2] for leg in study.plan.legs if leg.image is not None]) / 1e3
        burned = np.array([leg.steps[-1].mean[:2] for leg in study.plan.legs if leg.guidance is not None]) / 1e3
        axes.plot(imaged[:, 0], imaged[:, 1], "o", color=BLUE, markersize=5.0, label="images, 2 h every 24 h")
        axes.plot(burned[:, 0], burned[:, 1], "x", color=RED, markersize=7.0, label="corrections")
        axes.add_patch(Circle((0.0, 0.0), EARTH_KM / 1e3, color=GREEN))
        axes.set(xlabel="x, 1000 km from the Earth", ylabel="y, 1000 km", aspect="equal")
        axes.legend(loc="best")
    return ReplayFigure(
        "Fig. 1",
        "The way back from the Moon",
        "Simulated, as the paper shows no state: 4.6 days from a place 25,000 km from the Moon to entry.",
        figure,
    )


def states_figure(study: Study) -> ReplayFigure:
    """Fig. 2: the states of the cislunar filter, in place of the boxes of the paper."""
    model = study.plan.model
    names = ("attitude error, rad", "unmodeled acceleration, km/s$^2$", "accelerometer bias, km/s$^2$",
             "accelerometer scale", "optical bias, tangents and diameter")  # fmt: skip
    with drawing():
        figure, (axes,) = _axes((6.4, 2.4))
        axes.axis("off")
        rows = [["position and velocity (6)", "flown", "Gram-Schmidt", "estimated"]]
        for k, name in enumerate(names):
            part = slice(3 * k, 3 * k + 3)
            sigma = f"{model.sigmas[part][0]:.1e}"
            if model.sigmas[part][2] != model.sigmas[part][0]:
                sigma += f", {model.sigmas[part][2]:.1e}"
            used = "considered" if model.considered[6 + 3 * k] else "estimated"
            hours = f"{model.time_constants_s[part][0] / 3600.0:g} h"
            rows.append([f"{name} (3)", f"{sigma}, {hours}", "Agee-Turner", used])
        table_shown = axes.table(
            rows, colLabels=["states", "sigma and time constant", "time update", "used"], loc="center", cellLoc="left",
            colWidths=[0.42, 0.26, 0.17, 0.15],
        )  # fmt: skip
        table_shown.auto_set_font_size(False)
        table_shown.set_fontsize(8.5)
        table_shown.scale(1.0, 1.35)
    return ReplayFigure(
        "Fig. 2",
        "States of the cislunar filter",
        "The paper's figure shows sensors and filters as boxes. Images update by Carlson's rank-one update.",
        figure,
    )


def diameter_figure() -> ReplayFigure:
    """Fig. 3: the diameter of the disk is the diameter of the tangent cone."""
    with drawing():
        figure, (axes,) = _axes((6.4, 2.6))
        radius, distance = 1.0, 3.2
        half = math.asin(radius / distance)
        touch = np.array([distance - radius * math.sin(half), radius * math.cos(half)])
        axes.add_patch(Circle((distance, 0.0), radius, facecolor="#e4e8ec", edgecolor=INK))
        for side in (1.0, -1.0):
            axes.plot([0.0, touch[0]], [0.0, side * touch[1]], color=BLUE)
            axes.plot([distance, touch[0]], [0.0, side * touch[1]], color=GRAY, linewidth=0.8)
        axes.plot([0.0, distance], [0.0, 0.0], color=GRAY, linestyle="--", linewidth=0.8)
        axes.plot([1.0, 1.0], [-math.tan(half), math.tan(half)], color=RED, linewidth=2.0)
        axes.text(0.55, 0.78, r"$\delta = 2\tan(A/2) = n_d/(f s)$", color=RED)
        axes.text(0.35, 0.02, "A", color=BLUE)
        axes.text(1.6, 0.04, r"$\rho$", color=INK)
        axes.text(distance, 0.35, r"$R_p$", color=INK)
        axes.set(aspect="equal", xlim=(-0.1, 4.4), ylim=(-1.1, 1.1))
        axes.axis("off")
    return ReplayFigure(
        "Fig. 3",
        "Angular diameter",
        "The disk at unit distance, eqs. 4 to 10: wider than 2 R over the range, by half a percent at ten radii.",
        figure,
    )


def errors_figure(found: Mapping[str, Sequence[EstimatorErrors]]) -> ReplayFigure:
    """Eqs. 28 to 38 with errors on made-up images."""
    ranges = np.geomspace(2e4, 4e5, 80)
    models = {"Moon": (moon_errors(), INK), "Earth": (earth_errors(as_moon=False), GREEN)}
    marks = {"smooth Moon": ("o", BLUE), "Moon with relief": ("s", ORANGE), "Earth": ("^", GREEN)}
    with drawing():
        figure, panels = _axes((9.6, 3.4), columns=3)
        for k, (axes, axis) in enumerate(zip(panels, AXES, strict=True)):
            for name, (model, color) in models.items():
                axes.loglog(ranges, model.sigmas_px(ranges)[:, k], color=color, label=f"{name}, sigma of the paper")
            axes.loglog(ranges, np.abs(models["Moon"][0].biases_px(ranges)[:, k]) + 1e-9, color=INK, linestyle=":",
                        label="Moon, size of bias")  # fmt: skip
            for name, results in found.items():
                distances = sorted({each.view.range_km for each in results})
                ours = [spread_px(results, each)[k] for each in distances]
                axes.loglog(distances, ours, marks[name][0], color=marks[name][1], label=f"{name}, ours")
            axes.set(title=axis, xlabel="range, 1000 km", ylim=(1e-3, 3.0))
            axes.minorticks_off()
            axes.set_xticks([2e4, 5e4, 1e5, 2e5, 4e5], ["20", "50", "100", "200", "400"])
        panels[0].set_ylabel("px")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return ReplayFigure(
        "Eqs. 28-38",
        "Error models, and limb fits on made-up images",
        "Ours: root mean square errors of a fit of the Christian-Robinson family, estimator told a sphere.",
        figure,
    )


def history_figure(study: Study) -> ReplayFigure:
    """Linear covariance, flown runs, and the sigmas of the filter."""
    ours, runs = study.history, study.runs.history
    left = np.array([-hours_before_entry(et) for et in ours.et.tolist()])
    with drawing():
        figure, panels = _axes((9.6, 3.4), columns=2)
        for axes, part, scale, label in (
            (panels[0], slice(0, 3), 1.0, "position, km"),
            (panels[1], slice(3, 6), 1e3, "velocity, m/s"),
        ):
            lines = (
                (ours.error_sigma, BLUE, "-", "linear covariance"),
                (runs.error_sigma, ORANGE, ":", "flown runs"),
                (ours.believed, GRAY, "--", "the filter believes"),
                (ours.error_mean, RED, "-.", "bias, linear covariance"),
            )
            for values, color, style, name in lines:
                size = scale * np.linalg.norm(values[:, part], axis=1)
                axes.semilogy(left, np.maximum(size, 1e-9), style, color=color, label=name, linewidth=1.4)
            for start in study.plan.passes_h:
                axes.axvspan(-start, -start + 2.0, color="#e4e8ec")
            axes.set(xlabel="hours to entry", title=f"error of {label}")
            axes.minorticks_off()
            axes.set_ylim(bottom=float(scale * np.linalg.norm(ours.error_sigma[:, part], axis=1).min()) / 5.0)
        panels[0].legend(loc="best")
    return ReplayFigure(
        "II.C",
        "Navigation errors along the leg",
        "Root of summed squares of three components; passes are shaded.",
        figure,
    )


def corridor_figure(study: Study) -> ReplayFigure:
    """Fig. 4: delivered dispersions against the corridor."""
    half, reference = table("return_leg")["corridor"]["half_width_deg"], -6.0
    runs, ours = study.runs, study.delivery
    with drawing():
        figure, (axes,) = _axes((6.4, 3.8))
        speed = runs.speeds_km_s
        axes.plot(speed, runs.angles_deg, ".", color=BLUE, markersize=3.0, label="flown runs")
        axes.add_patch(
            Ellipse((float(speed.mean()), ours.angle_mean_deg), 6.0 * float(speed.std()), 6.0 * ours.angle_sigma_deg,
                    fill=False, edgecolor=ORANGE, linewidth=1.6, label="three sigma, linear covariance of the angle")
        )  # fmt: skip
        for sign in (-1.0, 1.0):
            axes.axhline(reference + sign * half, color=RED, linestyle="--", linewidth=1.2)
        axes.text(0.01, 0.02, "corridor, assumed", color=RED, transform=axes.transAxes)
        axes.set(
            xlabel="speed, km/s", ylabel="flight path angle, deg", ylim=(reference - 1.3 * half, reference + 1.3 * half)
        )
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.12), ncols=2)
    return ReplayFigure(
        "Fig. 4",
        "Entry interface: delivery against the corridor",
        "Angle where the path crosses 121.92 km, and speed at the time of entry. The corridor of the paper is "
        "a drawing without numbers; half a degree is assumed.",
        figure,
    )


def distortion_figure(grid: Grid) -> ReplayFigure:
    """Fig. 5: eq. 39 over the detector, before and after a fit."""
    view = lens()
    with drawing():
        figure, panels = _axes((9.6, 3.6), columns=2)
        after = np.linalg.norm(grid.residuals_px, axis=1)
        mesh = Triangulation(grid.points_px[:, 0], grid.points_px[:, 1])
        for axes, values, title in (
            (panels[0], grid.eq39_px, "error of eq. 39, px"),
            (panels[1], after, "after the fit, px"),
        ):
            shown = axes.tricontourf(mesh, values, levels=12, cmap="viridis")
            axes.plot(grid.points_px[:, 0], grid.points_px[:, 1], ".", color="white", markersize=2.0)
            axes.set(title=title, xlim=(0, view.columns), ylim=(view.rows, 0), aspect="equal", xlabel="x, px")
            axes.grid(visible=False)
            figure.colorbar(shown, ax=axes, shrink=0.8)
        panels[0].set_ylabel("y, px")
    return ReplayFigure(
        "Fig. 5",
        "Distortion by eq. 39 at the points of the gimbal grid",
        "A made-up lens; dots are the collimated points that fall on the detector.",
        figure,
    )


def field_figure(taken: Photograph) -> ReplayFigure:
    """Fig. 9: the field of the camera with the Moon."""
    view = lens()
    with drawing():
        figure, (axes,) = _axes(SQUARE)
        sky = np.full((view.rows, view.columns), 0.0)
        rows, columns = taken.image.pixels.shape
        top, left = (view.rows - rows) // 2, (view.columns - columns) // 2
        sky[top : top + rows, left : left + columns] = taken.image.pixels
        axes.imshow(sky[::2, ::2], cmap="gray", vmin=0.0, extent=(0, view.columns, view.rows, 0))
        axes.add_patch(Rectangle((0, 0), view.columns, view.rows, fill=False, edgecolor=ORANGE))
        axes.set(xlabel="x, px", ylabel="y, px", title=f"{taken.view.range_km:,.0f} km")
        axes.grid(visible=False)
    return ReplayFigure(
        "Fig. 9",
        "Field of the camera with the Moon",
        f"19.5 by 15.6 degrees; the disk is {2.0 * taken.view.radius_px:.0f} px across.",
        figure,
    )


def picture(reference: str, taken: Photograph, title: str) -> ReplayFigure:
    """One image of Fig. 10."""
    with drawing():
        figure, (axes,) = _axes((3.6, 3.4))
        axes.imshow(taken.image.pixels, cmap="gray", vmin=0.0)
        axes.axis("off")
    return ReplayFigure(
        reference,
        title,
        f"Phase {taken.view.phase_deg:g} deg, {taken.view.range_km:,.0f} km, by the independent renderer.",
        figure,
    )


def crescent_figure(found: Sequence[EstimatorErrors]) -> ReplayFigure:
    """Errors of thin crescents by phase."""
    with drawing():
        figure, panels = _axes((9.6, 3.4), columns=3)
        names = list(dict.fromkeys(each.estimator for each in found))
        for name, color in zip(names, SERIES, strict=False):
            mine = [each for each in found if each.estimator == name]
            for k, axes in enumerate(panels):
                for hollow in (False, True):
                    chosen = [each for each in mine if each.suspect is hollow and np.isfinite(each.errors_px[k])]
                    axes.semilogy(
                        [each.view.phase_deg + 0.4 * names.index(name) for each in chosen],
                        [max(abs(float(each.errors_px[k])), 1e-3) for each in chosen], "o", color=color, markersize=4.0,
                        fillstyle="none" if hollow else "full", label=None if hollow else name,
                    )  # fmt: skip
        bounds: Float = moon_errors().sigmas_px(CRESCENT_KM)
        for k, axes in enumerate(panels):
            axes.axhline(float(bounds[k]), color=INK, linestyle="--", linewidth=0.8)
            axes.set(title=f"error {AXES[k]}, px", xlabel="phase, deg")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return ReplayFigure(
        "Fig. 10c",
        "Thin crescents",
        f"Size of errors of a smooth Moon of {2.0 * focal_px() * 1737.4 / CRESCENT_KM:.0f} px; hollow: flagged "
        "as suspect; dashed: one sigma of eqs. 28 to 30.",
        figure,
    )
