"""The replay: studies in the order of the paper, figures, comparisons, and assumptions."""

from __future__ import annotations

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.errors import EstimationError
from giantlike.core.outcomes import Failure
from giantlike.missions.odin import compared, figures
from giantlike.missions.odin.compared import of_optics
from giantlike.missions.odin.ground import sky_at
from giantlike.missions.odin.modes import fly
from giantlike.missions.odin.narrow import (
    NIGHT_ET,
    InterlockStudy,
    LensStudy,
    MoonPair,
    calibrate_lens,
    interlock_study,
    lines_of,
    moon_pair,
    scatter_by_air,
)
from giantlike.missions.odin.optics import SensorChoice, choices, coverage
from giantlike.missions.odin.paper import paper
from giantlike.missions.odin.wide import WideStudy, wide_study
from giantlike.missions.replay import Replay, ReplayFigure, ReplaySettings, Section

ORIENTATIONS = 3  # "the test unit was reoriented a couple of times"


def whole_replay(settings: ReplaySettings) -> Replay:
    """Run all studies."""
    streams = [np.random.default_rng([settings.seed, k]) for k in range(7)]
    small, report, air = settings.small, settings.progress, settings.change != "vacuum"
    exchanged = settings.change == "albedos_exchanged"
    every = choices()
    covered = coverage(20_000 if small else 400_000, streams[0])
    scenes = 2 if small else 120
    wide = wide_study(scenes, streams[1], lambda done: report("wide images", done, scenes), exchanged=exchanged)
    lens = calibrate_lens(2 if small else int(paper()["calibration"]["images"]), streams[2])
    if isinstance(lens, Failure):
        raise EstimationError(f"calibration: {lens.detail}")
    count = 2 if small else int(paper()["interlock"]["pairs"])
    turns = 2 if small else ORIENTATIONS
    locked = interlock_study(count, turns, streams[3], lambda done: report("star pairs", done, count), air=air)
    by_air = scatter_by_air(40 if small else 1000, ORIENTATIONS, streams[4], air=air)
    pairs, failed = moon_study(locked, settings, streams[5])
    flight = fly(streams[6], images=2 if small else 4)
    return Replay(
        name="odin",
        title="ODIN, optical navigation for small satellites (Thrasher et al.)",
        sections=(
            _cameras(every, covered),
            _targets(wide),
            Section(
                title="Modes, trigger and time",
                text="; ".join(f"{each.mode}: {each.detail}" for each in flight.telemetry),
                comparisons=compared.of_modes(flight, pairs),
            ),
            _calibration(lens),
            _interlock(locked, by_air),
            _positions(pairs, failed),
        ),
        flown="Images of Earth, Moon and Sun by two wide fisheye cameras, searched and named by brightness; "
        "images of stars and of the Moon by two narrow cameras under refracting air, by the independent "
        "renderer: calibration lost in space, the angle between the cameras, pairs of stars and Moon for "
        "attitude and position; the four modes.",
        pictures=("Fig. 6", "Fig. 16", "Fig. 17", "Fig. 18", "Fig. 20"),
        assumptions=tuple(paper()["assumptions"]),
    )


def _cameras(every: tuple[SensorChoice, ...], covered: float) -> Section:
    trade = figures.trade_figure(every)
    return Section(
        title="Cameras",
        text="Fields, projection and sizes by the tables, and the trade of sensor and lens.",
        figures=(
            ReplayFigure(
                "Fig. 5", "Diameter of Earth and Moon", "Middle to edge of the frame.", figures.sizes_figure()
            ),
            ReplayFigure("Fig. 9", "Sensors and lenses", "Circled: the one chosen.", trade),
        ),
        comparisons=of_optics(every, covered),
    )


def _targets(study: WideStudy) -> Section:
    found = figures.search_figure(study)
    return Section(
        title="Target determination",
        text="Wide images of Earth, Moon and Sun are searched; a body is told by its brightness for size and phase.",
        figures=(
            ReplayFigure(
                "Fig. 6", "Intensity over phase", "Per solar irradiance and R squared.", figures.phase_figure()
            ),
            ReplayFigure("", "Bodies found", "Dotted: half of the narrow field.", found),
        ),
        comparisons=compared.of_photometry(study),
    )


def _calibration(study: LensStudy) -> Section:
    caption = "Stars of the calibration; what is left at the edges is refraction within the field."
    return Section(
        title="Calibration of a narrow camera",
        text="Star images from the ground with nothing told but size and field of view.",
        figures=(
            ReplayFigure(
                "Fig. 13", "Stars identified", "Green: Hipparcos; blue: detections.", figures.names_figure(study)
            ),
            ReplayFigure("Table 3", "Residuals of the calibration", caption, figures.lens_figure(study)),
        ),
        comparisons=compared.of_lens(study),
    )


def _interlock(study: InterlockStudy, by_air: Float) -> Section:
    drawn = figures.interlock_figure(study)
    return Section(
        title="Angle between the narrow cameras",
        text="Pairs of star images; attitudes as the stars show them, and with refraction taken out of each star.",
        figures=(ReplayFigure("Fig. 16", "Angle over pairs", "A rigid rig under the air.", drawn),),
        comparisons=compared.of_interlock(study, by_air),
    )


def _positions(pairs: tuple[MoonPair, ...], failed: int) -> Section:
    along = "Z along the line of sight; gray: three sigmas of the covariance. Refraction taken out."
    errors, sigmas = figures.camera_residuals_km(pairs)
    within = 100.0 * float(np.mean(np.abs(errors) < 3.0 * sigmas))
    return Section(
        title="Attitude and position from a pair",
        text="Stars in one camera, the Moon in the other; the interlock is the one calibrated above. With refraction "
        f"taken out, {within:.0f} % of the residuals lie within three sigmas of the covariance.",
        figures=(
            ReplayFigure(
                "Fig. 17", "The Moon, expected and measured", "Circles: outlines.", figures.moon_figure(pairs)
            ),
            ReplayFigure(
                "Fig. 18", "Expected to measured Moon", "Gray: the paper's range.", figures.offset_figure(pairs)
            ),
            ReplayFigure("Fig. 19", "Position residuals", along, figures.camera_residuals_figure(pairs)),
            ReplayFigure("Fig. 20", "Range and bearing", "Dotted: one pixel.", figures.bearing_figure(pairs)),
        ),
        comparisons=compared.of_moon(pairs, failed),
    )


def moon_study(
    locked: InterlockStudy, settings: ReplaySettings, rng: np.random.Generator
) -> tuple[tuple[MoonPair, ...], int]:
    """Pairs of stars and Moon over an evening, and the number that failed."""
    count = 2 if settings.small else int(paper()["moon"]["pairs"])
    interlocks = (lines_of(locked, corrected=False), lines_of(locked, corrected=True))
    pairs, failed = [], 0
    for k, seconds in enumerate(np.linspace(0.0, 2.6 * 3600.0, count)):  # the Moon rises from 13 to 38 degrees
        pair = moon_pair(sky_at(float(NIGHT_ET + seconds)), interlocks, rng, air=settings.change != "vacuum")
        if isinstance(pair, Failure):
            failed += 1
        else:
            pairs.append(pair)
        settings.progress("Moon pairs", k + 1, count)
    if not pairs:
        raise EstimationError(f"none of {count} pairs of stars and Moon gave a pose")
    return tuple(pairs), failed
