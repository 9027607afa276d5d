"""The sections of the replay, in the order of the paper."""

from __future__ import annotations

from giantlike.missions.orion import crescents as thin
from giantlike.missions.orion import delivery, figures, gimbal, models
from giantlike.missions.replay import ReplaySettings, Section


def sections(settings: ReplaySettings) -> tuple[Section, ...]:
    """Make everything."""
    study = delivery.study_leg(settings)
    found = models.images_of_bodies(settings)
    grid = gimbal.measure_grid(settings.seed)
    pictures, crescents = thin.shown(settings), thin.crescents(settings)
    return (
        Section(
            title="I. Passes and filter",
            text="A pass of 2 h every 24 h, corrections after passes, and an extended filter of 21 states with U D U^T "
            "factors, which considers the attitude.",
            figures=(figures.trajectory_figure(study), figures.states_figure(study)),
            comparisons=tuple(delivery.architecture_comparisons(study)),
        ),
        Section(
            title="II.A and B. Measurement and error models",
            text="Equations 1 to 38 with the paper's constants, beside errors of limb fits on images of an independent "
            "renderer.",
            figures=(figures.diameter_figure(), figures.errors_figure(found)),
            comparisons=(
                *models.constants(),
                *models.biases(),
                *models.range_errors(settings),
                *models.image_comparisons(found),
            ),
        ),
        Section(
            title="II.C. Linear covariance",
            text="World: noise and biases of eqs. 28 to 33 and 38, the Earth with the Moon's noise. Filter: constant "
            "noise. The same plan was flown by an independent truth, each run with its own filter.",
            figures=(figures.history_figure(study), figures.corridor_figure(study)),
            comparisons=(*delivery.delivery_comparisons(study), *delivery.analysis_comparisons(study)),
        ),
        Section(
            title="III.A. Calibration and focus",
            text="A collimated point at each of 99 places of a gimbal, combined to one image; eq. 39, and a Brown "
            "model fitted to the centroids.",
            figures=(figures.distortion_figure(grid),),
            comparisons=(*gimbal.grid_comparisons(grid), *gimbal.focus_comparisons(settings)),
        ),
        Section(
            title="III.B and D. Images",
            text="Images of Earth and Moon, and crescents as thin as the stressing case of Fig. 10c.",
            figures=(
                figures.field_figure(pictures["Fig. 10b"]),
                figures.picture("Fig. 10a", pictures["Fig. 10a"], "Earth"),
                figures.picture("Fig. 10b", pictures["Fig. 10b"], "Moon"),
                figures.picture("Fig. 10c", pictures["Fig. 10c"], "Stressing Moon image"),
                figures.crescent_figure(crescents),
            ),
            comparisons=(*thin.field_comparisons(), *thin.crescent_comparisons(crescents)),
        ),
    )
