"""Images with truth for the benchmark of templates: rendered with other rays than any template, noise, a priori errors.

Not a benchmark itself: ``estimators_template.py`` runs it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import convolve1d
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.frames import rotate
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.ray_tracing import Body, Lambert, McEwen, Reflectance, RenderOptions, Template, render
from giantlike.relative.template.rendering import KNOWN_BLUR_SIGMA_PX2
from giantlike.scene import Scene, Target
from giantlike.shapes import Shape, TriangleMesh, irregular_body

PSF_PX = 0.7
CAMERA = Camera(
    name="NavCam",
    columns=1024,
    rows=1024,
    model=BrownModel(fx_px=5500.3, fy_px=5500.4, cx_px=513.0, cy_px=509.0, k1=-0.54, k2=0.39, p1=-2.5e-4),
    psf=GaussianPsf(sigma_px=PSF_PX),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0, saturation_dn=4095.0),
)
ATTITUDE = Rotation.from_rotvec([0.3, -1.0, 0.4])
PEAK_DN, ERROR_PX = 3000.0, 10.0
BODIES = [irregular_body(seed, facets=50_000) for seed in (1, 2, 3)]
RELIEF_WAVENUMBERS = (6.0, 12.0, 24.0)
MCEWEN = McEwen()
_RAYS, _ROUGH_RAYS = 6, 3  # along the side of a pixel; where the shape is wrong by pixels, few do
_BOUND_MARGIN_PX = 6
_SMALL_PX = 24.0  # below, derivatives of the bound are differences of renders
_SLOPE = np.array([-1 / 60, 3 / 20, -3 / 4, 0.0, 3 / 4, -3 / 20, 1 / 60])


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """What the camera looks at, and the light of it on the pixels, DN, with its first pixel (x, y)."""

    number: int
    diameter_px: float
    phase_deg: float
    shape: Shape
    body: Body
    sun: Float
    center_px: Float
    range_km: float
    light_dn: Float
    corner_px: tuple[int, int]

    @property
    def dn_per_brightness(self) -> float:
        """Signal of a surface of relative brightness 1."""
        return PEAK_DN / float(rendered(self.body, self.sun, RenderOptions(rays_per_pixel_side=2)).brightness.max())


@dataclass(frozen=True, kw_only=True, eq=False)
class Draw:
    """One image and what is believed beforehand."""

    truth: Truth
    image: Image
    scene: Scene
    predicted_px: Float
    predicted: Body


def truth_of(
    number: int,
    diameter_px: float,
    phase_deg: float,
    *,
    law: Reflectance = MCEWEN,
    relief: float = 0.0,
    shape: Shape | None = None,
) -> Truth:
    """The truth of a number: another body, pose, place and azimuth of the Sun for each.

    ``relief`` is the standard deviation, over the mean radius, of what the truth has and the estimator's shape has not.
    """
    random = np.random.default_rng([number, 77])
    told, pose = shape or BODIES[number % len(BODIES)], Rotation.random(random_state=number)
    seen = told
    if relief > 0.0:
        assert isinstance(told, TriangleMesh)
        seen = with_relief(told, relief, random)
    center = np.array([512.0, 510.0]) + random.uniform(0, 1, 2)
    sight = CAMERA.model.unproject(center)
    range_km = 2 * told.mean_radius_km * CAMERA.model.focal_length_px / diameter_px
    side = unit(np.cross(sight, [*random.normal(size=2), 0.0]))
    phase = math.radians(phase_deg)
    sun = -math.cos(phase) * sight + math.sin(phase) * side
    body = Body(shape=seen, camera_from_body=pose, position_camera_km=range_km * sight, reflectance=law)
    template = rendered(
        body,
        sun,
        RenderOptions(
            rays_per_pixel_side=_ROUGH_RAYS if relief > 0.0 else _RAYS, min_rays_across=300, jitter_seed=number
        ),
    )
    return Truth(
        number=number,
        diameter_px=diameter_px,
        phase_deg=phase_deg,
        shape=told,
        body=body,
        sun=sun,
        center_px=center,
        range_km=range_km,
        light_dn=template.brightness * (PEAK_DN / float(template.brightness.max())),
        corner_px=(int(template.corner_px[0]), int(template.corner_px[1])),
    )


def draw_of(truth: Truth, seed: int, *, range_error: float, range_sigma: float = 0.0, law: Reflectance) -> Draw:
    """An image of a truth, told ``law``: 10 px off somewhere, the range off by a factor 1 + ``range_error``.

    With ``range_sigma`` it is off by a normal deviate of it in its logarithm too.
    """
    random = np.random.default_rng([truth.number, seed])
    signal = np.zeros((CAMERA.rows, CAMERA.columns))
    (x, y), (height, width) = truth.corner_px, truth.light_dn.shape
    signal[y : y + height, x : x + width] = truth.light_dn
    pixels = random.poisson(signal) + CAMERA.detector.read_noise_e * random.standard_normal(signal.shape)
    angle = random.uniform(0, 2 * np.pi)
    predicted_px = truth.center_px + ERROR_PX * np.array([math.cos(angle), math.sin(angle)])
    factor = (1.0 + range_error) * math.exp(range_sigma * random.standard_normal())
    position = truth.range_km * factor * CAMERA.model.unproject(predicted_px)
    back = ATTITUDE.inv()
    geometry = ApparentGeometry(
        position_inertial_km=rotate(back, position),
        inertial_from_body=back * truth.body.camera_from_body,
        sun_direction_inertial=rotate(back, truth.sun),
    )
    target = Target(name="ROCK", shape=truth.shape, ephemeris=geometry, reflectance=law)
    return Draw(
        truth=truth,
        image=Image(
            pixels=np.rint(pixels).astype(np.int16), camera_from_inertial=ATTITUDE, name=f"{truth.number}/{seed}"
        ),
        scene=Scene(targets=(target,)),
        predicted_px=predicted_px,
        predicted=replace(truth.body, shape=truth.shape, position_camera_km=position, reflectance=law),
    )


def with_relief(
    shape: TriangleMesh, rms: float, random: np.random.Generator, wavenumbers: Sequence[float] = RELIEF_WAVENUMBERS
) -> TriangleMesh:
    """A shape with correlated relief on it, along its radii; ``rms`` over the mean radius.

    Plane waves of some wavenumbers (per radius; they are correlated over 1 / wavenumber radians), with equal slopes,
    so that long waves are highest. What moves or scales the body is taken out: it would be another center or range.
    """
    length = np.linalg.norm(shape.vertices_km, axis=1)
    points = shape.vertices_km / length[:, None]
    field = np.zeros(len(points))
    for wavenumber in wavenumbers:
        for vector, start in zip(unit(random.normal(size=(48, 3))), random.uniform(0, 2 * np.pi, 48), strict=True):
            field += np.cos(wavenumber * points @ vector + start) / wavenumber
    rigid = np.column_stack([np.ones(len(points)), points])
    field -= rigid @ np.linalg.lstsq(rigid, field, rcond=None)[0]
    field *= rms * shape.mean_radius_km / float(field.std())
    return TriangleMesh(points * (length + field)[:, None], shape.faces, f"{shape.name} with relief")


def rendered(body: Body, sun: Float, options: RenderOptions, *, psf_variance_px2: float = PSF_PX**2) -> Template:
    """A template in the benchmark's camera."""
    template = render(
        body,
        CAMERA.model,
        sun_direction_camera=sun,
        psf=GaussianPsf(sigma_px=math.sqrt(psf_variance_px2)),
        columns=CAMERA.columns,
        rows=CAMERA.rows,
        options=options,
    )
    assert isinstance(template, Template), template
    return template


def bounds(truth: Truth, *, range_sigma: float = math.inf) -> Float:
    """Cramer-Rao bounds (2, 2) of the noise: of the center, rms per axis, px, and of the logarithm of the range.

    First row: with brightness, background and range unknown; second row: with blur and law as free as the fit has them.
    """
    light, columns = _columns(truth)
    design = np.stack([column.ravel() for column in columns], axis=1)
    information = (design / CAMERA.detector.variance_dn2(light.ravel())[:, None]).T @ design
    known = np.diag([0.0, 0.0, range_sigma**-2, 0.0, 0.0, KNOWN_BLUR_SIGMA_PX2**-2, 1.0])
    inverses = np.linalg.inv((information + known)[:5, :5]), np.linalg.inv(information + known)
    return np.array([(math.sqrt((one[0, 0] + one[1, 1]) / 2), math.sqrt(one[2, 2])) for one in inverses])


def _columns(truth: Truth) -> tuple[Float, list[Float]]:
    """Light and its derivatives by x, y, log range, brightness, background, blur and share of another law, in a box."""
    options = RenderOptions(min_rays_across=200)
    (left, top), (height, width) = truth.corner_px, truth.light_dn.shape
    margin = _BOUND_MARGIN_PX

    def boxed(template: Template) -> Float:
        frame = np.zeros((height + 2 * margin, width + 2 * margin))
        x, y = template.corner_px - (left - margin, top - margin)
        rows, columns = template.brightness.shape
        y0, x0, y1, x1 = max(y, 0), max(x, 0), min(y + rows, frame.shape[0]), min(x + columns, frame.shape[1])
        frame[y0:y1, x0:x1] = template.brightness[y0 - y : y1 - y, x0 - x : x1 - x]
        return frame * scale

    def light(off: Sequence[float] = (0.0, 0.0), log_range: float = 0.0, blur: float = 0.0) -> Float:
        position = truth.range_km * math.exp(log_range) * CAMERA.model.unproject(np.add(truth.center_px, off))
        body = replace(truth.body, position_camera_km=position)
        return boxed(rendered(body, truth.sun, options, psf_variance_px2=PSF_PX**2 + blur))

    scale = 1.0
    scale = PEAK_DN / float(light().max())
    here = light()
    lambert = boxed(rendered(replace(truth.body, reflectance=Lambert()), truth.sun, options))
    if truth.diameter_px < _SMALL_PX:
        moved = [
            (light((0.1, 0.0)) - light((-0.1, 0.0))) / 0.2,
            (light((0.0, 0.1)) - light((0.0, -0.1))) / 0.2,
            (light(log_range=0.03) - light(log_range=-0.03)) / 0.06,
        ]
    else:
        slope_x, slope_y = convolve1d(here, -_SLOPE, axis=1), convolve1d(here, -_SLOPE, axis=0)
        rows, columns = np.indices(here.shape)
        x, y = columns + left - margin - truth.center_px[0], rows + top - margin - truth.center_px[1]
        moved = [-slope_x, -slope_y, x * slope_x + y * slope_y]
    blurred = (light(blur=0.1) - light(blur=-0.1)) / 0.2
    other = lambert * here.sum() / lambert.sum() - here
    return here, [*moved, here, np.ones_like(here), blurred, other]
