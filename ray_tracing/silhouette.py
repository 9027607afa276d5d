"""Silhouette of a body: points of its outline in the image, their normals and light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, as_finite, as_floats, require
from giantlike.core.values import Value
from giantlike.ray_tracing.body import Body, sun_in_body
from giantlike.ray_tracing.outline import Crossings, EdgeOutline, outline_of, projected_normals
from giantlike.ray_tracing.sampling import finite_rows
from giantlike.ray_tracing.tracer import Hits
from giantlike.shapes import TriangleMesh

_TANGENT_PX = 0.5  # px to either side over which a normal is taken: one pixel of the outline
_FAR_FOCAL_LENGTHS = 10.0  # 84 deg off the axis of a pinhole camera
_HALVINGS = 40  # of that distance, to find the end of the image: 1e-8 px where the focal length is a thousand
_BEYOND = np.linspace(0.02, 1.0, 12)  # places between outline and the end of the image, as fractions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Silhouette(Value):
    """Outermost points of a body along directions in the image.

    Parameters
    ----------
    angles_rad : (k,) float64, rad
        Directions, from +x (columns) towards +y (rows).
    center_px : (2,) float64, px
        Start of the directions.
    valid : (k,) bool
        False where the direction meets no edge that the camera can image; the other arrays hold NaN (False) there.
    points_px : (k, 2) float64, px
        Limb points in the distorted image.
    points_camera_km : (k, 3) float64, km, camera axes
        The same points on the surface, from the camera.
    normals_px : (k, 2) float64, unitless
        Outward unit normals of the outline in the image, taken over one pixel of it.
    points_by_position : (k, 2, 3) float64, px/km
        Derivative of ``points_px`` with respect to the body's position in camera axes, for fixed directions and a
        fixed ``center_px``. On a mesh that of the edge at hand: it jumps from edge to edge.
    cos_incidence : (k,) float64
        Cosine of the angle from surface normal to Sun.
    lit : (k,) bool
        The Sun is over the horizon there, and nothing in the way.
    """

    angles_rad: Float
    center_px: Float
    valid: Mask
    points_px: Float
    points_camera_km: Float
    normals_px: Float
    points_by_position: Float
    cos_incidence: Float
    lit: Mask


def trace_silhouette(
    body: Body,
    model: CameraModel,
    angles_rad: ArrayLike,
    *,
    sun_direction_camera: ArrayLike,
    center_px: ArrayLike | None = None,
) -> Silhouette:
    """Find the outermost point of a body's outline along each direction in the distorted image.

    Parameters
    ----------
    body : Body
    model : CameraModel
    angles_rad : (k,), rad
        Directions in the image, from +x towards +y.
    sun_direction_camera : (3,), unitless, camera axes
        Unit vector from body to Sun.
    center_px : (2,), px, optional
        Start of the directions; None takes the projection of the body's origin.

    Returns
    -------
    Silhouette

    Raises
    ------
    InputError
        An angle is not finite, a shape is wrong, or the Sun direction is not a unit vector.

    Notes
    -----
    The outline of a mesh is the outermost of its silhouette edges and that of an ellipsoid an ellipse, cut by the
    lines in float64: exact at any range. Only where the camera model images part of the outline are rays shot along
    the line, to see that the body does not go on beyond; edges that it images in part are left out. To first order a
    limb point moves along its normal by ``normal @ model.project_jacobian(point) @ dposition`` when the
    camera-to-body vector changes by ``dposition``.
    """
    angles = as_floats(angles_rad, (), "angles_rad")
    usable = angles.ndim == 1 and bool(np.isfinite(angles).all())
    require(usable, f"angles_rad must be finite and of shape (k,), got {angles.shape}")
    sun_body = sun_in_body(body, sun_direction_camera)
    center = body.center_px(model) if center_px is None else as_finite(center_px, (2,), "center_px")
    body = body.seen_by(model)
    outline = outline_of(body, model)
    edge = outline.outermost(center, angles)
    points_camera_km = edge.points_camera_km
    if not outline.complete:
        covered = _covered(body, model, center, angles, edge.radii_px)
        points_camera_km = np.where(covered[:, None], np.nan, points_camera_km)
    points_px = model.project(points_camera_km)
    valid = finite_rows(points_px)
    grazing_px = projected_normals(model, points_camera_km, edge.normals_camera)
    normals_px = grazing_px
    if isinstance(outline, EdgeOutline):
        chords_px = _chord_normals(outline, center, angles, np.where(valid, edge.radii_px, np.nan))
        normals_px = np.where(np.isfinite(chords_px), chords_px, grazing_px)
    hits = _hits(body, valid, points_camera_km, edge)
    return Silhouette(
        angles_rad=angles.copy(),
        center_px=center,
        valid=valid,
        points_px=points_px,
        points_camera_km=points_camera_km,
        normals_px=normals_px,
        points_by_position=_by_position(model, points_camera_km, grazing_px, angles),
        cos_incidence=np.where(valid, hits.normals @ sun_body, np.nan),
        lit=valid & ~body.tracer.shadowed(hits, sun_body),
    )


def _hits(body: Body, valid: Mask, points_camera_km: Float, edge: Crossings) -> Hits:
    """The surface that faces the camera at outline points."""
    points = body.to_body(points_camera_km - body.position_camera_km)
    normals = body.to_body(edge.normals_camera)
    if isinstance(body.shape, TriangleMesh):
        normals[valid] = body.shape.normals[edge.facets[valid]]
    normals[~valid] = np.nan
    return Hits(valid, points, edge.facets, normals)


def _covered(body: Body, model: CameraModel, center_px: Float, angles_rad: Float, radii_px: Float) -> Mask:
    """Return True for lines (k,) that meet the body again beyond ``radii_px``, up to the end of the camera model."""
    steps = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)
    near, far = radii_px, radii_px + _FAR_FOCAL_LENGTHS * model.focal_length_px
    last = far.copy()
    for _ in range(_HALVINGS):
        imaged = finite_rows(model.unproject(center_px + last[:, None] * steps))
        near, far = np.where(imaged, last, near), np.where(imaged, far, last)
        last = np.where(near >= far, far, 0.5 * (near + far))
    places = radii_px[:, None] + (near - radii_px)[:, None] * _BEYOND
    rays = body.to_body(model.unproject(center_px + places[..., None] * steps[:, None, :]))
    met = body.tracer.occluded(body.camera_body_km, rays.reshape(-1, 3))
    return np.asarray(np.any(met.reshape(-1, _BEYOND.size), axis=1))


def _by_position(model: CameraModel, points_camera_km: Float, normals_px: Float, angles_rad: Float) -> Float:
    """Derivative (k, 2, 3) of outline points along fixed lines: the outline moves along its normals."""
    steps = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)
    outward = np.einsum("ki,kij->kj", normals_px, model.project_jacobian(points_camera_km))
    slant = np.einsum("ki,ki->k", normals_px, steps)
    return np.asarray(steps[:, :, None] * (outward / np.where(slant == 0.0, np.nan, slant)[:, None])[:, None, :])


def _chord_normals(outline: EdgeOutline, center_px: Float, angles_rad: Float, edge_px: Float) -> Float:
    """Outward normals (k, 2) of the chords between outline points half a pixel to either side.

    NaN where the outline breaks off within that pixel: its edge is then not found near ``edge_px``.
    """
    normals = np.full((edge_px.size, 2), np.nan)
    known = np.flatnonzero(edge_px > 0.0)
    radius = np.tile(edge_px[known], 2)
    turn = np.minimum(_TANGENT_PX / radius, 0.05)
    angles = np.tile(angles_rad[known], 2) + np.repeat([-1.0, 1.0], known.size) * turn
    ends = outline.outermost(center_px, angles).radii_px
    ends = np.where(np.abs(ends - radius) < 4.0 * turn * radius, ends, np.nan)
    points = ends[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    tangents = points[known.size :] - points[: known.size]
    lengths = np.linalg.norm(tangents, axis=1, keepdims=True)
    normals[known] = np.stack([tangents[:, 1], -tangents[:, 0]], axis=-1) / np.where(lengths > 0.0, lengths, np.nan)
    return normals
