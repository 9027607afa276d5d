"""State of the spacecraft."""

from __future__ import annotations

from dataclasses import dataclass

from giantlike.core.arrays import Float, as_finite
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObserverState(Value):
    """Position and velocity of the spacecraft with respect to the solar system barycenter, ICRF axes.

    Parameters
    ----------
    position_km : (3,) float64, km; position
    velocity_km_s : (3,) float64, km/s; velocity

    Raises
    ------
    InputError
        A wrong shape, or a value that is not finite.
    """

    position_km: Float
    velocity_km_s: Float

    def __post_init__(self) -> None:
        self._keep(
            position_km=as_finite(self.position_km, (3,), "observer position_km"),
            velocity_km_s=as_finite(self.velocity_km_s, (3,), "observer velocity_km_s"),
        )
