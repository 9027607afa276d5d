"""ODIN: modes, target determination, calibration, interlock and two-camera pose, replayed by simulation."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from giantlike.missions.replay import Replay, ReplaySettings

CHANGES = {
    "vacuum": "There is no air over the site, and stars and Moon are not corrected for refraction.",
    "albedos_exchanged": "The Earth reflects as the Moon does, and the Moon as the Earth.",
}
"""Assumptions that can be altered."""


def replay(settings: ReplaySettings) -> Replay:
    """Replay Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation (ODIN)."""
    from giantlike.missions.odin.sections import whole_replay

    return whole_replay(settings)
