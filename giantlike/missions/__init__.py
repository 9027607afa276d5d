"""Missions as data: defaults of campaigns by name, and replays of published results, a folder each."""

from giantlike.io.mission_files import Mission, mission, mission_names
from giantlike.missions.replay import (
    REPLAYS,
    Comparison,
    ComparisonKind,
    Replay,
    ReplayFigure,
    ReplaySettings,
    Section,
    run_replay,
    save_replay,
    summary_of,
)

__all__ = [
    "REPLAYS",
    "Comparison",
    "ComparisonKind",
    "Mission",
    "Replay",
    "ReplayFigure",
    "ReplaySettings",
    "Section",
    "mission",
    "mission_names",
    "run_replay",
    "save_replay",
    "summary_of",
]
