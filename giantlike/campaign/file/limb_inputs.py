"""What a campaign file tells of the limbs of its targets: height maps, atmospheres and rings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from giantlike.atmosphere import Atmosphere
from giantlike.campaign.file.schema import Radii, TargetSection
from giantlike.core.arrays import require
from giantlike.rings import Rings
from giantlike.terrain import HeightMap


@dataclass(frozen=True, slots=True, kw_only=True)
class LimbSetup:
    """Limb of a target.

    Parameters
    ----------
    terrain : Path or None
        File of a height map.
    terrain_sigma_km : float or None, km
        Of its heights, where it is not that of the file.
    atmosphere : Atmosphere or None
    rings : Rings or None
    """

    terrain: Path | None = None
    terrain_sigma_km: float | None = None
    atmosphere: Atmosphere | None = None
    rings: Rings | None = None

    @classmethod
    def of(cls, section: TargetSection, where: str, shape: str | Radii, terrain: Path | None) -> LimbSetup:
        """Check what a section tells of the limb of its target.

        Parameters
        ----------
        section : TargetSection
        where : str
            Its place in the file, for messages.
        shape : str or radii
            Mesh file, or the radii of an ellipsoid.
        terrain : Path or None
            The file that it names.

        Returns
        -------
        LimbSetup

        Raises
        ------
        InputError
            The shape is a mesh, or there are both a map and an atmosphere.
        """
        for key, given in (("terrain", terrain), ("atmosphere", section.atmosphere), ("rings", section.rings)):
            smooth = given is None or not isinstance(shape, str)
            require(smooth, f"{where}.{key}: goes with an ellipsoid as shape, got the mesh {shape!r}")
        one = terrain is None or section.atmosphere is None
        require(one, f"{where}: give either terrain or atmosphere: the limb is seen at one of them")
        return cls(
            terrain=terrain,
            terrain_sigma_km=section.terrain_sigma_km,
            atmosphere=section.atmosphere,
            rings=section.rings,
        )

    def height_map(self) -> HeightMap | None:
        """Open the height map, once in a process.

        Returns
        -------
        HeightMap or None
            None without one.

        Raises
        ------
        DataError
            The file is damaged.
        """
        return None if self.terrain is None else _opened(self.terrain, self.terrain_sigma_km)


@lru_cache(maxsize=16)
def _opened(path: Path, sigma_km: float | None) -> HeightMap:
    return HeightMap.open(path, sigma_km=sigma_km)
