"""Section III.A: the gimbal grid of 99 images, eq. 39 and the staked focus as comparisons."""

from __future__ import annotations

import math

import numpy as np

from giantlike.missions.orion.constants import focal_px, table
from giantlike.missions.orion.gimbal import (
    FOCUSED_PX,
    STAKED_PX,
    Grid,
    centroid_errors_px,
    gimbal_angles,
    pinhole_error_px,
)
from giantlike.missions.orion.judging import ROUNDING
from giantlike.missions.replay import DERIVED, INDEPENDENT, SELF_CHECK, Comparison, ReplaySettings, Stated

FIT_PX = 0.1
"""Best accuracy of real-time centroids of bodies: a lens calibrated better than this adds nothing."""
POINTS = {False: 20, True: 8}
"""Points along a side, for the focus; fewer in a small run."""


def grid_comparisons(grid: Grid) -> list[Comparison]:
    """Eq. 39, the grid and the fit."""
    gimbal, kind = table("paper")["gimbal"], DERIVED
    azimuth, elevation = gimbal_angles()
    outside = [
        math.degrees(float(each.max())) - field / 2.0
        for each, field in zip((azimuth, elevation), gimbal["field_deg"], strict=True)
    ]
    arcsec = math.degrees(gimbal["pitch_mm"] / gimbal["focal_mm"]) * 3600.0
    residual = float(np.sqrt(np.mean(grid.residuals_px**2)))
    return [
        Stated("III.A", "images of the grid", gimbal["images"], len(azimuth), kind).near(
            0.0,
            "The least grid in steps of 2 degrees, through the boresight, that covers 19.5 by 15.6 degrees: 11 by 9.",
        ),
        Stated("III.A", "images whose point falls on the detector", gimbal["images"], len(grid.azimuth_rad), kind).near(
            0.0,
            f"The outer ring of the grid lies {outside[0]:.2f} and {outside[1]:.2f} degrees beyond the field "
            "that the paper states: all 99 are seen only by a larger detector, or the field is that of another one.",
        ),
        Stated("eq. 39", "a pixel of III.A, arcsec", table("paper")["camera"]["arcsec_per_px"], arcsec, DERIVED).near(
            ROUNDING, "43.3 mm and 0.018 mm are of another camera than the 28.2 arcsec of eq. 21."
        ),
        Stated(
            "eq. 39",
            "eq. 39 in a pinhole, largest error, px",
            1.0,
            float(pinhole_error_px(azimuth, elevation).max()),
            kind,
        ).at_most(
            "The paper has it stand for the lens, which has none here; 1 px is allowed. The tangent of a "
            "gimbal's "
            "azimuth is not that of the angle in the image: away from the axes eq. 39 takes geometry for distortion."
        ),
        Stated(
            "III.A, Fig. 5", "eq. 39 with a made-up lens after the fit, rms per axis, px", FIT_PX, residual, SELF_CHECK
        ).at_most(
            "Distortions are mapped and eliminated, the paper says; a Brown model fitted to the centroids of "
            f"the grid leaves this. Before it eq. 39 finds up to {float(grid.eq39_px.max()):.1f} px."
        ),
    ]


def focus_comparisons(settings: ReplaySettings) -> list[Comparison]:
    """The collimator's point, and the focus of the lens as it is staked."""
    gimbal = table("paper")["gimbal"]
    staked_px = FOCUSED_PX if settings.change == "lens_in_focus" else STAKED_PX
    spot_px = gimbal["pinhole_um"] * 1e-3 / gimbal["collimator_mm"] * focal_px()
    focused, staked = (
        centroid_errors_px(blur, POINTS[settings.small], settings.seed) for blur in (FOCUSED_PX, staked_px)
    )
    return [
        Stated("III.A", "image of the pinhole of the collimator, px", 1.0, spot_px, DERIVED).at_most(
            "15 um over 500 mm: smaller than a pixel, so that it stands for a star as the paper says."
        ),
        Stated(
            "III.A",
            "centroids of the lens as it is staked against one in focus",
            "a slight defocus gives sub-pixel resolution",
            f"{staked:.3f} px against {focused:.3f} px",
            INDEPENDENT,
            "lens_in_focus",
        ).agrees(
            staked < 0.5 * focused,
            f"Agrees where the error is less than half: blurs of {staked_px:g} and {FOCUSED_PX:g} px, "
            f"points of 1,300 DN.",
        ),
    ]
