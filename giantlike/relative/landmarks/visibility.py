"""Selection of landmarks that a camera can use: in the frame, in sight, lit, neither too oblique nor too small."""

from __future__ import annotations

import math
import threading
import weakref
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, require, unit
from giantlike.core.units import RAD_PER_DEG
from giantlike.core.values import Value
from giantlike.ray_tracing import Body, FocalPlane
from giantlike.ray_tracing.tracer import Tracer, tracer_for
from giantlike.shapes import Shape, TriangleMesh
from giantlike.shapes.detail import LevelsOfDetail
from giantlike.shapes.landmarks import LandmarkCatalog

Indices = NDArray[np.int64]

_GRID = 5  # points along each side of a landmark whose sight and light are tested
_LIFT = 0.005  # of the size: height over the ground at which rays start, so that maps do not lie under facets
_MAX_HIDDEN = 0.1  # of the points that other ground may hide: two of the 25: see benchmarks/sensitivity.md
_LEAST_INSIDE = 0.6  # of the points that must lie in the frame: see benchmarks/sensitivity.md


@dataclass(frozen=True, slots=True, kw_only=True)
class VisibilityOptions:
    """Conditions under which a landmark is used.

    max_incidence_deg, max_emission_deg: largest angles of the Sun and of the camera from the normal of a landmark.

    Half and double of each default: ``benchmarks/sensitivity.md``. The angles decide most: half of either leaves so few
    landmarks that errors double or the image is lost. Half of ``max_landmarks`` and of ``min_size_px`` moves results by
    1 sigma; sizes of 20 px and more leave too few landmarks on a body of 200 px.
    """

    max_incidence_deg: float = 75.0
    max_emission_deg: float = 65.0
    max_shadowed: float = 0.4  # largest part of a landmark in the shadow of other ground
    min_size_px: float = 10.0  # least width, foreshortened
    max_size_px: float = 64.0  # of larger ones only the middle is used
    max_landmarks: int = 40  # if more can be used, those with the strongest texture, well spread over the image

    def __post_init__(self) -> None:
        for name in ("max_incidence_deg", "max_emission_deg"):
            value = getattr(self, name)
            require(0.0 < value < 90.0, f"{name} must be in (0, 90), got {value}")
        require(0.0 <= self.max_shadowed <= 1.0, f"max_shadowed must be in [0, 1], got {self.max_shadowed}")
        require(self.min_size_px >= 5.0, f"min_size_px must be >= 5, got {self.min_size_px}")
        require(self.max_size_px >= self.min_size_px, f"max_size_px must be >= min_size_px, got {self.max_size_px}")
        require(self.max_landmarks >= 3, f"max_landmarks must be >= 3, got {self.max_landmarks}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenLandmarks(Value):
    """Landmarks that can be used, and the number of others by reason.

    outside, oblique, hidden, dark, small: numbers out of the frame, too oblique, occulted, not lit, too small.
    """

    numbers: Indices  # (k,); numbers in the catalog
    predicted_px: Float  # (k, 2)
    size_px: Float  # (k,); foreshortened width
    outside: int
    oblique: int
    hidden: int
    dark: int
    small: int

    def __str__(self) -> str:
        return (
            f"{self.numbers.size} landmarks can be used; {self.outside} are out of the frame, {self.oblique} too "
            f"oblique, {self.hidden} hidden, {self.dark} dark, {self.small} too small"
        )


class LandmarkViewer:
    """Landmarks with the ground around them: selects for any pose those that can be seen."""

    def __init__(self, catalog: LandmarkCatalog, shape: Shape) -> None:
        self.points_body_km: Float = np.array([landmark.point_body_km for landmark in catalog.landmarks])
        self.normals_body: Float = np.array([landmark.normal_body for landmark in catalog.landmarks])
        self.sizes_km: Float = np.array([landmark.size_km for landmark in catalog.landmarks])
        self.textures: Float = np.array([landmark.texture for landmark in catalog.landmarks])
        grids = [landmark.grid_body_km(_GRID) for landmark in catalog.landmarks]
        self._owner: Indices = np.repeat(np.arange(len(grids)), [len(grid) for grid in grids])
        mesh = shape.finest if isinstance(shape, LevelsOfDetail) else shape
        self._tracer: Tracer | None = tracer_for(mesh) if isinstance(mesh, TriangleMesh) else None
        self._ground = self._lift(np.concatenate(grids))

    def _lift(self, points: Float) -> Float:
        """Points of the maps (g, 3), moved up where they would start under the shape."""
        up = self.normals_body[self._owner]
        lift = _LIFT * self.sizes_km[self._owner]
        if self._tracer is not None:
            reach = self.sizes_km[self._owner, None] * up
            hits = self._tracer.intersect(points + reach, -up)
            over = np.einsum("ij,ij->i", hits.points_km - points, up)
            near = np.isfinite(over) & (np.abs(over) < self.sizes_km[self._owner])
            lift = lift + np.where(near, np.maximum(over, 0.0), 0.0)
        return np.asarray(points + lift[:, None] * up)

    def find_visible(
        self,
        body: Body,
        plane: FocalPlane,
        *,
        sun_direction_camera: Float,
        options: VisibilityOptions,
    ) -> SeenLandmarks:
        """Select the landmarks that an image can be matched with, for one pose of the body.

        ``sun_direction_camera``: unit vector from body to Sun.
        """
        model, camera_km, sun = plane.model, body.camera_body_km, body.to_body(sun_direction_camera)
        predicted = model.project(body.to_camera(self.points_body_km) + body.position_camera_km)
        to_camera = camera_km - self.points_body_km
        range_km = np.linalg.norm(to_camera, axis=1)
        cos_emission = np.einsum("ij,ij->i", self.normals_body, to_camera) / range_km
        cos_incidence = self.normals_body @ sun
        facing = cos_emission > math.cos(options.max_emission_deg * RAD_PER_DEG)
        lit = cos_incidence > math.cos(options.max_incidence_deg * RAD_PER_DEG)
        ground_px = model.project(body.to_camera(self._ground) + body.position_camera_km)
        inside = self._share(plane.contains(ground_px))
        framed = (inside >= _LEAST_INSIDE) & plane.contains(predicted)
        size_px = self.sizes_km * cos_emission / range_km * model.focal_length_px
        large = size_px >= options.min_size_px
        hidden, dark = np.zeros((2, len(predicted)), dtype=bool)
        look = np.flatnonzero((framed & facing & lit & large)[self._owner])
        if self._tracer is not None and look.size:
            ground = self._ground[look]
            for which, toward, limit in (
                (hidden, unit(camera_km - ground), _MAX_HIDDEN),
                (dark, np.broadcast_to(sun, ground.shape), options.max_shadowed),
            ):
                blocked = np.zeros(self._owner.size, dtype=bool)
                blocked[look] = self._tracer.is_occluded(ground, toward)
                which[:] = self._share(blocked) > limit
        useful = np.flatnonzero(framed & facing & lit & large & ~hidden & ~dark)
        useful = self._select_apart(useful, predicted, options.max_landmarks)
        return SeenLandmarks(
            numbers=useful,
            predicted_px=predicted[useful],
            size_px=size_px[useful],
            outside=int(np.sum(facing & ~framed)),
            oblique=int(np.sum(~facing)),
            hidden=int(np.sum(hidden)),
            dark=int(np.sum(facing & framed & (~lit | dark))),
            small=int(np.sum(facing & framed & lit & ~large)),
        )

    def _share(self, marked: Mask) -> Float:
        """Part (n,) of the points of each landmark that is marked (g,)."""
        count = len(self.points_body_km)
        totals = np.bincount(self._owner, minlength=count)
        return np.asarray(np.bincount(self._owner, weights=marked, minlength=count) / np.maximum(totals, 1))

    def _select_apart(self, numbers: Indices, predicted_px: Float, count: int) -> Indices:
        """At most ``count`` landmarks, each the one with the most texture times distance from those before it."""
        if numbers.size <= count:
            return numbers
        pixels, worth = predicted_px[numbers], self.textures[numbers]
        taken = [int(np.argmax(worth))]
        distance = np.linalg.norm(pixels - pixels[taken[0]], axis=1)
        while len(taken) < count:
            taken.append(int(np.argmax(distance * worth)))
            distance = np.minimum(distance, np.linalg.norm(pixels - pixels[taken[-1]], axis=1))
        return np.sort(numbers[taken])


_VIEWERS: weakref.WeakKeyDictionary[LandmarkCatalog, dict[str, LandmarkViewer]] = weakref.WeakKeyDictionary()
_VIEWERS_LOCK = threading.Lock()


def viewer_for(catalog: LandmarkCatalog, shape: Shape) -> LandmarkViewer:
    """Return the viewer of a catalog on a shape, made once and cached with the catalog."""
    with _VIEWERS_LOCK:
        viewers = _VIEWERS.setdefault(catalog, {})
        if shape.sha256 not in viewers:
            viewers[shape.sha256] = LandmarkViewer(catalog, shape)
        return viewers[shape.sha256]
