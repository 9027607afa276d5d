"""Near and fast stars: motions that a merge of two catalogs cannot know well enough.

Radial motion changes the proper motion of a near star (Barnard's by 1.3 mas/yr each year) and neither catalog of
the default one has radial velocities. Orbits spoil the displacement between two epochs, and Hipparcos gives the two
components of alpha Centauri parallaxes that differ by 42 mas. These values replace the merged ones.

Values and where they come from; every number was read there:

- ``S``: SIMBAD by its TAP service, as recorded with references in a public catalog of near stars: proper motions of
  Gaia EDR3 (2020yCat.1350....0G); radial velocities of 2020AJ....160..120J (Proxima), 2018A&A...616A...7S (Ross 154,
  epsilon Eridani, Lacaille 9352) and 2018MNRAS.475.1960F (Barnard, Lalande 21185, Ross 128).
- ``G``: Gaia DR3 archive, source 4472832130942575872 (Barnard) and 5853498713190525696 (Proxima): proper motion and
  parallax with all digits.
- ``H``: SIMBAD, with the proper motion and parallax of the new reduction of Hipparcos (2007A&A...474..653V), as
  listed for celestial navigation; here only the radial velocity is taken, the catalog has the rest.
- ``K``: parallax of alpha Centauri from its orbit, 747.17 +- 0.61 mas, Kervella, Thevenin and Lovis (2016).
- ``N``: the NOVAS example of Groombridge 1830, from SIMBAD.
- ``L``: radial velocities as listed in a public catalog of the nearest stars, good to about 1 km/s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from giantlike.catalogs.table import StarTable
from giantlike.core.arrays import Float

SIGMA_PM_GAIA_MAS_YR = 0.05  # per axis, of the proper motions here, which are Gaia's


@dataclass(frozen=True, slots=True)
class NearbyStar:
    """Better values of one star; None keeps the value of the catalog."""

    name: str
    star_id: int  # identifier in the default catalog: Gaia DR3, or minus the Hipparcos number
    radial_velocity_km_s: float
    motion_mas_yr: tuple[float, float] | None  # mas/yr; in right ascension (with cos(dec)) and declination
    parallax_mas: float | None  # mas
    source: str  # letters of the list above


NEARBY: Sequence[NearbyStar] = (
    NearbyStar("Proxima Centauri", 5853498713190525696, -20.578199, (-3781.741, 769.465), 768.0665391873573, "SG"),
    NearbyStar("alpha Centauri A", -71683, -21.40, None, 747.17, "HK"),
    NearbyStar("alpha Centauri B", -71681, -20.6, None, 747.17, "LK"),
    NearbyStar(
        "Barnard's star", 4472832130942575872, -110.11, (-801.5509783684709, 10362.394206546573), 546.975939730948, "SG"
    ),
    NearbyStar("Lalande 21185", 762815470562110464, -84.64, (-580.057, -4776.589), None, "S"),
    NearbyStar("Sirius", -32349, -5.50, None, None, "H"),
    NearbyStar("Ross 154", 4075141768785646848, -10.494, (639.368, -193.958), None, "S"),
    NearbyStar("epsilon Eridani", 5164707970261890560, 16.376, (-974.758, 20.876), None, "S"),
    NearbyStar("Lacaille 9352", 6553614253923452800, 8.82, (6765.995, 1330.285), None, "S"),
    NearbyStar("Ross 128", 3796072592206250624, -30.66, (607.299, -1223.028), None, "S"),
    NearbyStar("61 Cygni A", 1872046609345556480, -65.74, (4164.209, 3249.614), None, "LS"),
    NearbyStar("61 Cygni B", 1872046574983497216, -64.07, None, None, "L"),
    NearbyStar("Kapteyn's star", 4810594479418041856, 245.0, (6491.223, -5708.614), None, "LS"),
    NearbyStar("Groombridge 1830", 4034171629042489088, -98.008, (4002.655, -5817.8), 109.0296, "NS"),
    NearbyStar("tau Ceti", 2452378776434477184, -16.40, (-1721.728, 854.963), None, "LS"),
    NearbyStar("epsilon Indi", 6412595290592307840, -40.40, None, None, "L"),
    NearbyStar("Groombridge 34 A", 385334230892516480, 11.60, None, None, "L"),
    NearbyStar("Struve 2398 A", 2154880616774131840, -1.07, None, None, "L"),
    NearbyStar("Struve 2398 B", 2154880616774131712, 1.09, None, None, "L"),
    NearbyStar("Procyon", -37279, -3.2, None, None, "H"),
    NearbyStar("Vega", -91262, -20.60, None, None, "H"),
    NearbyStar("Arcturus", -69673, -5.19, None, None, "H"),
    NearbyStar("Altair", -97649, -26.60, None, None, "H"),
    NearbyStar("Fomalhaut", -113368, 6.50, None, None, "H"),
    NearbyStar("Pollux", -37826, 3.23, None, None, "H"),
    NearbyStar("Capella", -24608, 29.19, None, None, "H"),
    NearbyStar("Aldebaran", -21421, 54.26, None, None, "H"),
    NearbyStar("Menkent", -68933, 1.30, None, None, "H"),
    NearbyStar("Denebola", -57632, -0.20, None, None, "H"),
    NearbyStar("Regulus", -49669, 5.9, None, None, "H"),
    NearbyStar("Polaris", -11767, -16.42, None, None, "H"),
    NearbyStar("Canopus", -30438, 20.30, None, None, "H"),
)
"""Near and fast stars of the default catalog, and bright ones whose radial velocity came with them."""


def radial_velocities(ids: Sequence[int] | np.ndarray[tuple[int], np.dtype[np.int64]]) -> Float:
    """Radial velocities of stars of the default catalog. Returns (n,) km/s, 0 where :data:`NEARBY` has none."""
    known = {star.star_id: star.radial_velocity_km_s for star in NEARBY}
    return np.array([known.get(int(number), 0.0) for number in ids], dtype=np.float64)


def with_nearby(stars: StarTable) -> StarTable:
    """Replace values of stars by the values of :data:`NEARBY`."""
    columns = stars.columns()
    order = np.argsort(stars.ids)
    for star in NEARBY:
        place = np.searchsorted(stars.ids, star.star_id, sorter=order)
        if place == len(stars) or stars.ids[order[place]] != star.star_id:
            continue
        row = order[place]
        columns["radial_velocity_km_s"][row] = star.radial_velocity_km_s
        if star.motion_mas_yr is not None:
            columns["pm_ra_mas_yr"][row], columns["pm_dec_mas_yr"][row] = star.motion_mas_yr
            columns["sigma_pm_mas_yr"][row] = SIGMA_PM_GAIA_MAS_YR
        if star.parallax_mas is not None:
            columns["parallax_mas"][row] = star.parallax_mas
    return StarTable(**columns)
