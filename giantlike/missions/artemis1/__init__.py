"""Artemis I: the passes of Orion's optical navigation flight test, simulated and processed as flown."""

from __future__ import annotations

from giantlike.missions.replay import Replay, ReplaySettings


def replay(settings: ReplaySettings) -> Replay:
    """Replay "Artemis I Optical Navigation System Performance" (Inman, Holt, Christian, Smith and D'Souza)."""
    from giantlike.missions.artemis1.story import tell

    return tell(settings)
