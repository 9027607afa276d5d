"""Artemis I: the passes of Orion's optical navigation flight test, simulated and processed as flown."""

from __future__ import annotations

from giantlike.missions.replay import Replay, ReplaySettings

CHANGES = {
    "relief_tripled": "The Moon has 6 km of relief, three times that of the models before flight.",
    "ultraviolet": "The camera sees light of 300 nm, which air scatters up to about 35 km.",
    "quiet_stars": "The camera collects a hundred times the electrons: centroids have a tenth of their noise.",
    "noisy_images": "The images of pass 3 have thirty times their read noise.",
}
"""Assumptions that can be altered."""


def replay(settings: ReplaySettings) -> Replay:
    """Replay "Artemis I Optical Navigation System Performance" (Inman, Holt, Christian, Smith and D'Souza)."""
    from giantlike.missions.artemis1.story import tell

    return tell(settings)
