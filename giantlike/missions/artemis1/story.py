"""The replay as a whole: sections in the order of the paper, and the assumptions."""

from __future__ import annotations

from giantlike.missions.artemis1.algorithms import algorithms_section
from giantlike.missions.artemis1.calibrations import calibration_section
from giantlike.missions.artemis1.earth import earth_section
from giantlike.missions.artemis1.moon import moon_section, pointing_numbers
from giantlike.missions.artemis1.passes import Setting, load, times_of
from giantlike.missions.artemis1.simulate import fly
from giantlike.missions.artemis1.terrain import made_up_moon
from giantlike.missions.replay import DERIVED, Replay, ReplaySettings, Section, Stated


def tell(settings: ReplaySettings) -> Replay:
    """Simulate, process and compare."""
    setting = load(settings.change)
    ground = made_up_moon(setting, settings.seed)
    flown = {}
    for k, one in enumerate(setting.passes):
        if settings.small and one.number not in (1, 2, 3, 4, 6, 9, 11, 20, 22, 24):
            continue
        settings.progress("passes", k, len(setting.passes))
        flown[one.number] = fly(setting, one, ground, settings)
    moon = {number: each for number, each in flown.items() if each.one.target == "moon"}
    earth = {number: each for number, each in flown.items() if each.one.target == "earth"}
    return Replay(
        name="artemis1",
        title="Artemis I Optical Navigation System Performance (Inman et al.)",
        sections=(
            _passes_section(setting),
            calibration_section(setting, settings),
            moon_section(setting, moon, ground),
            algorithms_section(setting, moon[3], settings),
            earth_section(setting, earth),
        ),
        flown="The 23 passes of Table 1, each on a straight track at the range of the table: limb points of "
        "every image with the errors that full images of the same pass show, 102 full images for the comparison "
        "of the algorithms, 30 calibrations on simulated centroids of stars. Moon with relief, Earth with air; "
        "positions by the Christian-Robinson algorithm, the altitude of the limb by the whole-pass estimator, a "
        "filter with a wrong altitude.",
        pictures=("Fig. 6", "Fig. 7", "Fig. 13", "Fig. 20", "Fig. 21"),
        assumptions=tuple(setting.data["assumptions"]),
    )


def _passes_section(setting: Setting) -> Section:
    """Table 1 and the numbers of the text."""
    counts = [times_of(setting, one).size for one in setting.passes]
    certified = times_of(setting, setting.find_pass(3)).size
    return Section(
        title="Passes (Table 1)",
        text=f"{len(setting.passes)} passes (16, 17 and 21 are left out as in the paper), {sum(counts)} "
        f"images of bodies.",
        comparisons=(
            Stated("Table 1", "passes used", 23.0, float(len(setting.passes)), DERIVED).within(0.0, "26 less three"),
            Stated(
                "Abstract", "images of bodies and of star fields", "over a thousand", str(sum(counts) + 600), DERIVED
            ).agrees(
                sum(counts) + 600 > 1000,
                "agrees above 1000: every 30 s over 2 h or 10 min, and 30 calibrations of 20 images",
            ),
            Stated(
                "IV.B.3",
                "images of pass 3 at one in 30 s over 2 h, beside those of Table 2",
                102.0,
                float(certified),
                DERIVED,
            ).within(5.0, "five images; the 102 of the paper are 51 minutes, and it does not tell why"),
            *pointing_numbers(setting),
        ),
    )
