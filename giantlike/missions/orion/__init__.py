"""Replay of Holt, D'Souza and Saley (2018), Orion Optical Navigation Progress Toward Exploration Mission 1."""

from __future__ import annotations

from giantlike.missions.replay import Replay, ReplaySettings

__all__ = ["replay"]

ASSUMPTIONS = (
    "The trajectory: the paper shows none. One was flown back from an entry at 121.92 km with -6 degrees to 25,000 km "
    "from the Moon, under point masses of Earth, Moon and Sun.",
    "The passes: the first hour of each is on the Moon, the second on the Earth, an image every 4 minutes; the last "
    "pass begins 8 h before entry, and a correction follows an hour after each pass but none after the close one.",
    "Corrections aim at the place of the reference at the time of entry; errors of burns are 5 mm/s, of sensing 1 "
    "mm/s.",
    "Errors at the start: 20 km and 0.2 m/s of stray, 10 km and 0.1 m/s of navigation, each component.",
    "Steady sigmas and time constants of the filter's parameters, and its constant noise of images (0.2, 0.1, 0.2 px): "
    "the paper says that they are constant and gives none. Bias states are as large as eqs. 31, 33 and 38 beyond "
    "100,000 km.",
    "The corridor: Fig. 4 has no number in the text; half a degree to either side is assumed.",
    "Nothing edits residuals here, so that linear covariance and flown runs are of one filter; biases stay below what "
    "editing at five sigma would leave out.",
    "The lens: distortion, offset and blur are made up; the detector is as large as the stated field at 35.1 mm.",
    "Images: spheres, or a sphere with bumps of 2 km rms in place of the Moon's terrain, McEwen reflectance, a peak of "
    "3,000 DN, read noise of 5 DN; no atmosphere around the Earth.",
    "Figs. 6, 7 and 8 are photographs of hardware; the rig of III.C and the stray light and radiation of III.D are not "
    "replayed here: `giantlike gauntlet` has off-nominal images of over 80 kinds.",
    "No value was tuned to meet a number of the paper.",
)


def replay(settings: ReplaySettings) -> Replay:
    """Replay the paper on Orion's optical navigation.

    Parameters
    ----------
    settings : ReplaySettings

    Returns
    -------
    Replay
    """
    from giantlike.missions.orion.sections import sections

    return Replay(
        name="orion",
        title="Orion optical navigation toward Exploration Mission 1, replayed",
        sections=sections(settings),
        assumptions=ASSUMPTIONS,
    )
