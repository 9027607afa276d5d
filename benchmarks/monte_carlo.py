"""Monte Carlo trials of estimators that give a position: truth, draws, what the noise allows, and a summary.

A truth is a body rendered once: an ellipsoid by ``giantlike.independent``, which shares no code with the estimators, a
mesh with far more rays than any template has, at random places of their cells. Draws of it have their own noise and
their own error of the prediction. Beside the errors stands the Cramer-Rao bound of the noise.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.frames import rotate
from giantlike.core.outcomes import PositionFix
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.independent import EllipsoidBody, PinholeView, Pose, Psf, render_body
from giantlike.ray_tracing import (
    Body,
    Lambert,
    LommelSeeliger,
    McEwen,
    Reflectance,
    RenderOptions,
    Template,
    render,
    trace_silhouette,
)
from giantlike.relative import Estimator
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid, Shape

PSF_PX, PEAK_DN, READ_NOISE_DN = 0.7, 3000.0, 5.0
ERROR_PX, RANGE_ERROR = 10.0, 0.015
PHASES_DEG = (20.0, 40.0, 60.0, 80.0, 100.0, 120.0)
ATTITUDE = Rotation.from_rotvec([0.3, -1.0, 0.4])
_TRUTH_RAYS, _TRUTH_RAYS_ACROSS, _MAX_TRUTH_RAYS = 8, 1000, 24
_INDEPENDENT_LAWS = {Lambert: "lambert", LommelSeeliger: "lommel_seeliger", McEwen: "mcewen"}
_LIMB_PX = 3.0  # from the outline: what an estimator on limbs sees
_DERIVATIVE = np.array([-1 / 60, 3 / 20, -3 / 4, 0.0, 3 / 4, -3 / 20, 1 / 60])
_ONE = np.array([1.0])
_BOUNDS = (("image", False), ("limb", True))
_NO_IMAGE = Image(pixels=np.zeros((1, 1), np.int16))


def camera(size_px: int = 1024) -> Camera:
    """A narrow-angle camera with the distortion of a real one."""
    middle = 0.5 * (size_px - 1)
    return Camera(
        name=f"NavCam {size_px}",
        columns=size_px,
        rows=size_px,
        model=BrownModel(
            fx_px=3473.3, fy_px=3473.3, cx_px=middle + 1.5, cy_px=middle - 2.5, k1=-0.54, k2=0.39, p1=-2.5e-4
        ),
        psf=GaussianPsf(sigma_px=PSF_PX),
        detector=Detector(gain_e_per_dn=1.0, read_noise_e=READ_NOISE_DN, saturation_dn=16000.0),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """A body before a camera, and its light without noise, DN."""

    body: Body
    sun: Float
    camera: Camera
    light_dn: Float
    phase_deg: float
    seed: int

    @property
    def center_px(self) -> Float:
        """Where the center of the body is (2,)."""
        return self.body.center_px(self.camera.model)

    @property
    def range_km(self) -> float:
        """From the camera to the center of the body."""
        return float(np.linalg.norm(self.body.position_camera_km))


@dataclass(frozen=True, kw_only=True, eq=False)
class Draw:
    """An image of a truth, and the scene as it was predicted."""

    truth: Truth
    image: Image
    scene: Scene


def truth_of(
    shape: Shape,
    diameter_px: float,
    phase_deg: float,
    law: Reflectance,
    seed: int,
    *,
    size_px: int = 1024,
    peak_dn: float = PEAK_DN,
) -> Truth:
    """A body of some mean diameter in the middle of a frame, with an attitude and a Sun by chance."""
    random = np.random.default_rng(seed)
    instrument = camera(size_px)
    center = 0.5 * size_px + random.uniform(-1.0, 1.0, 2)
    sight = instrument.model.unproject(center)
    range_km = 2.0 * shape.mean_radius_km * instrument.model.focal_length_px / diameter_px
    side = unit(np.cross(sight, [*random.normal(size=2), 0.0]))
    phase = math.radians(phase_deg)
    sun = -math.cos(phase) * sight + math.sin(phase) * side
    body = Body(
        shape=shape,
        camera_from_body=Rotation.random(random_state=seed),
        position_camera_km=range_km * sight,
        reflectance=law,
    )
    return Truth(
        body=body,
        sun=sun,
        camera=instrument,
        light_dn=_light(body, sun, instrument, seed, peak_dn),
        phase_deg=phase_deg,
        seed=seed,
    )


def _light(body: Body, sun: Float, camera: Camera, seed: int, peak_dn: float) -> Float:
    """Light of a body, DN: of an ellipsoid by the independent renderer, of a mesh by templates with far more rays."""
    law = _INDEPENDENT_LAWS.get(type(body.reflectance))
    if isinstance(body.shape, Ellipsoid) and law is not None:
        lens = camera.model
        assert isinstance(lens, BrownModel)
        view = PinholeView(
            lens.fx_px,
            (lens.cx_px, lens.cy_px),
            camera.columns,
            camera.rows,
            k1=lens.k1,
            k2=lens.k2,
            p1=lens.p1,
            p2=lens.p2,
        )
        pose = Pose(body.position_camera_km, body.camera_from_body, sun)
        return render_body(EllipsoidBody(body.shape.radii_km), view, pose, law=law, peak_dn=peak_dn, psf=Psf(PSF_PX))
    diameter_px = 2.0 * body.shape.mean_radius_km / float(np.linalg.norm(body.position_camera_km))
    diameter_px *= camera.model.focal_length_px
    rays = int(np.clip(math.ceil(_TRUTH_RAYS_ACROSS / diameter_px), _TRUTH_RAYS, _MAX_TRUTH_RAYS))
    template = render(
        body,
        camera.model,
        sun_direction_camera=sun,
        psf=camera.psf,
        columns=camera.columns,
        rows=camera.rows,
        options=RenderOptions(rays_per_pixel_side=rays, jitter_seed=seed),
    )
    assert isinstance(template, Template), template
    return template.placed(camera.rows, camera.columns) * (peak_dn / float(template.brightness.max()))


def draws_of(truth: Truth, count: int, *, told: Reflectance | None = None) -> Iterator[Draw]:
    """Images with noise; predictions 10 px off in any direction and 1.5 % of range too near or too far."""
    back, target = ATTITUDE.inv(), truth.body
    for number in range(count):
        random = np.random.default_rng([truth.seed, number])
        signal = random.poisson(truth.light_dn) + random.normal(0.0, READ_NOISE_DN, truth.light_dn.shape)
        angle = random.uniform(0.0, 2.0 * np.pi)
        predicted = truth.center_px + ERROR_PX * np.array([math.cos(angle), math.sin(angle)])
        factor = 1.0 + RANGE_ERROR * random.choice([-1.0, 1.0])
        geometry = ApparentGeometry(
            position_inertial_km=rotate(back, truth.range_km * factor * truth.camera.model.unproject(predicted)),
            inertial_from_body=back * target.camera_from_body,
            sun_direction_inertial=rotate(back, truth.sun),
        )
        known = Target(name="BODY", shape=target.shape, ephemeris=geometry, reflectance=told or target.reflectance)
        yield Draw(
            truth=truth,
            image=Image(
                pixels=np.rint(signal).astype(np.int16),
                camera_from_inertial=ATTITUDE,
                name=f"truth {truth.seed} draw {number}",
            ),
            scene=Scene(targets=(known,)),
        )


def bound_of(truth: Truth, *, limb_only: bool) -> Float:
    """Cramer-Rao bound of the position: variances (3,) of x and y, px^2, and of the logarithm of the range.

    Brightness and background are freed, everything else is known. ``limb_only`` takes the pixels within 3 px of the
    outline, on both sides: without the relief in the middle of the disk.
    """
    light = truth.light_dn
    by_x, by_y = (cv2.sepFilter2D(light, -1, *taps) for taps in ((_DERIVATIVE, _ONE), (_ONE, _DERIVATIVE)))
    y, x = np.indices(light.shape, dtype=np.float64)
    grown = (x - truth.center_px[0]) * by_x + (y - truth.center_px[1]) * by_y
    used = light > 0.0
    if limb_only:
        used &= _near_outline(truth)
    design = np.stack([image[used] for image in (-by_x, -by_y, grown, light, np.ones_like(light))], axis=1)
    weights = 1.0 / truth.camera.detector.variance_dn2(light[used])
    scale = np.sqrt(np.einsum("nk,n->k", design**2, weights))
    information = (design / scale * weights[:, None]).T @ (design / scale)
    result: Float = np.diag(np.linalg.inv(information))[:3] / scale[:3] ** 2
    return result


def _near_outline(truth: Truth) -> NDArray[np.bool_]:
    angles = np.linspace(0.0, 2.0 * np.pi, 4000, endpoint=False)
    outline = trace_silhouette(truth.body, truth.camera.model, angles, sun_direction_camera=truth.sun).points_px
    canvas = np.full(truth.light_dn.shape, 255, np.uint8)
    cv2.polylines(canvas, [np.rint(8.0 * outline).astype(np.int32)], True, 0, shift=3)
    near: NDArray[np.bool_] = cv2.distanceTransform(canvas, cv2.DIST_L2, 5) <= _LIMB_PX
    return near


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """What came of one draw."""

    draw: Draw
    answer: object
    cpu_s: float
    wall_s: float


def trials(
    estimator: Estimator, truths: Sequence[Truth], count: int, *, told: Reflectance | None = None
) -> list[Trial]:
    """Run an estimator on ``count`` draws of every truth; images are made and forgotten one by one."""
    result = []
    for truth in truths:
        for draw in draws_of(truth, count, told=told):
            cpu, wall = time.process_time(), time.perf_counter()
            answer = estimator.estimate(draw.image, truth.camera, draw.scene)
            spent = time.process_time() - cpu, time.perf_counter() - wall
            result.append(Trial(draw=replace(draw, image=_NO_IMAGE), answer=answer, cpu_s=spent[0], wall_s=spent[1]))
    return result


def summary(done: Sequence[Trial], truths: Sequence[Truth]) -> dict[str, object]:
    """Errors beside bounds, and squared errors over covariances beside the band in which 95 % of their means lie."""
    good = [(trial.draw.truth, trial.answer) for trial in done if isinstance(trial.answer, PositionFix)]
    failed = [str(trial.answer) for trial in done if not isinstance(trial.answer, PositionFix)]
    report: dict[str, object] = {"draws": len(done), "truths": len(truths), "failed": failed}
    if not good:
        return report
    errors = np.array(
        [(*(fix.center_px - truth.center_px), fix.range_km / truth.range_km - 1.0) for truth, fix in good]
    )
    nees = np.array([_nees(truth, fix) for truth, fix in good])
    flat = [float(chi2.ppf(chance, 3 * nees.size)) / nees.size for chance in (0.025, 0.975)]
    owner = np.array([truth.seed for truth, _ in good])
    means = np.array([nees[owner == seed].mean() for seed in np.unique(owner)])
    bounds = {name: _rms([bound_of(truth, limb_only=limb) for truth in truths]) for name, limb in _BOUNDS}
    stated = _rms([(*np.diag(fix.covariance_px2), (fix.sigma_range_km / fix.range_km) ** 2) for _, fix in good])
    return report | {
        "rms_px": _rounded(np.sqrt(np.mean(errors[:, :2] ** 2, axis=0))),
        "rms_range": _rounded(np.sqrt(np.mean(errors[:, 2] ** 2))),
        "mean_px_of_truths": _rounded(
            np.sqrt(np.mean([errors[owner == s, :2].mean(axis=0) ** 2 for s in np.unique(owner)]))
        ),
        "worst_px": _rounded(np.abs(errors[:, :2]).max()),
        "worst_range": _rounded(np.abs(errors[:, 2]).max()),
        "stated_px": _rounded(math.hypot(*stated[:2]) / math.sqrt(2.0)),
        "stated_range": _rounded(stated[2]),
        **{f"bound_px_{name}": _rounded(math.hypot(*b[:2]) / math.sqrt(2.0)) for name, b in bounds.items()},
        **{f"bound_range_{name}": _rounded(b[2]) for name, b in bounds.items()},
        "nees_of_3": _rounded(nees.mean()),
        "nees_band_95": _rounded(flat),
        "nees_standard_error_by_truth": _rounded(means.std() / math.sqrt(means.size)),
        "worst_nees": _rounded(nees.max()),
        "median_cpu_s": _rounded(np.median([trial.cpu_s for trial in done])),
        "median_wall_s": _rounded(np.median([trial.wall_s for trial in done])),
    }


def render_cost_s(truth: Truth, *, repeats: int = 5) -> float:
    """Processor time, s, of one bare template of 4 rays a pixel with shadows: what times are compared with."""
    spent = []
    for _ in range(repeats + 1):
        before = time.process_time()
        render(
            truth.body,
            truth.camera.model,
            sun_direction_camera=truth.sun,
            psf=truth.camera.psf,
            columns=truth.camera.columns,
            rows=truth.camera.rows,
        )
        spent.append(time.process_time() - before)
    return float(f"{np.median(spent[1:]):.3g}")


def run_cell(name: str, values: dict[str, object], report: dict[str, object]) -> None:
    """Put values into the report under ``name``, and print them at once."""
    report[name] = values
    print(json.dumps({name: values}), file=sys.stderr, flush=True)


def _nees(truth: Truth, fix: PositionFix) -> float:
    error = fix.position_camera_km - truth.body.position_camera_km
    return float(error @ np.linalg.solve(fix.covariance_camera_km2, error))


def _rms(variances: Sequence[Float | tuple[float, ...]]) -> Float:
    result: Float = np.sqrt(np.mean(np.asarray(variances), axis=0))
    return result


def _rounded(value: object) -> object:
    numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
    short = [float(f"{number:.3g}") for number in numbers]
    return short if np.ndim(np.asarray(value)) else short[0]
