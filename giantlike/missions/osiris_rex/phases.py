"""A phase flown, imaged, processed, and its orbit determined from the observables alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.core.values import Value
from giantlike.independent import ReliefBody
from giantlike.independent.orbit import Dynamics, Observation, RefusedError, Solution, solve
from giantlike.missions.osiris_rex.body import model_of
from giantlike.missions.osiris_rex.campaigns import CampaignJob, CampaignResult
from giantlike.missions.osiris_rex.images import TARGET, Planner
from giantlike.missions.osiris_rex.setup import MissionSetup, PhaseSetup
from giantlike.missions.osiris_rex.trajectory import SUN_GM_KM3_S2, Flight, fly
from giantlike.missions.replay import ReplaySettings

_LATERAL_SUNLIGHT = 0.2  # a priori sigma of each component of the acceleration by sunlight, of its size [assumed]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Residual(Value):
    """A fix against the orbit fitted to the observables of its phase, and against the true one."""

    file: str
    estimator: str
    status: str
    days: float  # since the first image of the phase
    diameter_px: float
    fit_px: Float  # fit_px, truth_px: (2,); observed minus expected center
    truth_px: Float
    fit_percent: float  # fit_percent, truth_percent: the range, in percent of it; NaN without one
    truth_percent: float
    sigma_px: Float  # sigma_px, sigma_percent: of the fix
    sigma_percent: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OrbitFit(Value):
    """The orbit of a phase, from the observables of its campaigns, planned maneuvers and an a priori state.

    solution: None where the data do not determine it, with the reason in ``refused``.
    errors: fitted minus true maneuvers (m, 3), km/s, and their planned minus true ones.
    position_error_km: (n,); of the fitted trajectory at the times of the fixes.
    """

    solution: Solution | None
    refused: str
    n_fixes: int
    maneuver_errors_km_s: Float
    planned_errors_km_s: Float
    position_error_km: Float

    @property
    def redundant(self) -> bool:
        """True where a third of the residuals are more than the unknowns: else a fit says little about them."""
        return self.solution is not None and 3 * len(self.solution.values) <= 2 * self.solution.n_residuals


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhaseResult(Value):
    """A phase: its campaigns, the orbit, and residuals by camera."""

    flight: Flight
    campaigns: tuple[CampaignResult, ...]
    orbit: OrbitFit
    residuals: Mapping[str, tuple[Residual, ...]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhaseInputs(Value):
    """Inputs common to all phases.

    calibrated: calibrated cameras; an uncalibrated one is declared exactly, but for the width of its point spread
        function.
    """

    mission: MissionSetup
    truth: ReliefBody  # Bennu as it is
    calibrated: Mapping[str, Camera]
    settings: ReplaySettings

    def run(self, phase: PhaseSetup) -> PhaseResult | None:
        """Fly a phase, run its campaigns, and fit the orbit; None where a small replay has no images of it."""
        mission, settings = self.mission, self.settings
        chosen = {each.camera: [et_from_time(time_from_utc(utc)) for utc in each.images] for each in phase.campaigns}
        if settings.small:
            chosen = {each.camera: chosen[each.camera][: each.small] for each in phase.campaigns if each.small}
        if not chosen:
            return None
        gap_s = mission.pointing.pair_gap_s
        flight = fly(
            phase.waypoints,
            [et - before for ets in chosen.values() for et in ets for before in (0.0, gap_s)],
            mission.orbit,
            mission.flight,
            trim_mm_s=phase.trim_mm_s if phase.orbit else None,
            seed=settings.seed,
        )
        facets = phase.model.facets // (4 if settings.small else 1)
        model = model_of(self.truth, phase.model, seed=settings.seed, facets=facets)
        results = tuple(
            CampaignJob(
                planner=Planner(
                    mission=mission,
                    setup=mission.cameras[setup.camera],
                    phase=phase,
                    reach_km=self.truth.bounding_radius_km,
                    seed=settings.seed,
                ),
                setup=setup,
                ets=tuple(chosen[setup.camera]),
                flight=flight,
                truth=self.truth,
                declared=self.calibrated.get(setup.camera) or mission.exact_camera(setup.camera),
                model=model,
                folder=settings.output / f"{phase.key}_{setup.camera}",
                workers=settings.workers,
            ).run(settings.progress)
            for setup in phase.campaigns
            if setup.camera in chosen
        )
        return self._fit(flight, results)

    def _fit(self, flight: Flight, results: Sequence[CampaignResult]) -> PhaseResult:
        """The orbit, and what is left of all fixes against it and against the truth."""
        used = sorted((each for result in results for each in result.preferred), key=lambda each: each.et)
        mission, told = self.mission, self.mission.flight
        first, last = (used[0].et, used[-1].et) if used else (0.0, 0.0)
        inside = [number for number, each in enumerate(flight.maneuvers) if first < each.et < last]
        days = np.arange(min(flight.states) - 86400.0, max(flight.states) + 2.0 * 86400.0, 21600.0)
        sun = CubicSpline(days, [-mission.orbit.state(et)[0] for et in days.tolist()])
        dynamics = Dynamics(
            TARGET,
            {TARGET: told.told_gm_km3_s2, "SUN": SUN_GM_KM3_S2},
            lambda name, et: np.zeros(3) if name == TARGET else np.asarray(sun(et)),
            tuple(flight.maneuvers[n] for n in inside),
            acceleration_sigma=_LATERAL_SUNLIGHT * told.sunlight_km_s2,
            sun="SUN",
            sunlight=told.sunlight_km_s2,
            oblateness=(told.j2_km2, mission.orbit.pole),
        )
        executed = flight.executed_km_s[inside]
        planned = np.array([each.planned_km_s for each in dynamics.maneuvers]).reshape(-1, 3)
        try:
            if not used:
                raise RefusedError("no fix with an attitude from stars")
            rng = np.random.default_rng([self.settings.seed, 31])
            start = dynamics.apriori
            start[:6] = flight.states[_nearest(flight, first)] * (1.0 + told.state_error * rng.normal(size=6))
            for end in (*(each.et for each in dynamics.maneuvers), math.inf):  # else a local minimum over a long arc
                arc = [each for each in used if each.et < end]
                if end == math.inf or len({each.et for each in arc}) > 3:
                    solution, refused = solve(arc, dynamics, start=start, check=False), ""
                    start = solution.values
        except RefusedError as error:
            solution, refused = None, str(error)
        every = {result.camera: [each for each in result.every if each.et >= first] for result in results}
        fitted = {}
        if solution is not None:
            times = sorted({each.et for fixes in every.values() for each in fixes})
            fitted = dict(zip(times, dynamics.fly(solution.values, np.array([first, *times]))[1:], strict=True))
        start_et = min(flight.states)
        residuals = {
            result.camera: tuple(
                _residual(each, flight.states[_nearest(flight, each.et)][:3], fitted.get(each.et), result, start_et)
                for each in every[result.camera]
            )
            for result in results
        }
        found = planned * np.nan if solution is None else solution.values[9:].reshape(-1, 3)
        orbit = OrbitFit(
            solution=solution,
            refused=refused,
            n_fixes=len(used),
            maneuver_errors_km_s=found - executed,
            planned_errors_km_s=planned - executed,
            position_error_km=np.array(
                [np.linalg.norm(place - flight.states[_nearest(flight, et)][:3]) for et, place in fitted.items()]
            ),
        )
        return PhaseResult(flight=flight, campaigns=tuple(results), orbit=orbit, residuals=residuals)


def _nearest(flight: Flight, et: float) -> float:
    """Time of a true state: epochs of images go through a header with microseconds."""
    return min(flight.states, key=lambda each: abs(each - et))


def _residual(
    each: Observation, true_km: Float, fitted_km: Float | None, result: CampaignResult, start_et: float
) -> Residual:
    """Residuals of a fix."""
    nothing = np.full(3 if each.ranged else 2, np.nan)
    against = [nothing if place is None else each.residual(-place) for place in (fitted_km, true_km)]
    shared = [partial @ known @ partial.T for partial, known in each.shared.values()]
    sigma = np.sqrt(np.diag(each.noise + sum(shared, np.zeros_like(each.noise))))
    percent = [100.0 * value[2] / each.range_km if each.ranged else np.nan for value in (*against, sigma)]
    return Residual(
        file=each.file,
        estimator=each.estimator,
        status=each.status,
        days=(each.et - start_et) / 86400.0,
        diameter_px=result.diameters_px[each.file],
        fit_px=against[0][:2],
        truth_px=against[1][:2],
        fit_percent=percent[0],
        truth_percent=percent[1],
        sigma_px=sigma[:2],
        sigma_percent=percent[2],
    )
