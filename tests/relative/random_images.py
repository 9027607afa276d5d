"""Random images, bodies, cameras and declared errors: most hold what no estimator expects.

``python -m tests.relative.random_images FIRST COUNT`` runs every estimator on many of them and prints what broke down.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera, ModelUncertainty
from giantlike.camera_models import CameraModel
from giantlike.camera_models.part import divisible
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import CenterFix, Failure, Reason
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.ray_tracing import Body, Lambert, LommelSeeliger, McEwen, RenderOptions, Template, render
from giantlike.relative import ESTIMATORS
from giantlike.scene import Scene, Target, TargetUncertainty
from giantlike.shapes import Ellipsoid, Shape, mesh_from_ellipsoid
from tests.camera_models.test_camera_models import EVERY
from tests.fixed_grid import FixedGrid

SIZE = 96  # px
LENSES: tuple[CameraModel, ...] = (*EVERY, FixedGrid(step_rad=1e-3))
PATTERNS = (
    "body", "body", "body", "noise", "constant", "stripes", "gradient", "points", "half", "masked", "another",
    "inverted", "saturated",
)  # fmt: skip


@dataclass(frozen=True)
class RandomImage:
    """An image, and everything that an estimator takes with it."""

    image: Image
    camera: Camera
    scene: Scene


def random_image(seed: int) -> RandomImage:
    """Image of a seed: what it shows may have nothing in common with what is declared."""
    rng = np.random.default_rng([20261128, seed])
    lens = LENSES[seed % len(LENSES)]
    middle = np.array([getattr(lens, "cx_px", 1024.0), getattr(lens, "cy_px", 768.0)])
    corner = middle - SIZE / 2 + rng.uniform(-1.0, 1.0, 2) * rng.choice([0.0, 200.0])
    model = divisible(lens).windowed(*corner.tolist())
    uncertainty = _uncertainty(model, rng) if rng.random() < 0.5 else None
    camera = Camera(
        name="random",
        columns=SIZE,
        rows=SIZE,
        model=model,
        psf=GaussianPsf(sigma_px=float(rng.uniform(0.4, 2.0))) if rng.random() < 0.8 else None,
        detector=Detector(gain_e_per_dn=2.0, read_noise_e=6.0, saturation_dn=4000.0, bias_dn=100.0),
        uncertainty=uncertainty,
    )
    center_px = rng.uniform(-10.0, SIZE + 10.0, 2) if rng.random() < 0.3 else rng.uniform(35.0, 60.0, 2)
    radius_px = float(np.exp(rng.uniform(np.log(0.5), np.log(70.0))))
    sight = model.unproject(center_px)
    if not np.isfinite(sight).all():
        sight = model.unproject(np.full(2, SIZE / 2))
    turn, sun = Rotation.from_quat(rng.normal(size=4)), _unit(rng.normal(size=3))
    if rng.random() < 0.6:
        sun = _unit(sun - 2.0 * max(float(sun @ sight), 0.0) * sight)  # the lit side is seen
    position = sight * model.focal_length_px / radius_px
    ellipsoid = Ellipsoid(radii_km=rng.uniform(0.6, 1.0, 3) if rng.random() < 0.8 else np.ones(3))
    shape: Shape = mesh_from_ellipsoid(ellipsoid, facets=300) if rng.random() < 0.4 else ellipsoid
    law = (Lambert(), LommelSeeliger(), McEwen())[int(rng.integers(3))]
    body = Body(shape=shape, camera_from_body=turn, position_camera_km=position, reflectance=law)
    pixels, mask = _pixels(body, camera, sun, rng)
    target = Target(
        name="BODY",
        shape=shape,
        ephemeris=ApparentGeometry(
            position_inertial_km=position * float(np.exp(rng.normal(0.0, 0.05))), inertial_from_body=turn,
            sun_direction_inertial=sun if rng.random() < 0.8 else _unit(rng.normal(size=3)),
        ),
        reflectance=law,
        uncertainty=TargetUncertainty(
            scale=float(rng.choice([0.0, 1e-12, 0.01, 0.1])),
            pole_rad=float(rng.choice([0.0, 1e-12, 0.01, 0.1])),
            spin_rad=float(rng.choice([0.0, 1e-12, 0.01, 0.1])),
            ephemeris_km=float(rng.choice([0.0, 1e-9, 5.0])),
        ),
    )  # fmt: skip
    sigma = float(rng.choice([0.0, 1e-12, 1e-5, 0.1]))
    image = Image(
        pixels=pixels,
        mask=mask,
        camera_from_inertial=Rotation.identity(),
        attitude_covariance_rad2=np.diag([1.0, 1.0, float(rng.choice([1.0, 1e6]))]) * sigma**2,
        name=f"random-{seed}",
    )
    return RandomImage(image, camera, Scene(targets=(target,)))


def _uncertainty(model: CameraModel, rng: np.random.Generator) -> ModelUncertainty:
    count = int(rng.integers(1, len(model.parameter_names) + 1))
    names = tuple(model.parameter_names[:count])
    root = rng.normal(size=(count, int(rng.integers(1, count + 1)))) * np.exp(rng.uniform(-12.0, -2.0, (count, 1)))
    covariance = root @ root.T
    return ModelUncertainty(
        estimated=names, covariance=(covariance + covariance.T) / 2.0, residual_sigma_px=0.1, n_observations=100,
        n_images=3,
    )  # fmt: skip


def _unit(vector: Float) -> Float:
    return np.asarray(vector / np.linalg.norm(vector))


def _pixels(body: Body, camera: Camera, sun: Float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and mask: of the body, or of one of many other things."""
    pattern = PATTERNS[int(rng.integers(len(PATTERNS)))]
    light, mask = np.zeros((SIZE, SIZE)), np.zeros((SIZE, SIZE), dtype=bool)
    row, column = np.mgrid[:SIZE, :SIZE].astype(float)
    if pattern in ("body", "half", "masked", "inverted", "saturated"):
        made = render(
            body, camera.model, sun_direction_camera=sun, psf=camera.psf or GaussianPsf(), columns=SIZE, rows=SIZE,
            options=RenderOptions(rays_per_pixel_side=2),
        )  # fmt: skip
        if isinstance(made, Template):
            light = np.clip(made.placed(SIZE, SIZE), 0.0, None)
            light *= float(rng.choice([30.0, 3000.0])) / max(float(light.max()), 1e-9)
    elif pattern == "noise":
        light = rng.exponential(200.0, (SIZE, SIZE))
    elif pattern == "constant":
        light += float(rng.choice([0.0, 500.0, 1e5]))
    elif pattern == "stripes":
        light = 2000.0 * (column % int(rng.integers(2, 9)) == 0)
    elif pattern == "gradient":
        light = 10.0 * row + 5.0 * column
    elif pattern == "points":
        light[tuple(rng.integers(0, SIZE, (2, int(rng.integers(1, 40)))))] = 3000.0
    elif pattern == "another":
        place, width = rng.uniform(0.0, SIZE, 2), rng.uniform(1.0, 40.0)
        light = 2000.0 * (np.hypot(column - place[0], row - place[1]) < width)
    if pattern == "half":
        light[:, : SIZE // 2] = 0.0
    if pattern == "masked":
        mask = rng.random((SIZE, SIZE)) < rng.choice([0.02, 0.5, 0.98])
    if pattern == "inverted":
        light = light.max() - light
    if pattern == "saturated":
        light = light * 100.0
    noisy = light + 100.0 if rng.random() < 0.15 else rng.poisson(light) + rng.normal(100.0, 3.0, light.shape)
    return np.clip(np.rint(noisy), 0.0, 4000.0).astype(np.uint16), mask


def broken_down(seed: int, names: tuple[str, ...] = tuple(ESTIMATORS)) -> list[str]:
    """What broke down on the image of a seed: estimators with an exception or an internal error."""
    case, broken = random_image(seed), list[str]()
    for name in names:
        try:
            outcome = ESTIMATORS[name]().estimate(case.image, case.camera, case.scene)
        except Exception as error:  # noqa: BLE001  every exception is what is looked for
            broken.append(f"{seed} {name}: raised {type(error).__name__}: {error}")
            continue
        if isinstance(outcome, Failure) and outcome.reason is Reason.INTERNAL_ERROR:
            broken.append(f"{seed} {name}: {outcome.detail}")
        elif isinstance(outcome, CenterFix) and not np.isfinite(outcome.center_px).all():
            broken.append(f"{seed} {name}: center {outcome.center_px}")
    return broken


def main(first: int, count: int) -> None:
    """Run all estimators on many images and print what broke down."""
    warnings.simplefilter("error")
    began, found = time.process_time(), Counter[str]()
    for seed in range(first, first + count):
        if seed % 10 == 0:
            print(f"at {seed}", flush=True)
        for text in broken_down(seed):
            found[text.split(": ", 1)[1][:90]] += 1
            print(text, flush=True)
    print(f"{count} images, {time.process_time() - began:.0f} s of CPU time, {found.total()} broke down: {dict(found)}")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
