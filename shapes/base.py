"""Protocol of shapes, the triaxial ellipsoid and the point.

Shapes are in body axes, km; the origin is the center of the body for estimators.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, as_finite, require
from giantlike.core.errors import InputError
from giantlike.core.values import Value
from giantlike.shapes.albedo import Albedo, FacetAlbedo, VertexAlbedo, hash_with_albedo


class Shape(Protocol):
    """The surface of a body, in body axes; an immutable value."""

    @property
    def name(self) -> str:
        """Name of the shape: the stem of its file, for shapes that came from one."""
        ...

    @property
    def sha256(self) -> str:
        """Hash of the file it came from, or of the numbers that define it; hexadecimal."""
        ...

    @property
    def circumscribing_radius_km(self) -> float:
        """Largest distance of the surface from the origin, km."""
        ...

    @property
    def mean_radius_km(self) -> float:
        """Radius of the sphere of the same volume, km."""
        ...

    @property
    def best_fit_ellipsoid(self) -> PlacedEllipsoid:
        """Ellipsoid with the same second moments of volume, for estimators that need an ellipsoid."""
        ...

    @property
    def albedo(self) -> Albedo | None:
        """Relative albedo over the surface; None means 1 everywhere."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class Ellipsoid(Value):
    """A triaxial ellipsoid about the origin, its axes along the body axes.

    Parameters
    ----------
    radii_km : (3,) float64, km; semi-axes along body x, y and z
    name : str
    albedo : Albedo, optional; relative albedo; it enters the hash

    Raises
    ------
    InputError
        A radius is not positive and finite, or the albedo is one of facets or vertices.
    """

    radii_km: Float
    name: str = "ellipsoid"
    albedo: Albedo | None = None
    sha256: str = field(init=False)

    def __post_init__(self) -> None:
        radii = as_finite(self.radii_km, (3,), "radii_km")
        require(bool(np.all(radii > 0)), f"radii_km must be > 0, got {radii.tolist()}")
        object.__setattr__(self, "radii_km", radii)
        require(
            not isinstance(self.albedo, FacetAlbedo | VertexAlbedo),
            "an ellipsoid has no facets or vertices: give it an AlbedoMap",
        )
        content = hashlib.sha256(b"ellipsoid" + radii.tobytes()).hexdigest()
        self._keep(sha256=hash_with_albedo(content, self.albedo))

    @property
    def circumscribing_radius_km(self) -> float:
        """Longest semi-axis, km."""
        return float(self.radii_km.max())

    @property
    def mean_radius_km(self) -> float:
        """Radius of the sphere of the same volume, km."""
        return float(np.cbrt(np.prod(self.radii_km)))

    @property
    def volume_km3(self) -> float:
        """Volume, km^3."""
        return float(4.0 / 3.0 * np.pi * np.prod(self.radii_km))

    @property
    def best_fit_ellipsoid(self) -> PlacedEllipsoid:
        """The ellipsoid itself, at the origin of the body."""
        return PlacedEllipsoid(ellipsoid=self, center_body_km=np.zeros(3), body_from_axes=Rotation.identity())

    def with_albedo(self, albedo: Albedo | None) -> Ellipsoid:
        """Return the same ellipsoid with another relative albedo."""
        return replace(self, albedo=albedo)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedEllipsoid(Value):
    """An ellipsoid with its own center and axes in a body.

    Parameters
    ----------
    ellipsoid : Ellipsoid
    center_body_km : (3,) float64, km, body; from the origin of the shape to the center of the ellipsoid
    body_from_axes : Rotation; takes vectors along the axes of the ellipsoid to body axes
    """

    ellipsoid: Ellipsoid
    center_body_km: Float
    body_from_axes: Rotation

    def __post_init__(self) -> None:
        self._keep(center_body_km=as_finite(self.center_body_km, (3,), "center_body_km"))


@dataclass(frozen=True, slots=True, kw_only=True, weakref_slot=True)
class Point:
    """A body without extent at the origin: a star-like target of unknown size and shape.

    Its light comes from its center at every phase angle, so that no correction applies. It has no limb and no
    best-fit ellipsoid.

    Parameters
    ----------
    name : str
    """

    name: str = "point"

    @property
    def sha256(self) -> str:
        """Hash, hexadecimal, the same for all points."""
        return hashlib.sha256(b"point").hexdigest()

    @property
    def circumscribing_radius_km(self) -> float:
        """Zero, km."""
        return 0.0

    @property
    def mean_radius_km(self) -> float:
        """Zero, km."""
        return 0.0

    @property
    def best_fit_ellipsoid(self) -> PlacedEllipsoid:
        """Raise an InputError: a point has no ellipsoid."""
        raise InputError(f"{self.name!r} is a point, without limb or ellipsoid: only its light can be measured")

    @property
    def albedo(self) -> None:
        """None: a point has no surface."""
        return


def sphere(radius_km: ArrayLike, *, name: str = "sphere") -> Ellipsoid:
    """Make a sphere: an ellipsoid with three equal semi-axes.

    Parameters
    ----------
    radius_km : float, km
    name : str
    """
    return Ellipsoid(radii_km=np.full(3, radius_km, dtype=np.float64), name=name)
