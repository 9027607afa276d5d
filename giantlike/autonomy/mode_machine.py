"""Modes of an optical-navigation instrument as a state machine: idle, calibration, target determination, processing."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from scipy.spatial.transform import Rotation

from giantlike.autonomy.two_camera_pose import Interlock, PairPose
from giantlike.camera import Camera
from giantlike.core.arrays import require
from giantlike.core.outcomes import Failure


class Mode(StrEnum):
    """Mode of an instrument; with the values used in JSON."""

    IDLE = "idle"  # answers commands, takes no images
    CALIBRATION = "calibration"  # narrow cameras on stars: their models, and the rotation between them
    TARGET_DETERMINATION = "target_determination"
    """Wide cameras: which bodies are where, and the slew that puts one into a narrow camera."""
    PROCESSING = "processing"  # pairs of simultaneous narrow images to attitude and position


@dataclass(frozen=True, slots=True, kw_only=True)
class Slew:
    """Rotation of the vehicle that puts a target into a narrow camera."""

    target: str
    camera: int  # narrow camera, 0 or 1
    new_from_old: Rotation  # of the instrument's axes


@dataclass(frozen=True, slots=True, kw_only=True)
class InstrumentState:
    """Knowledge of an instrument between two cycles."""

    cameras: tuple[Camera, Camera]  # the narrow cameras, rough at first
    mode: Mode = Mode.IDLE
    interlock: Interlock | None = None  # second narrow camera from the first, once calibrated
    target: str | None = None  # the body that a narrow camera sees
    target_camera: int = 1  # the narrow camera that sees it
    slew: Slew | None = None  # requested by the last target determination
    pose: PairPose | None = None  # the last one


Task = Callable[[InstrumentState], InstrumentState | Failure]
"""One cycle of a mode: the new state, or why there is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Telemetry:
    """Report of a cycle or a command."""

    mode: Mode  # in which it was made
    done: bool
    detail: str  # result, or the reason of the failure
    cpu_s: float = 0.0  # time of the processor that it took


@dataclass(frozen=True, slots=True)
class ModeMachine:
    """Carries out the cycles of the modes and refuses commands that a state does not allow.

    Parameters
    ----------
    tasks : mapping of Mode to callable
        For every mode but ``IDLE``: takes and returns an :class:`InstrumentState`, or a Failure. A mode without a task
        cannot be commanded: an instrument without wide cameras has no target determination.
    """

    tasks: Mapping[Mode, Task]

    def __post_init__(self) -> None:
        require(Mode.IDLE not in self.tasks, "idle has no task")

    def command(
        self, state: InstrumentState, mode: Mode, *, target: str | None = None, target_camera: int | None = None
    ) -> tuple[InstrumentState, Telemetry]:
        """Change the mode; a refused command leaves the state as it was.

        ``target`` is the body that the target camera, 0 or 1, sees, as declared; InputError for another camera.
        """
        require(target_camera in (None, 0, 1), f"target_camera must be 0 or 1, got {target_camera}")
        asked = replace(
            state,
            mode=mode,
            target=state.target if target is None else target,
            target_camera=state.target_camera if target_camera is None else target_camera,
        )
        refused = self._find_objection(asked)
        if refused:
            return state, Telemetry(mode=state.mode, done=False, detail=refused)
        return asked, Telemetry(mode=mode, done=True, detail=f"{state.mode} to {mode}")

    def _find_objection(self, state: InstrumentState) -> str:
        """Why a state's mode is not allowed; empty where it is."""
        if state.mode is Mode.IDLE:
            return ""
        if state.mode not in self.tasks:
            return f"this instrument has no {state.mode}"
        if state.mode is Mode.PROCESSING and state.interlock is None:
            return "processing needs the rotation between the cameras: command calibration first"
        if state.mode is Mode.PROCESSING and state.target is None:
            return "processing needs a target: command target_determination, or name one"
        return ""

    def step(self, state: InstrumentState) -> tuple[InstrumentState, Telemetry]:
        """Carry out one cycle of the mode; one that fails leaves the state as it was."""
        if state.mode is Mode.IDLE:
            return state, Telemetry(mode=state.mode, done=True, detail="idle")
        start = time.process_time()
        result = self.tasks[state.mode](state)
        spent = time.process_time() - start
        if isinstance(result, Failure):
            detail = f"{result.reason}: {result.detail}"
            return state, Telemetry(mode=state.mode, done=False, detail=detail, cpu_s=spent)
        return result, Telemetry(mode=state.mode, done=True, detail=_told(result), cpu_s=spent)


def _told(state: InstrumentState) -> str:
    """Result of a cycle, in one line."""
    if state.mode is Mode.CALIBRATION:
        focal = " and ".join(f"{camera.model.focal_length_px:.2f}" for camera in state.cameras)
        return f"focal lengths {focal} px, interlock known"
    if state.mode is Mode.TARGET_DETERMINATION and state.slew is not None:
        return f"{state.slew.target} for camera {state.slew.camera}"
    if state.pose is None:
        return "no pose"
    return f"{state.pose.target} at {float((state.pose.position_camera_km**2).sum()) ** 0.5:.0f} km"
