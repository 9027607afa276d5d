"""Missions as data: what a campaign on their images needs to be told, by one name."""

from giantlike.missions.mission import Mission, mission, mission_names

__all__ = ["Mission", "mission", "mission_names"]
