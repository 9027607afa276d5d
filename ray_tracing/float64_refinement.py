"""Refinement in float64 of hits near an edge, where float32 may have chosen the wrong facet.

Embree decides between two facets in float32, 1e-7 of the body's radius to either side of their edge. Where the decision
was wrong, the point on the plane of the facet lies off the facet, and on a facet seen at a glancing angle far off.
"""

from __future__ import annotations

import numpy as np

from giantlike.core.arrays import Float, Indices, unit
from giantlike.ray_tracing.embree import EmbreeSurface

_INSIDE = -1e-9  # barycentric weights of points on an edge, rounded
_RINGS = (3e-7, 2e-6)  # of the radius, distances from the ray at which facets are searched; float32 resolves 6e-8
_TURNS = np.arange(8) * (np.pi / 4.0)  # rad, directions from the ray in which they are searched
_AROUND = np.concatenate([ring * np.column_stack([np.cos(_TURNS), np.sin(_TURNS)]) for ring in _RINGS])


def facet_distances(corners_km: Float, starts_km: Float, directions: Float) -> Float:
    """Distances along rays to facets.

    ``corners_km`` (..., 3, 3); ``starts_km``, ``directions`` (..., 3); returns (...), infinite where a ray misses its
    facet.

    References
    ----------
    .. [1] Moller and Trumbore (1997), Fast, minimum storage ray-triangle intersection: the usual form of the test.
    """
    first = corners_km[..., 0, :]
    along, up, offset = corners_km[..., 1, :] - first, corners_km[..., 2, :] - first, starts_km - first
    p, q = np.cross(directions, up), np.cross(offset, along)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / np.sum(along * p, axis=-1)
        u, v = np.sum(offset * p, axis=-1) * scale, np.sum(directions * q, axis=-1) * scale
        distance = np.sum(up * q, axis=-1) * scale
        inside = (u >= _INSIDE) & (v >= _INSIDE) & (u + v <= 1.0 - _INSIDE) & (distance > 0.0)
    return np.where(inside, distance, np.inf)


def facets_around(
    surface: EmbreeSurface, vertices_km: Float, faces: Indices, starts_km: Float, directions: Float, radius_km: float
) -> tuple[Indices, Float]:
    """Facets near rays that they meet first, in float64.

    ``vertices_km`` (v, 3); ``faces`` (f, 3); ``starts_km``, ``directions`` (k, 3), directions are unit vectors; returns
    ``facets`` (k,); ``distances_km`` (k,), infinite where no facet nearby is met.
    """
    sideways = unit(np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=1)]))
    plane = np.stack([sideways, np.cross(directions, sideways)], axis=1)
    nearby = starts_km[:, None, :] + radius_km * np.einsum("rc,kcx->krx", _AROUND, plane)
    rays = np.broadcast_to(directions[:, None, :], nearby.shape)
    found, _ = surface.first_hit(
        np.ascontiguousarray(nearby.reshape(-1, 3), np.float32), np.ascontiguousarray(rays.reshape(-1, 3), np.float32)
    )
    facets = found.reshape(-1, len(_AROUND)).astype(np.int64)
    starts = np.broadcast_to(starts_km[:, None, :], rays.shape)
    distances = facet_distances(vertices_km[faces[facets]], starts, rays)
    distances[facets < 0] = np.inf
    best = np.arange(len(facets)), distances.argmin(axis=1)
    return facets[best], distances[best]
