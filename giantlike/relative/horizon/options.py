"""Options of estimators on horizons of ellipsoids."""

from __future__ import annotations

from dataclasses import dataclass, replace

from giantlike.core.arrays import require, require_number
from giantlike.relative.horizon.geometry import Altitude
from giantlike.relative.limb.fix import EdgeModel, IteratedSearch, ScanOptions
from giantlike.rings import Rings
from giantlike.scene import Target, TargetGeometry

_LAW_POWERS, _STEP_POWERS = 2, 3
"""Powers of the cosine of emission that are free in every cell: a line on the law, or a parabola without one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HorizonScan(ScanOptions):
    """Options of the cells along the horizon of an ellipsoid.

    edges: with ``TEMPLATE`` the brightness inside is that of the reflectance law times a line in the cosine of
        emission; with ``STEP`` a parabola in that cosine under any law. With both, fractions of other laws are
        estimated.
    window_px: largest distance of pixels used, to both sides of the horizon.
    cell_px: length of the cells along the horizon, each with its own brightness; on small disks they are shorter.
    min_cells: fewer good cells than this are no limb.
    min_contrast: mean of (inside - outside) / (inside + outside) across the limb below which no limb was located.
    psf_error: relative standard deviation of the width of the camera's point spread function. The limb itself
        constrains the width better: with one declared 30 % too wide or narrow, squared errors at 30 to 300 px are
        0.6-1.1 per degree of freedom with 0.1 to 0.4 here, and sigmas change by 2 %; with 0.05 they reach 2.2.
    rings_km: inner and outer radius of rings in the equator of the body, whose pixels and shadow are left out. Without
        them, the rings of the target.
    """

    cell_px: float = 7.0
    min_cells: int = 8
    psf_error: float = 0.2
    rings_km: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        ScanOptions.__post_init__(self)
        require_number(self.window_px, "window_px", least=2.0)
        require_number(self.cell_px, "cell_px", least=2.0, most=50.0)
        require_number(self.min_cells, "min_cells", least=6)
        if self.rings_km is not None:
            require(len(self.rings_km) == 2, f"rings_km must be an inner and an outer radius, got {self.rings_km}")
            object.__setattr__(self, "rings_km", tuple(float(radius) for radius in self.rings_km))
            Rings(*self.rings_km)  # checks the values

    def about(self, target: Target) -> HorizonScan:
        """Return the options with the rings of a target, where they declare none."""
        rings = target.rings
        return (
            self
            if rings is None or self.rings_km is not None
            else replace(self, rings_km=(rings.inner_km, rings.outer_km))
        )

    @property
    def powers(self) -> int:
        """Powers of the cosine of emission that are free in every cell."""
        return _LAW_POWERS if self.edges is EdgeModel.TEMPLATE else _STEP_POWERS


@dataclass(frozen=True, slots=True, kw_only=True)
class HorizonSearch(IteratedSearch):
    """Options of the estimators on horizons of ellipsoids.

    Parameters
    ----------
    limb_altitude_km : float, km
        Altitude of the apparent limb above the shape, by haze or an atmosphere. Where this and its sigma are 0, the
        altitude of the target's atmosphere is used.
    altitude_sigma_km : float, km
        Standard deviation of the altitude; where it is not zero the altitude is estimated with the position.
    """

    limb_altitude_km: float = 0.0
    altitude_sigma_km: float = 0.0

    def __post_init__(self) -> None:
        IteratedSearch.__post_init__(self)
        Altitude(self.limb_altitude_km, self.altitude_sigma_km)  # checks the values

    def altitude(self, geometry: TargetGeometry) -> Altitude:
        """Return the a priori altitude of the limb, of a target that may have an atmosphere."""
        own = Altitude(self.limb_altitude_km, self.altitude_sigma_km)
        return Altitude.from_geometry(geometry) if own == Altitude() else own
