"""The gauntlet: off-nominal images from an independent renderer, every estimator on each, and a verdict on each answer.

``giantlike gauntlet`` runs it. Everything of image ``i`` follows from (seed, i): :func:`stage_of` makes it again.
"""

from giantlike.gauntlet.kinds import KINDS, Kind
from giantlike.gauntlet.rule import Facts, Verdict, facts_of, solvable
from giantlike.gauntlet.run import Gauntlet, run_gauntlet
from giantlike.gauntlet.stage import Stage, stage_of
from giantlike.gauntlet.trial import TrialRow, trial

__all__ = [
    "KINDS",
    "Facts",
    "Gauntlet",
    "Kind",
    "Stage",
    "TrialRow",
    "Verdict",
    "facts_of",
    "run_gauntlet",
    "solvable",
    "stage_of",
    "trial",
]
