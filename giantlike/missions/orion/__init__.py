"""Replay of Holt, D'Souza and Saley (2018), Orion Optical Navigation Progress Toward Exploration Mission 1."""

from __future__ import annotations

from giantlike.missions.replay import Replay, ReplaySettings

__all__ = ["CHANGES", "replay"]

CHANGES = {
    "nearly_full": "Images of Moon and Earth are at phase angles of 5 degrees.",
    "relief_doubled": "The Moon of the images has 4 km of relief.",
    "lens_in_focus": "The lens is staked in focus.",
}
"""Assumptions that can be altered."""


def replay(settings: ReplaySettings) -> Replay:
    """Replay the paper on Orion's optical navigation."""
    from giantlike.missions.orion.constants import table
    from giantlike.missions.orion.sections import sections

    return Replay(
        name="orion",
        title="Orion optical navigation toward Exploration Mission 1, replayed",
        sections=sections(settings),
        assumptions=tuple(table("paper")["assumptions"]),
    )
