"""Figs. 9 and 10: the field of the camera, images of Earth and Moon, and crescents as thin as in Fig. 10c."""

from __future__ import annotations

import numpy as np

from giantlike.cislunar.body_measurements import angular_diameter
from giantlike.missions.orion.constants import MOON_KM, focal_px, moon_errors, table
from giantlike.missions.orion.images import EstimatorErrors, ImagedScene, Photograph, measure_errors, photograph
from giantlike.missions.replay import DERIVED, SELF_CHECK, Comparison, ReplaySettings, Stated

PHASES_DEG = (140.0, 150.0, 160.0, 166.0, 172.0)
ESTIMATORS_TRIED = ("ellipsoid_cra", "sigmoid_limb", "limb_matching", "ellipse_fit")
CRESCENT_KM = 120_000.0
LIVE_SKY_DEG, LIVE_SKY_KM = 0.52, 384_400.0 - 6_378.0
"""Mean diameter of the Moon from the ground, for III.B, and the distance that it belongs to with the Moon overhead."""


def shown(settings: ReplaySettings) -> dict[str, Photograph]:
    """The three images of Fig. 10; the Moon is smooth in a small run."""
    relief_km = 0.0 if settings.small else 2.0
    views = {
        "Fig. 10a": ImagedScene(body="Earth", range_km=3e5, phase_deg=70.0, seed=3),
        "Fig. 10b": ImagedScene(body="Moon", range_km=8e4, phase_deg=60.0, relief_km=relief_km, seed=4),
        "Fig. 10c": ImagedScene(body="Moon", range_km=8e4, phase_deg=160.0, relief_km=relief_km, seed=5),
    }
    return {name: photograph(view) for name, view in views.items()}


def crescents(settings: ReplaySettings) -> list[EstimatorErrors]:
    """Every estimator on crescents of several phases."""
    draws = 1 if settings.small else 3
    phases = PHASES_DEG[1::2] if settings.small else PHASES_DEG
    views = [
        ImagedScene(body="Moon", range_km=CRESCENT_KM, phase_deg=phase, seed=settings.seed + 10 * k)
        for phase in phases
        for k in range(draws)
    ]
    found = []
    for done, view in enumerate(views):
        settings.progress("thin crescents", done, len(views))
        taken = photograph(view)
        found += [measure_errors(taken, name) for name in ESTIMATORS_TRIED]
    return found


def crescent_comparisons(found: list[EstimatorErrors]) -> list[Comparison]:
    """Errors on a thin crescent, of estimators of the flight software's kind and of the others."""
    kind, sigmas = SELF_CHECK, moon_errors().sigmas_px(CRESCENT_KM)
    rows = []
    for name in ESTIMATORS_TRIED:
        mine = [each for each in found if each.estimator == name]
        good = [each for each in mine if not each.suspect]
        worst = float(np.max([np.abs(each.errors_px).max() for each in good], initial=0.0))
        rows.append(
            Stated(
                "Fig. 10c",
                f"{name}: worst error of crescents of 140 to 172 degrees that it vouches for, px",
                3.0 * sigmas[0],
                worst,
                kind,
            ).at_most(
                f"{len(good)} of {len(mine)} fixes are not suspect. The paper shows the image as a stressing "
                "case and gives no error; here the bound is three sigma of eq. 29."
            )
        )
    silent = [
        each
        for each in found
        if not each.suspect and bool((np.abs(each.errors_px) > 5.0 * each.sigmas_px + 0.05).any())
    ]
    rows.append(
        Stated(
            "III.D",
            "crescents: fixes wrong by more than 5 sigma (and 0.05 px) without a flag",
            "off-nominal images verify the tuning",
            f"{len(silent)} of {len(found)}",
            kind,
        ).agrees(not silent, "Agrees where there is none.")
    )
    return rows


def field_comparisons() -> list[Comparison]:
    """Fig. 9 and III.B: how large the Moon is in the camera."""
    schedule, paper = table("return_leg")["schedule"], table("paper")
    field = np.radians(min(paper["gimbal"]["field_deg"]))
    nearest = float(MOON_KM / np.sin(field / 2.0))
    ground = float(np.degrees(angular_diameter(LIVE_SKY_KM, MOON_KM)))
    pixels = np.radians(ground) * focal_px()
    return [
        Stated(
            "II.C, Fig. 9",
            "range from which the whole Moon fits the field",
            "no passes very close to the Moon, for bias and field of view",
            f"beyond {nearest:,.0f} km; the pass left out is at some 25,000 km, {schedule['close_pass_h']:g} h "
            f"before entry",
            DERIVED,
        ).agrees(
            nearest < 25_000.0,
            "Agrees where the field of 15.6 degrees lets all passes of the plan see the whole Moon: on this "
            "trajectory it is the bias that forbids the close pass, not the field.",
        ),
        Stated(
            "III.B, Fig. 7",
            "Moon in the live-sky images",
            "Moon images were taken for measurements",
            f"{ground:.2f} deg, {pixels:.0f} px across",
            DERIVED,
        ).agrees(
            pixels > 20.0 and abs(ground - LIVE_SKY_DEG) < 0.05,
            "Agrees where the disk is wider than 20 px, enough for a limb fit, and as wide as the Moon is.",
        ),
    ]
