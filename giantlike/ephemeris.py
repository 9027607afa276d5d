"""Ephemerides of bodies and of the spacecraft: from SPICE, from a table, or fixed.

Two kinds are kept apart so that nothing is corrected twice. An :class:`Ephemeris` is geometric: true
positions with respect to an origin, to which :class:`~giantlike.scene.Scene` applies light time and
stellar aberration. An :class:`ApparentGeometry` has both applied already.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from giantlike.core.arrays import Float, as_finite, require
from giantlike.core.documented import documented_by
from giantlike.core.errors import InputError
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.core.values import Value
from giantlike.io.ephemeris_table import EphemerisSamples, read_ephemeris_table
from giantlike.io.geometry_table import GeometryRow
from giantlike.io.spice import orientation, spk_state

_LIGHT_TIME_STEPS = 5  # fixed-point iterations; each gains a factor v/c, and three suffice for the solar system
BARYCENTER = "SOLAR SYSTEM BARYCENTER"
"""NAIF name of the default origin of positions."""


@runtime_checkable
class Ephemeris(Protocol):
    """Geometric state and orientation of a body, ICRF axes."""

    @property
    def origin(self) -> str:
        """NAIF name of the origin of positions; the ephemerides of a scene must have the same."""
        ...

    def state(self, et: float) -> tuple[Float, Float]:
        """Position (3,), km, and velocity (3,), km/s, with respect to :attr:`origin`, ICRF axes.

        Raises DataError or InputError where the loaded kernels, or the table, do not cover ``et``.
        """
        ...

    def inertial_from_body(self, et: float) -> Rotation:
        """Orientation ``inertial_from_body`` of the body-fixed axes.

        Raises DataError or InputError where the loaded PCK and CK kernels, or the table, do not cover ``et``, or the
        table has no quaternions.
        """
        ...


@documented_by(Ephemeris)
@dataclass(frozen=True, slots=True)
class SpiceEphemeris:
    """A body of the loaded SPICE kernels.

    Parameters
    ----------
    body : str; NAIF name or number as text
    frame : str, optional; body-fixed, for the orientation only; default: the frame of the body
    origin : str; NAIF name of the origin of positions
    """

    body: str
    frame: str = ""
    origin: str = BARYCENTER

    def state(self, et: float) -> tuple[Float, Float]:
        return spk_state(self.body, et, observer=self.origin)

    def inertial_from_body(self, et: float) -> Rotation:
        return orientation(self.frame or self.body, et)


@documented_by(Ephemeris)
@dataclass(frozen=True, slots=True, eq=False)
class FixedEphemeris(Value):
    """A body at rest.

    Parameters
    ----------
    position_km : (3,), km, ICRF; position with respect to ``origin``
    orientation : Rotation; ``inertial_from_body``
    origin : str; NAIF name of the origin of positions
    """

    position_km: Float = field(default_factory=lambda: np.zeros(3))
    orientation: Rotation = field(default_factory=Rotation.identity)
    origin: str = BARYCENTER

    def __post_init__(self) -> None:
        self._keep(position_km=as_finite(self.position_km, (3,), "position_km"))

    def state(self, et: float) -> tuple[Float, Float]:
        return self.position_km.copy(), np.zeros(3)

    def inertial_from_body(self, et: float) -> Rotation:
        return self.orientation


@documented_by(Ephemeris)
class TableEphemeris:
    """A body interpolated between samples: cubic Hermite with velocities, else cubic spline; slerp for orientations.

    Parameters
    ----------
    samples : EphemerisSamples; at least two epochs, increasing
    origin : str; NAIF name of the origin of positions

    Raises
    ------
    InputError
        Fewer than two samples.
    """

    def __init__(self, samples: EphemerisSamples, *, origin: str = BARYCENTER) -> None:
        require(samples.et.size >= 2, f"a table ephemeris needs at least 2 epochs, got {samples.et.size}")
        self.origin = origin
        self._et = samples.et
        if samples.velocity_km_s is not None:
            self._position = CubicHermiteSpline(samples.et, samples.position_km, samples.velocity_km_s)
        else:
            self._position = CubicSpline(samples.et, samples.position_km)
        self._velocity = self._position.derivative()
        rotation = samples.inertial_from_body
        self._orientation = None if rotation is None else Slerp(samples.et, rotation)

    @classmethod
    def load(cls, path: str | Path, *, origin: str = BARYCENTER) -> TableEphemeris:
        """Read a CSV ephemeris of two epochs or more; see :func:`giantlike.io.ephemeris_table.read_ephemeris_table`.

        Parameters
        ----------
        path : path-like
        origin : str; NAIF name of the origin of positions

        Raises
        ------
        DataError
            The file is missing or damaged.
        """
        return cls(read_ephemeris_table(path), origin=origin)

    def state(self, et: float) -> tuple[Float, Float]:
        self._check(et)
        return np.asarray(self._position(et)), np.asarray(self._velocity(et))

    def inertial_from_body(self, et: float) -> Rotation:
        self._check(et)
        if self._orientation is None:
            raise InputError("the table ephemeris has no quaternion columns, so no orientation")
        return self._orientation(et)

    def _check(self, et: float) -> None:
        first, last = float(self._et[0]), float(self._et[-1])
        require(first <= et <= last, f"et {et:.3f} s lies outside the ephemeris table ({first:.3f} to {last:.3f} s)")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ApparentGeometry(Value):
    """Apparent geometry of a body in one image, with light time and stellar aberration applied.

    Parameters
    ----------
    position_inertial_km : (3,), km, ICRF; position of the body center from the camera
    inertial_from_body : Rotation; orientation at the time the light left the body
    sun_direction_inertial : (3,), unitless, ICRF, optional; normalized, from body to Sun; default: by the scene
    velocity_inertial_km_s : (3,), km/s, ICRF, optional
        Velocity of the body with respect to the solar system barycenter when the light left it. Images do not depend
        on it; the geometric position at the time of the image does.

    Raises
    ------
    InputError
        A vector is zero, not finite or of another shape.
    """

    position_inertial_km: Float
    inertial_from_body: Rotation = field(default_factory=Rotation.identity)
    sun_direction_inertial: Float | None = None
    velocity_inertial_km_s: Float | None = None

    def __post_init__(self) -> None:
        position = as_finite(self.position_inertial_km, (3,), "position_inertial_km")
        require(
            float(np.linalg.norm(position)) > 0,
            "position_inertial_km must not be zero: the camera is at the body center",
        )
        object.__setattr__(self, "position_inertial_km", position)
        if self.sun_direction_inertial is not None:
            object.__setattr__(self, "sun_direction_inertial", _unit3(self.sun_direction_inertial))
        if self.velocity_inertial_km_s is not None:
            velocity = as_finite(self.velocity_inertial_km_s, (3,), "velocity_inertial_km_s")
            object.__setattr__(self, "velocity_inertial_km_s", velocity)
        Value.__post_init__(self)

    @classmethod
    def from_row(cls, row: GeometryRow) -> ApparentGeometry:
        """Return the target's geometry in a row, such as ``read_geometry(path).image(file).targets[name]``.

        Raises
        ------
        InputError
            The row has no position or no orientation. (A sphere looks the same from everywhere: give
            ``ApparentGeometry`` its position and the identity.)

        Examples
        --------
        >>> import numpy as np
        >>> from scipy.spatial.transform import Rotation
        >>> from giantlike.io.geometry_table import GeometryRow
        >>> state = {"target_position_inertial_km": np.array([0.0, 0.0, 100.0])}
        >>> row = GeometryRow(file="a.fits", target="ROCK", body_from_inertial=Rotation.identity(), **state)
        >>> ApparentGeometry.from_row(row).position_inertial_km
        array([  0.,   0., 100.])
        """
        position, turn = row.target_position_inertial_km, row.body_from_inertial
        if position is None or turn is None:
            columns = (
                "target_x_km, target_y_km, target_z_km" if position is None else "body_qx, body_qy, body_qz, body_qw"
            )
            raise InputError(f"the row of {row.target or 'no target'} in {row.file} lacks {columns}")
        return cls(
            position_inertial_km=position,
            inertial_from_body=turn.inv(),
            sun_direction_inertial=row.sun_direction_inertial,
            velocity_inertial_km_s=row.target_velocity_inertial_km_s,
        )


@dataclass(frozen=True, slots=True, eq=False)
class DistantLight(Value):
    """A light infinitely far away.

    Parameters
    ----------
    direction_inertial : (3,), ICRF; direction from the bodies to the light; other lengths are normalized

    Raises
    ------
    InputError
        The direction is zero, not finite or of another shape.
    """

    direction_inertial: Float

    def __post_init__(self) -> None:
        self._keep(direction_inertial=_unit3(self.direction_inertial))


def _unit3(value: ArrayLike) -> Float:
    vector = as_finite(value, (3,), "direction")
    length = float(np.linalg.norm(vector))
    require(length > 0, "a direction must not be the zero vector")
    return vector / length


def light_path(source: Ephemeris, et: float, observer_km: Float) -> tuple[Float, float]:
    """Solve the light-time equation for the vector from an observer to a source at emission.

    Solves ``|source(et - t) - observer| = c t`` by fixed-point iteration, as SPICE does for ``CN``.

    Parameters
    ----------
    source : Ephemeris; body that emits or reflects the light
    et : float, TDB seconds past J2000; time of reception
    observer_km : (3,) float64, km, ICRF axes; position of the observer at reception, from the origin of ``source``

    Returns
    -------
    vector_km : (3,) float64, km, ICRF axes
        From the observer to the source.
    emission_et : float, TDB seconds past J2000
        Time of emission.
    """
    emission = et
    vector = source.state(et)[0] - observer_km
    for _ in range(_LIGHT_TIME_STEPS):
        emission = et - float(np.linalg.norm(vector)) / SPEED_OF_LIGHT_KM_S
        vector = source.state(emission)[0] - observer_km
    return vector, emission
