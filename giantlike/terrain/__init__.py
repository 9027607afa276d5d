"""Terrain of bodies: height maps larger than the memory, and the limbs that relief makes."""

from giantlike.terrain.height_map import HeightMap
from giantlike.terrain.limbs import LimbProfile, limb_profile

__all__ = ["HeightMap", "LimbProfile", "limb_profile"]
