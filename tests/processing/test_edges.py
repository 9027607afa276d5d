"""Edges to a fraction of a pixel, on disks and half planes that are known exactly."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import dblquad
from scipy.special import ndtr
from scipy.stats import chi2

from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.core.errors import InputError
from giantlike.processing.limb.edges import EdgePoints, Pixels, scan_edges
from giantlike.processing.limb.zernike import zernike_edges, zernike_kernels
from tests.tolerances import RARE

GOAL_PX = 0.03  # of the requirement, root mean square without noise
NORMAL_RAD = 0.04  # rms; of a parabola through three columns on a disk of 8 px
DETECTOR = Detector(gain_e_per_dn=1.0, read_noise_e=5.0)
DIRECTIONS = np.radians(np.arange(5.0, 365.0, 40.0))
METHODS = ("zernike_5", "zernike_7")


@cache
def disk(radius_px: float, blur_px: float) -> tuple[Float, Float]:
    """A bright disk integrated over pixels from a drawing ten times as fine, and its center."""
    size, fine = int(2 * radius_px + 24), 10
    center = np.array([size / 2 + 0.23, size / 2 - 0.31])
    places = (np.arange(size * fine) + 0.5) / fine - 0.5
    x, y = np.meshgrid(places, places)
    drawn = (np.hypot(x - center[0], y - center[1]) < radius_px).astype(np.float64)
    if blur_px > 0:
        drawn = cv2.GaussianBlur(drawn, (0, 0), blur_px * fine)
    return drawn.reshape(size, fine, size, fine).mean(axis=(1, 3)), center


def half_plane(angle_rad: float, offset_px: float, blur_px: float, size: int = 25) -> Float:
    """Dark towards ``angle_rad`` beyond ``offset_px`` from the middle pixel."""
    places = (np.arange(size * 12) + 0.5) / 12 - 0.5 - size // 2
    x, y = np.meshgrid(places, places)
    depth = offset_px - np.cos(angle_rad) * x - np.sin(angle_rad) * y
    result: Float = ndtr(depth / blur_px).reshape(size, 12, size, 12).mean(axis=(1, 3))
    return result


def measured(
    method: str,
    image: Float,
    seeds: Pixels,
    blur_px: float,
    variance: Callable[[Float], Float] = np.zeros_like,
    curvature: float = 0.0,
) -> EdgePoints:
    usable = np.ones(image.shape, dtype=bool)
    size = int(method[-1])
    return zernike_edges(
        image, usable, seeds, variance_dn2=variance, blur_sigma_px=blur_px, size=size, curvature_px=curvature
    )


def all_round(method: str, radius_px: float, blur_px: float) -> tuple[Float, Float]:
    """Errors across and of the normals, of a disk lit from all sides one after the other."""
    light, center = disk(radius_px, blur_px)
    image = 1000.0 * light
    across, turn = [], []
    for angle in DIRECTIONS:
        sunlight = [np.cos(angle), np.sin(angle)]
        usable = np.ones(image.shape, dtype=bool)
        seeds = scan_edges(image, usable, sunlight, threshold_dn=60.0, blur_sigma_px=blur_px)
        edges = measured(method, image, seeds, blur_px, curvature=1.0 / radius_px)
        assert len(edges) > 1.2 * radius_px  # the lit half is pi radii long
        arms = edges.points_px - center
        length = np.linalg.norm(arms, axis=1)
        across.append(length - radius_px)
        true = arms / length[:, None]
        turn.append(np.arcsin(true[:, 0] * edges.normals_px[:, 1] - true[:, 1] * edges.normals_px[:, 0]))
        assert np.all(np.einsum("ij,ij->i", true, edges.normals_px) > 0)
        assert np.all(true @ sunlight < 0.3), "a limb on the dark side was taken"
    return np.concatenate(across), np.concatenate(turn)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("radius_px", "blur_px"), [(8.0, 0.5), (25.0, 0.0), (60.0, 0.7), (60.0, 1.0)])
def test_edges_of_a_disk_lie_where_they_are_all_round(method: str, radius_px: float, blur_px: float) -> None:
    across, turn = all_round(method, radius_px, blur_px)
    assert np.sqrt(np.mean(across**2)) < GOAL_PX
    assert np.sqrt(np.mean(turn**2)) < NORMAL_RAD
    assert abs(np.mean(across)) < 0.3 * GOAL_PX  # and not all to one side


@pytest.mark.parametrize("method", METHODS)
def test_edges_scatter_by_noise_as_they_say(method: str) -> None:
    rng, contrast, blur, errors, turns = np.random.default_rng(7), 400.0, 0.7, [], []
    for angle in np.radians(np.linspace(3.0, 351.0, 30)):
        offset = float(rng.uniform(-0.4, 0.4))
        light = contrast * half_plane(angle, offset, blur)
        for _ in range(20):
            image = light + rng.normal(size=light.shape) * np.sqrt(DETECTOR.variance_dn2(light))
            edges = measured(method, image, np.array([[12, 12]]), blur, DETECTOR.variance_dn2)
            assert len(edges) == 1
            normal = np.array([np.cos(angle), np.sin(angle)])
            errors.append(float((edges.points_px[0] - 12.0) @ normal - offset) / float(edges.sigma_px[0]))
            across = float(normal[0] * edges.normals_px[0, 1] - normal[1] * edges.normals_px[0, 0])
            turns.append(across / float(edges.sigma_normal_rad[0]))
    low, high = (float(chi2.ppf(chance, len(errors))) / len(errors) for chance in (RARE, 1.0 - RARE))
    assert low < np.mean(np.square(errors)) < high
    assert low < np.mean(np.square(turns)) < 1.1 * high  # sampling turns normals a little too


def test_the_contrast_is_the_height_of_the_step() -> None:
    for method in METHODS:
        edges = measured(method, 100.0 + 400.0 * half_plane(0.6, 0.2, 0.6), np.array([[12, 12]]), 0.6)
        assert_allclose(edges.contrast_dn, 400.0, rtol=0, atol=8.0)


@pytest.mark.parametrize("size", [5, 7])
def test_the_kernels_are_the_polynomials_integrated_over_pixels_in_the_circle(size: int) -> None:
    first, second = zernike_kernels(size)
    radius, row, column = size / 2.0, 1, size - 1  # a pixel that the circle cuts
    x0, y0 = column - (size - 1) / 2.0, row - (size - 1) / 2.0

    def integral(of: Callable[[float, float], float]) -> float:
        def low(x: float) -> float:
            return max(y0 - 0.5, -float(np.sqrt(max(radius**2 - x**2, 0.0))))

        def scaled(y: float, x: float) -> float:
            return of(x / radius, y / radius)

        value, _ = dblquad(scaled, x0 - 0.5, x0 + 0.5, low, lambda x: max(y0 + 0.5, low(x)), epsabs=1e-6)
        return float(value) / radius**2

    fine = 1e-4  # 101 x 101 places in the pixel; kernels are up to 0.1
    assert_allclose(first[row, column].real, integral(lambda x, y: x), rtol=0, atol=fine)
    assert_allclose(first[row, column].imag, integral(lambda x, y: y), rtol=0, atol=fine)
    assert_allclose(second[row, column], integral(lambda x, y: 2 * (x * x + y * y) - 1), rtol=0, atol=fine)


def test_the_scan_takes_neither_hot_pixels_nor_the_terminator() -> None:
    rows, columns = np.indices((120, 120))
    x = (columns - 60.0) / 40.0
    sphere = np.hypot(x, (rows - 60.0) / 40.0) < 1.0
    image = np.where(sphere, 800.0 * np.clip(0.2 - x, 0.0, None), 0.0) + 3.0  # fades out towards +x
    image[20, 10] = image[60, 5] = 4000.0  # hot pixels before the limb
    found = scan_edges(image, np.ones(image.shape, dtype=bool), [1.0, 0.0], threshold_dn=20.0)
    assert np.all(np.abs(np.hypot(found[:, 0] - 60.0, found[:, 1] - 60.0) - 40.0) < 2.0)
    assert np.all(found[:, 0] < 70)
    assert len(found) > 60


def test_nothing_lit_gives_no_edges_and_windows_over_the_frame_are_left_out() -> None:
    dark, usable = np.zeros((30, 30)), np.ones((30, 30), dtype=bool)
    seeds = scan_edges(dark, usable, [0.0, 1.0], threshold_dn=1.0)
    assert seeds.shape == (0, 2)
    for method in METHODS:
        assert len(measured(method, dark, seeds, 0.7)) == 0
        assert len(measured(method, dark, np.array([[0, 15], [15, 29]]), 0.7)) == 0
        assert len(measured(method, dark, np.array([[15, 15]]), 0.7)) == 0  # no edge there
    bright = 500.0 * half_plane(0.0, 0.0, 0.6)
    usable = np.ones(bright.shape, dtype=bool)
    usable[12, 13] = False
    assert len(zernike_edges(bright, usable, np.array([[12, 12]]), variance_dn2=np.zeros_like)) == 0


def test_misuse_is_refused() -> None:
    dark, usable = np.zeros((30, 30)), np.ones((30, 30), dtype=bool)
    seeds = np.array([[15, 15]])
    with pytest.raises(InputError, match="size must be 5 or 7"):
        zernike_edges(dark, usable, seeds, variance_dn2=np.zeros_like, size=6)
    with pytest.raises(InputError, match="direction"):
        scan_edges(dark, usable, [0.0, 0.0], threshold_dn=1.0)
    with pytest.raises(InputError, match="differ in shape"):
        scan_edges(dark, usable[:5], [0.0, 1.0], threshold_dn=1.0)
