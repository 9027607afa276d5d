"""Repair of surfaces: broken facets left out, the others wound alike and outward, small holes closed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from giantlike.core.arrays import Mask, require
from giantlike.core.values import Value
from giantlike.shapes.albedo import FacetAlbedo, VertexAlbedo
from giantlike.shapes.defects import Defects, defects_of, duplicate_facets, edges_of, flat_facets
from giantlike.shapes.mesh import Faces
from giantlike.shapes.surface import Surface, connected_labels

_SAME_PLACE = 1e-9  # vertices nearer than this fraction of the extent are one: poles and seams of grids, computed twice


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Repair(Value):
    """A repaired surface and the changes made."""

    surface: Surface
    before: Defects  # before, after: defects that were found, and those that remain
    after: Defects
    facets_turned: int  # facets that were wound the other way
    holes_filled: int
    facets_added: int


def repair_surface(surface: Surface, *, max_hole_width: float = 0.2) -> Repair:
    """Repair a surface as far as possible without guessing at the shape.

    In order: facets that are invalid, without area or doubled are left out; vertices that coincide to 1e-9 of the
    extent are merged; the facets of each connected piece are wound alike, and outward by its volume (so that a cavity
    becomes a separate body); each hole whose rim is one loop that is narrow enough is closed by a fan around the mean
    of the rim. Edges of more than two facets stay as they are.
    """
    require(max_hole_width >= 0.0, f"max_hole_width must be >= 0, got {max_hole_width}")
    before = defects_of(surface)
    clean = _without_broken_facets(surface)
    require(len(clean.faces) > 0, "nothing to repair: no facet of the surface is valid and has an area")
    faces, turned = _wound_alike(clean)
    wound = replace(clean, faces=faces)
    closed, holes = _fill_holes(wound, max_hole_width)
    faces, turned_pieces = _outward(closed)
    whole = replace(closed, faces=faces)
    return Repair(
        surface=whole,
        before=before,
        after=defects_of(whole),
        facets_turned=int(np.sum(turned ^ turned_pieces[: len(turned)])),
        holes_filled=holes,
        facets_added=len(whole.faces) - len(clean.faces),
    )


def _without_broken_facets(surface: Surface) -> Surface:
    valid = surface.kept(surface.finite_vertices, surface.valid_faces)
    if len(valid.faces) == 0:
        return valid
    merged = valid.merge_vertices().merge_vertices(_SAME_PLACE * float(np.ptp(valid.vertices, axis=0).max()))
    every = np.ones(len(merged.vertices), dtype=bool)
    solid = merged.kept(every, ~flat_facets(merged.vertices, merged.faces))
    single = ~duplicate_facets(solid.faces)
    used = np.zeros(len(solid.vertices), dtype=bool)
    used[solid.faces[single]] = True
    return solid.kept(used, single)


def _neighbors(faces: Faces) -> tuple[Faces, Faces, Mask]:
    """Pairs (p,), (p,) of facets that share an edge of two facets, and whether they are wound alike (p,)."""
    edges = edges_of(faces)
    order = np.argsort(edges.of_side, kind="stable")
    order = order[edges.facets[edges.of_side[order]] == 2]
    first, second = order[0::2], order[1::2]
    return first // 3, second // 3, edges.forward[first] != edges.forward[second]


def _wound_alike(surface: Surface) -> tuple[Faces, Mask]:
    """Faces whose neighbors are all wound alike, and the mask (m,) of those that were reversed.

    Each facet is two nodes of a graph, as it is and turned; neighbors join the nodes that agree. Where both nodes of a
    facet are in one component the surface has one side only (a Moebius strip), and nothing is turned.
    """
    count = len(surface.faces)
    left, right, alike = _neighbors(surface.faces)
    other = np.where(alike, right, right + count)
    mirrored = np.where(alike, right + count, right)
    rows, columns = np.concatenate([left, left + count]), np.concatenate([other, mirrored])
    labels = connected_labels(2 * count, rows, columns)
    as_is, turned = labels[:count], labels[count:]
    smaller_first = as_is > turned  # labels rise with the first node: the first facet of a piece keeps its winding
    return _reverse_faces(surface.faces, smaller_first), smaller_first


def _outward(surface: Surface) -> tuple[Faces, Mask]:
    """Faces whose connected pieces all enclose a positive volume, and the mask (m,) of those reversed."""
    left, right, _ = _neighbors(surface.faces)
    piece = connected_labels(len(surface.faces), left, right)
    corners = surface.vertices[surface.faces] - surface.vertices.mean(axis=0)
    volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    inward = np.bincount(piece, weights=volumes)[piece] < 0.0
    return _reverse_faces(surface.faces, inward), inward


def _reverse_faces(faces: Faces, which: Mask) -> Faces:
    return np.where(which[:, None], faces[:, ::-1], faces)


def _fill_holes(surface: Surface, max_hole_width: float) -> tuple[Surface, int]:
    """Fill small holes; also their number."""
    vertices, faces = [surface.vertices], [surface.faces]
    number, holes = len(surface.vertices), 0
    widest = max_hole_width * np.ptp(surface.vertices, axis=0).max()
    for loop in _rims(surface.faces):
        width = np.ptp(surface.vertices[loop], axis=0).max()
        if len(loop) > 3 and width > widest:
            continue
        holes += 1
        if len(loop) == 3:
            faces.append(loop[None])
            continue
        vertices.append(surface.vertices[loop].mean(axis=0)[None])
        faces.append(np.stack([loop, np.roll(loop, -1), np.full(len(loop), number)], axis=-1))
        number += 1
    if holes == 0:
        return surface, 0
    albedo = surface.albedo
    added = (number - len(surface.vertices), sum(map(len, faces)) - len(surface.faces))
    if albedo is not None:  # new vertices or facets get the mean
        missing = added[0 if isinstance(albedo, VertexAlbedo) else 1]
        values = np.concatenate([albedo.values, np.full(missing, albedo.values.mean())])
        albedo = VertexAlbedo(values) if isinstance(albedo, VertexAlbedo) else FacetAlbedo(values)
    return Surface(
        vertices=np.concatenate(vertices), faces=np.concatenate(faces), in_km=surface.in_km, albedo=albedo
    ), holes


def _rims(faces: Faces) -> list[Faces]:
    """Simple loops of vertices around the holes, against the direction in which the facets run along them."""
    edges = edges_of(faces)
    sides = np.flatnonzero(edges.facets[edges.of_side] == 1)
    start, end = faces.ravel()[sides], np.roll(faces, -1, axis=1).ravel()[sides]
    following = dict(zip(end.tolist(), start.tolist(), strict=True))
    unique, counts = np.unique(np.concatenate([start, end]), return_counts=True)
    pinched = set(unique[counts != 2].tolist())  # two holes meet here: the loops cannot be distinguished
    loops = []
    while following:
        first, at = following.popitem()
        loop = [first]
        while at != first and at in following:
            loop.append(at)
            at = following.pop(at)
        if at == first and len(loop) >= 3 and not pinched.intersection(loop):
            loops.append(np.array(loop, dtype=np.int64))
    return loops
