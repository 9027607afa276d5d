"""Inputs of a campaign file on the limbs of its targets: height maps, atmospheres and rings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from giantlike.atmosphere import ATMOSPHERES, Atmosphere, is_airless
from giantlike.campaign.file.schema import Radii, TargetSection
from giantlike.core.arrays import require
from giantlike.rings import Rings
from giantlike.terrain import HeightMap


@dataclass(frozen=True, slots=True, kw_only=True)
class LimbSetup:
    """Limb of a target."""

    terrain: Path | None = None  # file of a height map
    terrain_sigma_km: float | None = None  # sigma of its heights, where it differs from the file's
    atmosphere: Atmosphere | None = None
    rings: Rings | None = None
    air: bool | None = None  # True with air or haze, False without; None where the file does not declare it

    @classmethod
    def from_section(cls, section: TargetSection, where: str, shape: str | Radii, terrain: Path | None) -> LimbSetup:
        """Check the inputs of a section on the limb of its target."""
        for key, given in (("terrain", terrain), ("atmosphere", section.atmosphere), ("rings", section.rings)):
            smooth = given is None or not isinstance(shape, str)
            require(smooth, f"{where}.{key}: goes with an ellipsoid as shape, got the mesh {shape!r}")
        one = terrain is None or section.atmosphere is None
        require(one, f"{where}: give either terrain or atmosphere: the limb is seen at one of them")
        airy = section.air is not False or section.atmosphere is None
        require(airy, f"{where}: an airless body (air = false) has no atmosphere; leave one of the two out")
        atmosphere, body = section.atmosphere, (section.spice_body or section.name).upper()
        if section.air and atmosphere is None and terrain is None and not isinstance(shape, str):
            atmosphere = ATMOSPHERES.get(body)
        return cls(
            terrain=terrain,
            terrain_sigma_km=section.terrain_sigma_km,
            atmosphere=atmosphere,
            rings=section.rings,
            air=False if section.air is None and atmosphere is None and is_airless(body) else section.air,
        )

    def height_map(self) -> HeightMap | None:
        """Open the height map, once in a process. Returns None without one."""
        return None if self.terrain is None else _open_height_map(self.terrain, self.terrain_sigma_km)


@lru_cache(maxsize=16)
def _open_height_map(path: Path, sigma_km: float | None) -> HeightMap:
    return HeightMap.open(path, sigma_km=sigma_km)
