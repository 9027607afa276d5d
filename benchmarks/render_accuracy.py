"""Templates beside a supersampled reference that shares no code with the tracer; prints JSON.

Run with ``OMP_NUM_THREADS=1 python benchmarks/render_accuracy.py``; takes some minutes. The reference draws each facet
by itself in float64 through a pinhole camera: which facet a ray meets follows from three triple products and the
nearest plane, shadows from a test against every facet that may stand in the way, brightness from facet normals. Its
rays form a regular grid, 16 to 96 along each side of a pixel. Bodies stand at several places within a pixel.

Columns: root mean square over the places of the centroid shift, px; largest error of a pixel, and fraction of pixels
off by more than 2e-3, both over the peak; largest error of the total; CPU time. ``default`` is 2 rays a side and at
least 256 across the body; the other rows have as many rays a side as they say, in the middle of their cells or anywhere
in them. How well the reference is known shows beside a reference with half as many rays a side; how
exact the tracer is shows in ``same_rays_as_reference``, where both send the same 64 rays through each pixel.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import GaussianPsf
from giantlike.ray_tracing import Body, McEwen, RenderOptions, Template, render
from giantlike.shapes import TriangleMesh, irregular_body

FACETS = 2000
RANGE_KM = 500.0
SUN = unit(np.array([0.95, 0.2, -0.25]))
TURN = Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True)
PSF_SIGMA_PX = 0.8
PIXEL_OFF = 2e-3
SIZES_PX = {20: (96, 6), 100: (40, 3), 300: (16, 2)}
"""Diameter, px: rays of the reference along a side of a pixel, and places within a pixel."""
OPTIONS = {
    "default": RenderOptions(),
    **{f"{n}x{n}": RenderOptions(rays_per_pixel_side=n, min_rays_across=1) for n in (1, 2, 3)},
    **{f"{n}x{n}_jittered": RenderOptions(rays_per_pixel_side=n, min_rays_across=1, jitter_seed=1) for n in (1, 2, 3)},
}
SAME_RAYS = 8
OPTION_SAME_RAYS = RenderOptions(rays_per_pixel_side=SAME_RAYS, min_rays_across=1)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A mesh in camera axes, km, before a square pinhole camera."""

    corners: Float  # (m, 3, 3)
    normals: Float  # (m, 3)
    focal_px: float
    size_px: int

    @property
    def model(self) -> PinholeModel:
        """The camera, boresight in the middle."""
        middle = 0.5 * (self.size_px - 1)
        return PinholeModel(fx_px=self.focal_px, fy_px=self.focal_px, cx_px=middle, cy_px=middle)


def fine_image(scene: Scene, side: int) -> Float:
    """Brightness (size * side, size * side) of single rays."""
    count = scene.size_px * side
    place = ((np.arange(count) + 0.5) / side - 0.5 * scene.size_px) / scene.focal_px
    nearest = np.zeros((count, count))
    facet = np.full((count, count), -1, dtype=np.int32)
    facing = np.flatnonzero(np.einsum("ij,ij->i", scene.normals, scene.corners[:, 0]) < 0.0)
    boxes = {}
    for index in facing.tolist():
        corners = scene.corners[index]
        image = corners[:, :2] / corners[:, 2:]
        low, high = (np.searchsorted(place, edge(axis=0)) for edge in (image.min, image.max))
        box = slice(low[1], high[1]), slice(low[0], high[0])
        x, y = place[box[1]], place[box[0]][:, None]
        inside = np.ones((y.size, x.size), bool)
        for a, b in ((0, 1), (1, 2), (2, 0)):
            across = np.cross(corners[a], corners[b])
            inside &= across[0] * x + across[1] * y + across[2] <= 0.0
        normal = scene.normals[index]
        closeness = (normal[0] * x + normal[1] * y + normal[2]) / (normal @ corners[0])  # 1 over the distance along z
        closer = inside & (closeness > nearest[box])
        nearest[box][closer] = closeness[closer]
        facet[box][closer] = index
        boxes[index] = box
    light = np.zeros((count, count))
    shadows = Shadows(scene)
    for index, box in boxes.items():
        rows, columns = np.nonzero(facet[box] == index)
        if rows.size == 0 or scene.normals[index] @ SUN <= 0.0:
            continue
        x, y = place[box[1]][columns], place[box[0]][rows]
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        points = rays / nearest[box][rows, columns][:, None]
        rays = unit(rays)
        brightness = McEwen()(scene.normals[index] @ SUN, -(rays @ scene.normals[index]), np.arccos(-(rays @ SUN)))
        light[box][rows, columns] = np.where(shadows.on(index, points), 0.0, brightness)
    return light


class Shadows:
    """Which points of a facet see the Sun, by a float64 test of every facet that may stand in the way."""

    def __init__(self, scene: Scene) -> None:
        across = unit(np.cross(SUN, [0.0, 0.0, 1.0]))
        self.axes = np.stack([across, np.cross(SUN, across), SUN])
        self.corners = scene.corners @ self.axes.T
        self.low, self.high = self.corners.min(axis=1), self.corners.max(axis=1)
        self.lit = scene.normals @ SUN > 0.0

    def on(self, index: int, points: Float) -> NDArray[np.bool_]:
        """Whether points (n, 3) of a facet lie in shadow."""
        beside = np.any((self.low > self.high[index])[:, :2] | (self.high < self.low[index])[:, :2], axis=1)
        others = np.flatnonzero(self.lit & ~beside & (self.high[:, 2] > self.low[index, 2]))
        x, y, height = (points @ self.axes.T).T
        dark = np.zeros(len(points), bool)
        for other in others[others != index]:
            a, b, c = self.corners[other]
            area = _turn(a, b, c[0], c[1])
            shares = [_turn(p, q, x, y) / area for p, q in ((b, c), (c, a), (a, b))]
            above = shares[0] * a[2] + shares[1] * b[2] + shares[2] * c[2] - height
            dark |= (np.minimum(np.minimum(*shares[:2]), shares[2]) >= 0.0) & (above > 1e-9)
        return dark


def _turn(a: Float, b: Float, x: Float, y: Float) -> Float:
    return np.asarray((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]))


def pixels(fine: Float, side: int, sigma_px: float) -> Float:
    """Means over pixels of a fine image after a Gaussian PSF, which is applied to means over quarters of pixels."""
    quarters = _means(fine, side // 4)
    if sigma_px > 0.0:
        sigma = np.sqrt((4.0 * sigma_px) ** 2 - 1.0 / 12.0)  # the means have blurred by a box already
        quarters = gaussian_filter(quarters, sigma, truncate=6.0, mode="constant")
    return _means(quarters, 4)


def _means(image: Float, side: int) -> Float:
    size = image.shape[0] // side
    return np.asarray(image.reshape(size, side, size, side).mean(axis=(1, 3)))


def centroid(image: Float) -> Float:
    y, x = np.indices(image.shape)
    return np.asarray(np.array([(x * image).sum(), (y * image).sum()]) / image.sum())


def compared(found: list[Float], reference: list[Float]) -> dict[str, Any]:
    pairs = list(zip(found, reference, strict=True))
    shifts = [np.linalg.norm(centroid(image) - centroid(truth)) for image, truth in pairs]
    errors = [np.abs(image - truth) / truth.max() for image, truth in pairs]
    return {
        "centroid_shift_px": float(np.sqrt(np.mean(np.square(shifts)))),
        "worst_pixel": max(float(error.max()) for error in errors),
        "pixels_off": float(np.mean([np.mean(error > PIXEL_OFF) for error in errors])),
        "worst_total": max(abs(float(image.sum() / truth.sum()) - 1.0) for image, truth in pairs),
    }


def measured(mesh: TriangleMesh, diameter_px: int, side: int, places: int) -> dict[str, Any]:
    focal_px = 0.5 * diameter_px / mesh.circumscribing_radius_km * RANGE_KM
    size_px = int(1.05 * diameter_px) + 14
    random = np.random.default_rng(diameter_px)
    bodies, fine, coarse, same_rays = [], [], [], []
    start = time.process_time()
    for _ in range(places):
        offset_km = np.append(random.uniform(-0.5, 0.5, size=2) * RANGE_KM / focal_px, RANGE_KM)
        body = Body(shape=mesh, camera_from_body=TURN, position_camera_km=offset_km)
        corners = body.to_camera(mesh.vertices_km)[mesh.faces] + offset_km
        scene = Scene(corners=corners, normals=body.to_camera(mesh.normals), focal_px=focal_px, size_px=size_px)
        bodies.append((body, scene.model))
        same_rays.append(pixels(fine_image(scene, SAME_RAYS), SAME_RAYS, 0.0))
        fine.append(fine_image(scene, side))
        coarse.append(fine_image(scene, side // 2))
    rendered(*bodies[0], size_px, 0.0, OPTION_SAME_RAYS)  # builds the tree of the mesh
    table: dict[str, Any] = {"reference_s": round(time.process_time() - start, 1), "rays_per_pixel_side": side}
    for label, sigma_px in (("pixels", 0.0), ("psf", PSF_SIGMA_PX)):
        reference = [pixels(image, side, sigma_px) for image in fine]
        coarser = [pixels(image, side // 2, sigma_px) for image in coarse]
        rows: dict[str, Any] = {"reference_with_half_as_many": compared(coarser, reference)}
        if sigma_px == 0.0:
            found = [rendered(body, model, size_px, 0.0, OPTION_SAME_RAYS) for body, model in bodies]
            rows["same_rays_as_reference"] = compared(found, same_rays)
        for name, options in OPTIONS.items():
            begin = time.process_time()
            found = [rendered(body, model, size_px, sigma_px, options) for body, model in bodies]
            spent_ms = round(1e3 * (time.process_time() - begin) / places, 1)
            rows[name] = compared(found, reference) | {"cpu_ms": spent_ms}
        table[label] = rows
    return table


def rendered(body: Body, model: PinholeModel, size_px: int, sigma_px: float, options: RenderOptions) -> Float:
    psf = GaussianPsf(sigma_px=sigma_px) if sigma_px > 0.0 else None
    template = render(body, model, sun_direction_camera=SUN, psf=psf, columns=size_px, rows=size_px, options=options)
    assert isinstance(template, Template)
    return template.placed(size_px, size_px)


def main() -> None:
    mesh = irregular_body(1, facets=FACETS)
    report = {f"{size}_px": measured(mesh, size, *plan) for size, plan in SIZES_PX.items()}
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
