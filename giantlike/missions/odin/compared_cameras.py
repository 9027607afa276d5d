"""Comparisons of the cameras: statements of the paper, and values that follow from their numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from giantlike.missions.odin.optics import (
    MOON_DISTANCE_KM,
    MOON_RADIUS_KM,
    SensorChoice,
    diameters_px,
    field_of_wide_deg,
    fisheye_radius_px,
    is_dominated,
    projections,
    shrinkage_along_radius,
)
from giantlike.missions.odin.paper import paper
from giantlike.missions.replay import DERIVED, Comparison, Stated

ROUNDING = 0.02  # relative: the paper gives two or three digits


def of_optics(choices: Sequence[SensorChoice], covered: float) -> tuple[Comparison, ...]:
    """Table 1, Table 2, Fig. 5, Fig. 9 and eq. 7."""
    narrow, wide, fisheye = paper()["narrow"], paper()["wide"], paper()["fisheye"]
    focal_px = narrow["focal_mm"] * 1e3 / narrow["pixel_um"]
    fov = float(2.0 * np.degrees(np.arctan(narrow["columns"] / 2.0 / focal_px)))
    ifov = float(np.degrees(1.0 / focal_px) * 3600.0)
    wide_ifov = float(np.degrees(1.0 / fisheye["a0"]) * 3600.0)
    seen = field_of_wide_deg(wide["rows"] / 2.0)
    angles = np.radians(np.linspace(5.0, wide["fov_deg"] / 2.0, 40))
    radius = fisheye_radius_px(angles)
    misfit = {name: float(np.sqrt(np.mean((value - radius) ** 2))) for name, value in projections(angles).items()}
    best = min(misfit, key=lambda name: misfit[name])
    listed = ", ".join(f"{name} {value:.1f} px" for name, value in sorted(misfit.items(), key=lambda item: item[1]))
    ideal = 1.0 - float(np.cos(np.radians(wide["fov_deg"] / 2.0)))
    ident = paper()["identification"]
    invariants = [2 * ident[f"stars_{kind}"] - ident[f"freedom_{kind}"] for kind in ("calibrated", "uncalibrated")]
    return (
        _close(
            "field of view of the narrow camera, deg", narrow["fov_deg"], fov, "Table 1", "pixels over focal length"
        ),
        _close("IFOV of the narrow camera, arcsec", narrow["ifov_arcsec"], ifov, "Table 1", "pixel over focal length"),
        _close("IFOV of the wide camera, arcsec", wide["ifov_arcsec"], wide_ifov, "Table 1", "1 / a0 of Table 2"),
        _close(
            "field of view of the wide camera, deg",
            wide["fov_deg"],
            seen,
            "Tables 1, 2",
            "angle that the polynomial of Table 2 has at half of the 1536 rows; 165 deg is 1536 px by the IFOV of the "
            "middle (equidistance), which the polynomial is not",
        ),
        Stated("Tables 1, 2", "projection of the wide camera", wide["projection"], best, DERIVED).agrees(
            best == wide["projection"], f"the projection nearest to the polynomial of Table 2 to 82.5 deg; rms {listed}"
        ),
        Stated(
            "text, Camera Design", "sky covered by two wide cameras", wide["sky_coverage"], round(ideal, 3), DERIVED
        ).agrees(abs(ideal - wide["sky_coverage"]) < 0.005, "two cones of 165 deg; rounds to the same percent"),
        Stated(
            "text, Camera Design",
            "sky covered by two wide cameras, with frame and lens",
            wide["sky_coverage"],
            round(covered, 3),
            DERIVED,
        ).agrees(
            abs(covered - wide["sky_coverage"]) < 0.01,
            "random directions through the lens of Table 2 onto the frame, to 82.5 deg; to 0.01",
        ),
        Stated(
            "eq. 7", "invariants of a triad and of a quad", "3 and 4", f"{invariants[0]} and {invariants[1]}", DERIVED
        ).agrees(invariants == [3, 4], "G = 2 d - k; exact"),
        *_sizes(),
        *_trade(choices),
    )


def _close(what: str, theirs: float, ours: float, reference: str, reason: str) -> Comparison:
    return Stated(reference, what, theirs, round(ours, 2), DERIVED).agrees(
        abs(ours / theirs - 1.0) < ROUNDING, f"{reason}; to 2 %"
    )


def _sizes() -> tuple[Comparison, ...]:
    at = np.array([MOON_DISTANCE_KM])
    wide = [float(each[0]) for each in diameters_px(MOON_RADIUS_KM, at, wide=True)]
    narrow = [float(each[0]) for each in diameters_px(MOON_RADIUS_KM, at, wide=False)]
    least = wide[0] * shrinkage_along_radius()
    return (
        Stated(
            "Fig. 5",
            "the Moon from Earth in the wide camera: in the middle, and its least diameter at the edge, px",
            "largest in the middle",
            f"{wide[0]:.2f} and {least:.2f}",
            DERIVED,
        ).agrees(
            least < wide[0],
            "less along the radius at the edge than in the middle. Across it it is larger, so that the area is"
            f" that of {wide[1]:.2f} px: a lens as in Table 2 keeps areas",
        ),
        Stated(
            "Fig. 5",
            "the Moon from Earth in the narrow camera: in the middle and at the edge, by area, px",
            "largest in the middle",
            f"{narrow[0]:.1f} and {narrow[1]:.1f}",
            DERIVED,
        ).agrees(
            narrow[0] > narrow[1],
            "larger in the middle. A pinhole with the k1 of Table 3 stretches toward its edge in all directions",
        ),
    )


def _trade(choices: Sequence[SensorChoice]) -> tuple[Comparison, ...]:
    taken = next(each for each in choices if each.sensor == "IMX264" and each.focal_mm == paper()["narrow"]["focal_mm"])
    fits = [c for c in choices if c.range_sigma <= 1e-3 and c.nearest_earth_km <= 50_000.0]
    names = ", ".join(f"{each.sensor} with {each.focal_mm:g} mm" for each in fits)
    return (
        Stated(
            "Fig. 9",
            "the sensor and lens chosen: is another better in range, field and pixels at once?",
            "chosen",
            "dominated" if is_dominated(taken, tuple(choices)) else "none is better",
            DERIVED,
        ).agrees(
            not is_dominated(taken, tuple(choices)),
            f"{len(choices)} pairs of sensor and lens; sigma of the Moon's range from Earth by eqs. 14-20 with "
            f"0.1 px a limb point ({100 * taken.range_sigma:.3f} % for the one chosen), least field, number of pixels",
        ),
        Stated(
            "Fig. 9",
            "pairs that range the Moon to 0.1 % from Earth and see all of the Earth from 50,000 km",
            "5 MP with 25 mm",
            names,
            DERIVED,
        ).agrees(
            len(fits) == 1 and fits[0] is taken,
            "the two round limits are ours, set with the paper's choice known: they show that such limits exist",
        ),
    )
