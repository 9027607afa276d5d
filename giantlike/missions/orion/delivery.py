"""Sections I and II.C: passes, filter, linear covariance and dispersions at the entry interface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from giantlike.cislunar.filter import STATES
from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.missions.orion.constants import ANALYSIS, earth_errors, table
from giantlike.missions.orion.return_leg import Delivery, Flown, History, analyze_plan, flown
from giantlike.missions.orion.return_plan import ReturnPlan, make_plan, with_earth, without_close_pass
from giantlike.missions.replay import DERIVED, INPUT, SELF_CHECK, Comparison, ReplaySettings, Stated

RUNS, SMALL_RUNS = 500, 40
STEP_S, SMALL_STEP_S = 900.0, 3600.0  # longest steps of the filter, s; the unmodeled acceleration has 6 h
SMALL_IMAGES_S = 1800.0
SEVERE_SIGMAS = 3.0  # A mean error of more than this many of the filter's own sigmas: it does not know how wrong it is


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Study(Value):
    """The plan, its analysis and its variants, and flown runs."""

    plan: ReturnPlan
    history: History
    delivery: Delivery
    runs: Flown
    blind: Delivery
    edge_earth: Delivery
    close_history: History
    dense_difference: float

    def marks(self) -> Float:
        """Indices (k,) of corrections and of the entry among the legs."""
        last = len(self.plan.legs) - 1
        return np.array([k for k, leg in enumerate(self.plan.legs) if leg.guidance is not None or k == last])


def study_leg(settings: ReplaySettings) -> Study:
    """Analyze and fly the leg."""
    step_s = SMALL_STEP_S if settings.small else STEP_S
    every_s = SMALL_IMAGES_S if settings.small else table("return_leg")["schedule"]["image_every_s"]
    close = make_plan(step_s, every_s)
    plan = without_close_pass(close)
    history, delivery, _ = analyze_plan(plan)
    believed = analyze_plan(plan, as_believed=True)[2]
    dense = believed.joint.navigation_error()[1]
    sigma = believed.state.factors.sigmas()
    difference = np.abs(dense - believed.state.factors.composed()) / np.outer(sigma, sigma)
    return Study(
        plan=plan,
        history=history,
        delivery=delivery,
        runs=flown(plan, settings, SMALL_RUNS if settings.small else RUNS),
        blind=analyze_plan(plan, with_images=False)[1],
        edge_earth=analyze_plan(with_earth(plan, earth_errors(as_moon=False)))[1],
        close_history=analyze_plan(close)[0],
        dense_difference=float(difference.max()),
    )


def architecture_comparisons(study: Study) -> list[Comparison]:
    """I.A and I.B: passes and filter."""
    passes, model = table("paper")["passes"], study.plan.model
    starts = np.array(study.plan.passes_h)
    return [
        Stated("I.A", "length of a pass, h", passes["length_h"], passes["length_h"], INPUT).near(0.0, "Put in."),
        Stated("I.A", "time between passes, h", passes["every_h"], float(np.max(-np.diff(starts))), INPUT).near(
            0.0, "Put in."
        ),
        Stated("I.B", "states of the filter", 21, STATES, INPUT).near(
            0.0, f"As listed there; {int(model.considered.sum())} of them, the attitude, are considered."
        ),
        Stated(
            "I.B",
            "U D U^T factors beside full matrices over the whole leg",
            "chosen for numeric stability",
            f"covariances differ by {study.dense_difference:.1e} of the sigmas",
            SELF_CHECK,
        ).agrees(
            study.dense_difference < 1e-6,
            "Agrees below 1e-6: the errors of a world as the filter believes it, followed in 42 dimensions by "
            "full matrices in Joseph's form, lose digits that the factors keep.",
        ),
    ]


def delivery_comparisons(study: Study) -> list[Comparison]:
    """II.C and Fig. 4."""
    kind, half = SELF_CHECK, table("return_leg")["corridor"]["half_width_deg"]
    reference_deg = -6.0

    def reach(of: Delivery) -> float:
        return abs(of.angle_mean_deg - reference_deg) + 3.0 * of.angle_sigma_deg

    close, far = (severity(each) for each in (study.close_history, study.history))
    return [
        Stated(
            "Fig. 4", "entry angle: bias and three sigma, deg, against the corridor", half, reach(study.delivery), kind
        ).at_most(
            "Linear covariance of the plan. The paper says that the delivery satisfies the corridor and draws "
            "it; its text has no number, so that the half width is assumed."
        ),
        Stated(
            "I.A",
            "the same without optical navigation",
            "needed after loss of communication",
            f"{reach(study.blind):.2f} deg",
            kind,
        ).agrees(reach(study.blind) > half, "Agrees where the corridor is missed without images."),
        Stated(
            "II.C",
            "passes very close to the Moon",
            "not performed, because of large bias errors",
            f"mean error of {close:.1f} of the filter's sigmas with one, {far:.1f} without",
            DERIVED,
        ).agrees(
            close > max(SEVERE_SIGMAS, far),
            "Agrees where eqs. 31 and 33 give a mean error of more than three sigma, and more than the "
            "plan has. The "
            "first pass of the plan, at 50,000 km, suffers too: the filter's bias states are too small for it.",
        ),
        Stated(
            "II.C",
            "noise of the Moon for images of the Earth",
            "more conservative",
            f"entry angle {study.delivery.angle_sigma_deg:.4f} deg with it, {study.edge_earth.angle_sigma_deg:.4f} "
            "with eqs. 34 to 36",
            DERIVED,
        ).agrees(
            study.edge_earth.angle_sigma_deg <= study.delivery.angle_sigma_deg,
            "Agrees where the delivery is not better with it.",
        ),
    ]


def analysis_comparisons(study: Study) -> list[Comparison]:
    """II.C: linear covariance compared with flown runs."""
    kind = SELF_CHECK
    marks = study.marks()
    ratios = {
        "error of position and velocity": study.runs.history.error_sigma[marks] / study.history.error_sigma[marks],
        "stray of position and velocity": study.runs.history.strayed_sigma[marks] / study.history.strayed_sigma[marks],
    }
    worst = {name: float(ratio.flat[np.argmax(np.abs(ratio - 1.0))]) for name, ratio in ratios.items()}
    runs = len(study.runs.angles_deg)
    compared = [
        Stated(
            "Fig. 4",
            "entry angle: sigma, deg, linear covariance over flown runs",
            study.runs.delivery.angle_sigma_deg,
            study.delivery.angle_sigma_deg,
            kind,
        ).near(ANALYSIS, f"Here the first number is of {runs} flown runs of the same filter by an independent truth."),
        *(
            Stated(
                "II.C",
                f"{name}: sigmas of flown runs over linear covariance, the one farthest from 1",
                1.0,
                value,
                kind,
            ).near(
                ANALYSIS,
                f"Six components at {len(marks)} times, {runs} runs, whose sigmas are known to "
                f"{100.0 / np.sqrt(2.0 * runs):.1f} % each.",
            )
            for name, value in worst.items()
        ),
    ]
    return compared if runs >= RUNS else [replace(each, agrees=None) for each in compared]


def severity(history: History) -> float:
    """Largest mean error of a position in sigmas of the filter."""
    return float(np.max(np.abs(history.error_mean[:, :3]) / history.believed[:, :3]))
