"""The replay: studies in the order of the paper, figures, comparisons, and what was assumed."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from giantlike.core.errors import EstimationError
from giantlike.core.outcomes import Failure
from giantlike.missions.odin import compared, figures
from giantlike.missions.odin.compared_cameras import of_optics
from giantlike.missions.odin.ground import sky_at
from giantlike.missions.odin.modes import fly
from giantlike.missions.odin.narrow import (
    InterlockStudy,
    MoonPair,
    calibrate_lens,
    interlock_study,
    lines_of,
    moon_epochs,
    moon_pair,
    scatter_by_air,
)
from giantlike.missions.odin.optics import choices, coverage
from giantlike.missions.odin.paper import paper
from giantlike.missions.odin.wide import wide_study
from giantlike.missions.replay import Replay, ReplayFigure, ReplaySettings, Section

ORIENTATIONS = 3  # "the test unit was reoriented a couple of times"
ASSUMPTIONS = (
    "Figures of the paper were read by their captions and the text: their curves are not in the text that was at hand.",
    "Site (Atlanta), date (17 February 2025, the Moon rising from 13 to 38 degrees) and pointing are not in the paper.",
    "Air: 1,010 hPa, 15 C; refraction in the images by Snell's law through an exponential atmosphere, taken out by"
    " ERFA's"
    " constants; images move by 0.7 arcsec a frame.",
    "Detectors: well 10,500 electrons, read noise 2.4; optics a Gaussian of 0.7 px; stars of the default catalog to"
    " 7.5 mag.",
    "The rig was turned three times in 36 pairs, at random with both cameras above 25 degrees; it is rigid here.",
    "The Moon is a sphere with made-up maria and the lunar-Lambert law; it has no relief.",
    "Target determination: geometric albedos 0.434 and 0.12; the Moon's observed phase curve and a Lambert Earth as"
    " truth,"
    " albedos scattered by 5 and 15 %, calibration by 5 %; spacecraft from 15,000 to 500,000 km from the Earth at"
    " random.",
    "Eq. 23 is used without its second mean irradiance, eq. 21 without the aperture that eq. 22 multiplies by again.",
    "Set with the paper known: the mean quantum efficiency (0.397) is the one by which eq. 23 gives what eq. 22"
    " gives for"
    " sunlight; the exposures of the wide cameras (4 and 40 us) suit Earth and Moon;"
    " the limits of 0.1 % and 50,000 km of the lens trade.",
    "The 30 s are those of the Artemis I flight code that the software is built from: this paper states no time.",
)


def whole_replay(settings: ReplaySettings) -> Replay:
    """Run all studies.

    Parameters
    ----------
    settings : ReplaySettings

    Returns
    -------
    Replay

    Raises
    ------
    EstimationError
        The calibration, the interlock or the run of the modes failed as a whole.
    """
    streams = [np.random.default_rng([settings.seed, k]) for k in range(7)]
    small, report = settings.small, settings.progress
    every = choices()
    covered = coverage(20_000 if small else 400_000, streams[0])
    scenes = 2 if small else 120
    wide = wide_study(scenes, streams[1], lambda done: report("wide images", done, scenes))
    lens = calibrate_lens(2 if small else int(paper()["calibration"]["images"]), streams[2])
    if isinstance(lens, Failure):
        raise EstimationError(f"calibration: {lens.detail}")
    count = 2 if small else int(paper()["interlock"]["pairs"])
    turns = 2 if small else ORIENTATIONS
    locked = interlock_study(count, turns, streams[3], lambda done: report("star pairs", done, count))
    by_air = scatter_by_air(40 if small else 1000, ORIENTATIONS, streams[4])
    pairs, failed = moon_study(locked, settings, streams[5])
    flight = fly(streams[6], images=2 if small else 4)
    narrow_figures = (
        ReplayFigure(
            reference="Table 3", title="Residuals of the calibration", figure=figures.lens_figure(lens),
            caption="Stars of the calibration; what is left at the edges is refraction within the field.",
        ),
    )  # fmt: skip
    return Replay(
        name="odin",
        title="ODIN, optical navigation for small satellites (Thrasher et al.)",
        sections=(
            Section(
                title="Cameras", text="Fields, projection and sizes by the tables, and the trade of sensor and lens.",
                figures=(
                    _figure("Fig. 5", "Diameter of Earth and Moon", figures.sizes_figure(), "Middle to edge of the"
                    " frame."),
                    _figure("Fig. 9", "Sensors and lenses", figures.trade_figure(every), "Circled: the one chosen."),
                ),
                comparisons=of_optics(every, covered),
            ),
            Section(
                title="Target determination",
                text="Wide images of Earth, Moon and Sun are searched; a body is told by its brightness for size and"
                " phase.",
                figures=(
                    _figure("Fig. 6", "Intensity over phase", figures.phase_figure(), "Per solar irradiance and R"
                    " squared."),
                    _figure("", "Bodies found", figures.search_figure(wide), "Dotted: half of the narrow field."),
                ),
                comparisons=compared.of_photometry(wide),
            ),
            Section(
                title="Modes, trigger and time",
                text="; ".join(f"{each.mode}: {each.detail}" for each in flight.telemetry),
                comparisons=compared.of_modes(flight, pairs),
            ),
            Section(
                title="Calibration of a narrow camera", figures=narrow_figures, comparisons=compared.of_lens(lens),
                text="Star images from the ground with nothing told but size and field of view.",
            ),
            Section(
                title="Angle between the narrow cameras",
                text="Pairs of star images; attitudes as the stars show them, and with refraction taken out of each"
                " star.",
                figures=(
                    _figure("Fig. 16", "Angle over pairs", figures.interlock_figure(locked), "A rigid rig under the"
                    " air."),
                ),
                comparisons=compared.of_interlock(locked, by_air),
            ),
            Section(
                title="Attitude and position from a pair",
                text="Stars in one camera, the Moon in the other; the interlock is the one calibrated above. With"
                " refraction"
                f" taken out, {100 * share_within(pairs):.0f} % of the residuals lie within three sigmas of the"
                f" covariance.",
                figures=(
                    _figure("Fig. 17", "The Moon, expected and measured", figures.moon_figure(pairs), "Circles:"
                    " outlines."),
                    _figure("Fig. 18", "Expected to measured Moon", figures.offset_figure(pairs), "Gray: the paper's"
                    " range."),
                    _figure(
                        "Fig. 19", "Position residuals", figures.camera_residuals_figure(pairs),
                        "Z along the line of sight; gray: three sigmas of the covariance. Refraction taken out.",
                    ),
                    _figure("Fig. 20", "Range and bearing", figures.bearing_figure(pairs), "Dotted: one pixel."),
                ),
                comparisons=compared.of_moon(pairs, failed),
            ),
        ),
        assumptions=ASSUMPTIONS,
    )  # fmt: skip


def share_within(pairs: tuple[MoonPair, ...]) -> float:
    """Share of the residuals of the position within three sigmas."""
    errors, sigmas = figures.camera_residuals_km(pairs)
    return float(np.mean(np.abs(errors) < 3.0 * sigmas))


def moon_study(
    locked: InterlockStudy, settings: ReplaySettings, rng: np.random.Generator
) -> tuple[tuple[MoonPair, ...], int]:
    """Pairs of stars and Moon over an evening, and the number that failed."""
    count = 2 if settings.small else int(paper()["moon"]["pairs"])
    interlocks = (lines_of(locked, corrected=False), lines_of(locked, corrected=True))
    pairs, failed = [], 0
    for k, et in enumerate(moon_epochs(count)):
        pair = moon_pair(sky_at(float(et)), interlocks, rng)
        if isinstance(pair, Failure):
            failed += 1
        else:
            pairs.append(pair)
        settings.progress("Moon pairs", k + 1, count)
    if not pairs:
        raise EstimationError(f"none of {count} pairs of stars and Moon gave a pose")
    return tuple(pairs), failed


def _figure(reference: str, title: str, figure: Figure, caption: str) -> ReplayFigure:
    return ReplayFigure(reference=reference, title=title, figure=figure, caption=caption)
