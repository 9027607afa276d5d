"""What a star catalogue is, and one that lives in memory."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from giantlike.catalogs.table import StarTable
from giantlike.core.arrays import Float, as_unit, require
from giantlike.core.frames import direction_from_radec
from giantlike.core.units import RAD_PER_MAS

YEARS_FROM_EPOCH = 60.0
"""A cone holds every star that comes into it within this many years of its catalogue epoch."""
OBSERVER_AU = 100.0
"""A cone holds every star that parallax brings into it for an observer this far from the barycentre."""
ABERRATION_RAD = 1.5e-4
"""A cone is this much wider than asked for: aberration at 45 km/s."""


@runtime_checkable
class StarCatalog(Protocol):
    """Stars that can be asked for by direction."""

    @property
    def name(self) -> str:
        """What the user calls it."""
        ...

    @property
    def band(self) -> str:
        """Photometric band of its magnitudes."""
        ...

    @property
    def version(self) -> str:
        """Text for provenance: sources with their versions or hashes."""
        ...

    def cone(
        self, direction_inertial: ArrayLike, radius_rad: float, *, max_magnitude: float | None = None
    ) -> StarTable:
        """Stars within ``radius_rad`` of a unit vector (3,), brightest first; see :class:`MemoryCatalog`."""
        ...


class MemoryCatalog:
    """A catalogue held as arrays sorted by declination.

    Parameters
    ----------
    stars : StarTable
    name, band, version : str
        As in :class:`StarCatalog`.
    """

    def __init__(self, stars: StarTable, *, name: str, band: str, version: str) -> None:
        self._stars = stars.select(np.argsort(stars.dec_deg, kind="stable"))
        self._directions = direction_from_radec(self._stars.ra_deg, self._stars.dec_deg)
        self._margin_rad = _margins(self._stars)
        self._name, self._band, self._version = name, band, version

    @property
    def name(self) -> str:
        """What the user calls it."""
        return self._name

    @property
    def band(self) -> str:
        """Photometric band of its magnitudes."""
        return self._band

    @property
    def version(self) -> str:
        """Text for provenance."""
        return self._version

    @property
    def stars(self) -> StarTable:
        """All stars, by declination."""
        return self._stars

    def cone(
        self, direction_inertial: ArrayLike, radius_rad: float, *, max_magnitude: float | None = None
    ) -> StarTable:
        """Stars within an angle of a direction, brightest first.

        The cone is widened star by star, so that none is missed that is inside at some epoch within
        ``YEARS_FROM_EPOCH`` of its own, from an observer within ``OBSERVER_AU``, with up to ``ABERRATION_RAD``.

        Parameters
        ----------
        direction_inertial : (3,), unitless, inertial
        radius_rad : float, rad
            In (0, pi].
        max_magnitude : float, optional
            Faintest magnitude, in :attr:`band`.

        Raises
        ------
        InputError
            The direction is not a unit vector or the radius is out of range.
        """
        axis = as_unit(direction_inertial, "direction_inertial")
        require(axis.shape == (3,), f"direction_inertial must have shape (3,), got {axis.shape}")
        require(0.0 < radius_rad <= np.pi, f"radius_rad must be in (0, pi], got {radius_rad}")
        band = self._declination_band(float(axis[2]), radius_rad + float(self._margin_rad.max(initial=0.0)))
        reach = np.minimum(radius_rad + self._margin_rad[band], np.pi)
        inside = self._directions[band] @ axis >= np.cos(reach)
        if max_magnitude is not None:
            inside &= self._stars.magnitude[band] <= max_magnitude
        index = np.flatnonzero(inside) + band.start
        return self._stars.select(index[np.argsort(self._stars.magnitude[index], kind="stable")])

    def _declination_band(self, sin_dec: float, radius_rad: float) -> slice:
        center = np.arcsin(np.clip(sin_dec, -1.0, 1.0))
        limits = np.degrees([center - radius_rad, center + radius_rad])
        start, stop = np.searchsorted(self._stars.dec_deg, limits)
        return slice(int(start), int(stop))


def _margins(stars: StarTable) -> Float:
    """(n,) rad by which a star may be seen away from its catalogue position."""
    motion = np.hypot(stars.pm_ra_mas_yr, stars.pm_dec_mas_yr) * YEARS_FROM_EPOCH
    shift = np.maximum(stars.parallax_mas, 0.0) * OBSERVER_AU
    result: Float = (motion + shift) * RAD_PER_MAS + ABERRATION_RAD
    return result
