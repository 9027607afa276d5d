"""Replay of Holt, D'Souza and Saley (2018), Orion Optical Navigation Progress Toward Exploration Mission 1."""

from __future__ import annotations

from giantlike.missions.replay import Replay, ReplaySettings

__all__ = ["CHANGES", "replay"]

CHANGES = {
    "nearly_full": "Images of Moon and Earth are at phase angles of 5 degrees.",
    "smooth_moon": "The Moon of the images has no relief.",
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
        flown="A return from the Moon with a pass a day: linear covariance of plan and filter, and runs flown by "
        "an independent truth, each with its own filter, on measurements drawn from the error models. Images of "
        "Moon and Earth by the independent renderer for the error models and for thin crescents; the gimbal grid "
        "with a made-up lens.",
        pictures=("Fig. 1", "Eqs. 28-38", "Fig. 4", "Fig. 5", "Fig. 10c"),
        assumptions=tuple(table("paper")["assumptions"]),
    )
