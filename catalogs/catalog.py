"""Protocol of star catalogs, and a catalog that keeps its stars in arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.catalogs.bands import Band, band_between
from giantlike.catalogs.cells import Index, SkyIndex, sky_index
from giantlike.catalogs.table import COLUMN_TYPES, StarTable
from giantlike.core.arrays import as_unit, require

Column = NDArray[Any] | float | bool  # values (n,) of a column, in any precision, or the one value that all stars have


@runtime_checkable
class StarCatalog(Protocol):
    """Stars that are found by direction."""

    @property
    def name(self) -> str:
        """Name of the catalog, for display."""
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
        """Return the stars within an angle (rad) of a unit vector (3,), inertial, brightest first.

        ``max_magnitude``: the faintest one, in :attr:`band`.
        """
        ...


class MemoryCatalog:
    """A catalog held as arrays, which may be mapped from a file, sorted into cells of the sky.

    Parameters
    ----------
    stars : StarTable
    name, band, version : str; as in :class:`StarCatalog`
    """

    def __init__(self, stars: StarTable, *, name: str, band: str, version: str) -> None:
        order, self._index = sky_index(stars)
        self._columns: Mapping[str, Column] = {name: getattr(stars, name)[order] for name in COLUMN_TYPES}
        self._name, self._band, self._version = name, band, version

    @classmethod
    def of_columns(
        cls, columns: Mapping[str, Column], index: SkyIndex, *, name: str, band: str, version: str
    ) -> MemoryCatalog:
        """Make a catalog of columns of a :class:`StarTable` in the order of an index; nothing is copied."""
        catalog = cls.__new__(cls)
        catalog._columns, catalog._index = columns, index
        catalog._name, catalog._band, catalog._version = name, band, version
        return catalog

    @property
    def name(self) -> str:
        """Name of the catalog, for display."""
        return self._name

    @property
    def band(self) -> str:
        """Photometric band of its magnitudes."""
        return self._band

    @property
    def version(self) -> str:
        """Text for provenance: sources with their versions or hashes."""
        return self._version

    @property
    def columns(self) -> Mapping[str, Column]:
        """The columns as they are kept, in the order of :attr:`index`."""
        return MappingProxyType(dict(self._columns))

    @property
    def index(self) -> SkyIndex:
        """Index of the stars by direction."""
        return self._index

    @property
    def stars(self) -> StarTable:
        """All stars, in the order of :attr:`index`: about by declination, the fast ones last."""
        return self._table(np.arange(len(self)))

    def column(self, name: str) -> NDArray[Any]:
        """Values (n,) of one column of a :class:`StarTable`, in the order of :attr:`index` and the precision kept."""
        return np.broadcast_to(np.asarray(self._columns[name]), len(self))

    def __len__(self) -> int:
        return len(self._index.rank)

    def cone(
        self, direction_inertial: ArrayLike, radius_rad: float, *, max_magnitude: float | None = None
    ) -> StarTable:
        """Return the stars within an angle of a direction, brightest first.

        The cone is a little wider, so that none is missed that is inside at some epoch within 125 years of its epoch,
        from an observer within 100 au, with aberration up to 45 km/s (``catalogs.cells``). A faster observer adds
        the difference to ``radius_rad``.

        Parameters
        ----------
        direction_inertial : (3,), unitless, inertial
        radius_rad : float, rad; in (0, pi]
        max_magnitude : float, optional; faintest magnitude, in :attr:`band`

        Raises
        ------
        InputError
            The direction is not a unit vector or the radius is out of range.
        """
        axis = as_unit(direction_inertial, "direction_inertial")
        require(axis.shape == (3,), f"direction_inertial must have shape (3,), got {axis.shape}")
        require(0.0 < radius_rad <= np.pi, f"radius_rad must be in (0, pi], got {radius_rad}")
        inside = self._index.near(axis, radius_rad)
        if max_magnitude is not None:
            magnitude = self._columns["magnitude"]
            if isinstance(magnitude, np.ndarray):
                inside = inside[magnitude[inside] <= max_magnitude]
            elif magnitude > max_magnitude:
                inside = inside[:0]
        return self._table(inside[np.argsort(self._index.rank[inside])])

    def in_band(self, band: str | Band) -> MemoryCatalog:
        """Return the same stars with magnitudes in another band.

        It is the name of a band in ``catalogs.BANDS``, or a band of the user's own, which may rest on one of those.
        Raises InputError where no relation is known between the band of this catalog and the requested one.
        """
        steps = band_between(self._band, band)
        if not steps:
            return self
        magnitude, bp_rp, bv = (
            np.asarray(self.column(name), dtype=np.float64) for name in ("magnitude", "color_bp_rp", "color_bv")
        )
        for step in steps:
            magnitude = step.magnitude(magnitude, color_bp_rp=bp_rp, color_bv=bv)
        rank = np.empty(len(self), dtype=np.int32)
        rank[np.argsort(magnitude, kind="stable")] = np.arange(len(self), dtype=np.int32)
        index = replace(self._index, rank=rank)
        text = " ".join([self._version, *(f"in {step.text}" for step in steps)])
        return self.of_columns(
            dict(self._columns) | {"magnitude": magnitude}, index, name=self._name, band=steps[-1].name, version=text
        )

    def _table(self, chosen: Index) -> StarTable:
        """Stars by their numbers (k,)."""
        columns = {}
        for name, kind in COLUMN_TYPES.items():
            column = self._columns[name]
            if isinstance(column, np.ndarray):
                columns[name] = column[chosen]
            else:
                columns[name] = np.broadcast_to(np.asarray(column, dtype=kind), len(chosen))
        return StarTable(**columns)
