"""The campaigns of a phase, with its shape model and its visits."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from giantlike.camera import Camera
from giantlike.core.detector import GaussianPsf
from giantlike.core.values import Value
from giantlike.missions.osiris_rex.body import model_of
from giantlike.missions.osiris_rex.campaigns import CampaignJob, CampaignResult
from giantlike.missions.osiris_rex.images import Planner
from giantlike.missions.osiris_rex.setup import MissionSetup, PhaseSetup
from giantlike.missions.osiris_rex.trajectory import visits_of
from giantlike.missions.replay import ReplaySettings
from giantlike.shapes import TriangleMesh


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhaseInputs(Value):
    """Inputs common to all phases.

    truth: Bennu as it is.
    calibrated: calibrated cameras; an uncalibrated one is declared exactly, but for the width of its point spread
        function.
    kernels: folder with kernels of the mission.
    """

    mission: MissionSetup
    truth: TriangleMesh
    calibrated: Mapping[str, Camera]
    kernels: Path | None
    settings: ReplaySettings

    def run(
        self, phase: PhaseSetup, chosen: Mapping[tuple[str, str], Sequence[int]] | None = None
    ) -> tuple[CampaignResult, ...]:
        """Run the campaigns of a phase."""
        mission, settings = self.mission, self.settings
        results = []
        for setup in phase.campaigns:
            numbers = range(len(setup.visits)) if chosen is None else chosen.get((phase.key, setup.camera), ())
            if not numbers:
                continue
            planner = Planner(
                mission=mission,
                setup=mission.cameras[setup.camera],
                camera=mission.true_camera(setup.camera),
                truth=self.truth,
                phase=phase,
                seed=settings.seed,
            )
            facets = phase.model.facets * len(self.truth.faces) // mission.body.facets
            job = CampaignJob(
                planner=planner,
                setup=setup,
                visits=visits_of([setup.visits[number] for number in numbers], mission.orbit, self.kernels),
                declared=self._declared_camera(setup.camera),
                model=model_of(self.truth, phase.model, seed=settings.seed, facets=facets),
                folder=settings.output / f"{phase.key}_{setup.camera}",
                workers=settings.workers,
            )
            results.append(job.run(settings.progress))
        return tuple(results)

    def _declared_camera(self, key: str) -> Camera:
        if key in self.calibrated:
            return self.calibrated[key]
        psf = GaussianPsf(sigma_px=self.mission.detector.told_psf_sigma_px)
        return dataclasses.replace(self.mission.true_camera(key), psf=psf)
