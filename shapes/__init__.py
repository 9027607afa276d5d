"""Shapes of bodies: ellipsoids, triangle meshes, their files, and generated asteroids.

Everything is in body axes and km; the origin of a shape is the center of the body for estimators.
"""

from giantlike.core.deprecation import forward_names
from giantlike.shapes.albedo import Albedo, AlbedoMap, FacetAlbedo, VertexAlbedo
from giantlike.shapes.base import Ellipsoid, PlacedEllipsoid, Point, Shape, sphere
from giantlike.shapes.generate import irregular_body, mesh_from_ellipsoid
from giantlike.shapes.limbs import Limb, limb
from giantlike.shapes.load import load_shape
from giantlike.shapes.local_map import LocalMap, overlaid
from giantlike.shapes.mesh import TriangleMesh
from giantlike.shapes.save import save_shape

__all__ = [
    "Albedo",
    "AlbedoMap",
    "Ellipsoid",
    "FacetAlbedo",
    "Limb",
    "LocalMap",
    "PlacedEllipsoid",
    "Point",
    "Shape",
    "TriangleMesh",
    "VertexAlbedo",
    "irregular_body",
    "limb",
    "load_shape",
    "mesh_from_ellipsoid",
    "overlaid",
    "save_shape",
    "sphere",
]

__getattr__ = forward_names(
    __name__,
    {"giantlike.shapes.detail": "LevelsOfDetail levels_of_detail", "giantlike.shapes.generate": "geodesic_directions"},
    until="0.4",
)
