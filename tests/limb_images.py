"""Images of bodies with truth, for the tests of estimators that work on limbs: other rays than any template has."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, f

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, CameraModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import PositionFix
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.processing.correlated_fit import solution_gain
from giantlike.ray_tracing import Body, McEwen, Reflectance, RenderOptions, Template, render
from giantlike.relative.horizon.geometry import CraMethod, Figure, cone_weights, horizon_residuals
from giantlike.scene import Scene, Target
from giantlike.shapes import Shape
from tests.tolerances import RARE

FOCAL_PX = 2500.0
CAMERA = Camera(
    name="test",
    columns=400,
    rows=400,
    model=BrownModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=199.5, cy_px=199.5, k1=-0.3),
    psf=GaussianPsf(sigma_px=0.75),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0, saturation_dn=4095.0, bias_dn=100.0),
)
PEAK_DN = 3000.0
INDEPENDENT = 30  # residuals along a limb that do not err together, about: covariances are estimated from those
NEES_LIMIT = 3.0 * float(f.ppf(1.0 - RARE, 3, INDEPENDENT))


def mean_nees_band(count: int) -> tuple[float, float]:
    """Where the mean of ``count`` squared errors of positions lies, but for one case in a million on either side.

    Half of the lower end of chi-square, because covariances are cautious: long waves along the limb cannot be excluded.
    """
    low, high = (float(chi2.ppf(chance, 3 * count)) / count for chance in (RARE, 1.0 - RARE))
    return 0.5 * low, high


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyImage:
    """An image, what was known before, and the truth."""

    image: Image
    camera: Camera
    target: Target
    position_camera_km: Float

    @property
    def scene(self) -> Scene:
        return Scene(targets=(self.target,))

    @property
    def center_px(self) -> Float:
        return self.camera.model.project(self.position_camera_km)

    def believed(self, *, off_px: tuple[float, float] = (0.0, 0.0), range_error: float = 0.0) -> BodyImage:
        """The same image with a prediction that is off by pixels and by a fraction of the range."""
        range_km = float(np.linalg.norm(self.position_camera_km))
        position = (self.position_camera_km + np.array([*off_px, 0.0]) * range_km / FOCAL_PX) * (1.0 + range_error)
        geometry = self.target.ephemeris
        assert isinstance(geometry, ApparentGeometry)
        return replace(self, target=replace(self.target, ephemeris=replace(geometry, position_inertial_km=position)))

    def error_px(self, fix: PositionFix) -> Float:
        return fix.center_px - self.center_px

    def range_error(self, fix: PositionFix) -> float:
        return fix.range_km / float(np.linalg.norm(self.position_camera_km)) - 1.0

    def nees(self, fix: PositionFix) -> float:
        """Squared error of the position in units of its covariance: chi-square of three when that is honest."""
        error = fix.position_camera_km - self.position_camera_km
        return float(error @ np.linalg.solve(fix.covariance_camera_km2, error))


def body_image(
    shape: Shape,
    seed: int,
    *,
    phase_deg: float,
    radius_px: float = 80.0,
    center_px: tuple[float, float] = (203.3, 196.8),
    law: Reflectance | None = None,
    peak_dn: float = PEAK_DN,
    camera: Camera = CAMERA,
    noise_seed: int | None = None,
) -> BodyImage:
    """Take an image of a body with random attitude and Sun azimuth; the prediction is the truth.

    Another ``noise_seed`` is another image of the same scene.
    """
    rng = np.random.default_rng(seed)
    camera_from_body = Rotation.from_quat(rng.normal(size=4))
    position = camera.model.unproject(np.array(center_px)) * shape.mean_radius_km * FOCAL_PX / radius_px
    phase, azimuth = np.radians(phase_deg), rng.uniform(0.0, 2.0 * np.pi)
    sun = np.array([np.sin(phase) * np.cos(azimuth), np.sin(phase) * np.sin(azimuth), -np.cos(phase)])
    reflectance = law or McEwen()
    body = Body(shape=shape, camera_from_body=camera_from_body, position_camera_km=position, reflectance=reflectance)
    template = render(
        body,
        camera.model,
        sun_direction_camera=sun,
        psf=camera.psf,
        columns=camera.columns,
        rows=camera.rows,
        options=RenderOptions(rays_per_pixel_side=5, jitter_seed=seed),
    )
    assert isinstance(template, Template)
    light = template.placed(camera.columns, camera.rows) * peak_dn / template.brightness.max()
    if noise_seed is not None:
        rng = np.random.default_rng([seed, noise_seed])
    noisy = rng.poisson(light) + rng.normal(0.0, 5.0, light.shape) + camera.detector.bias_dn
    pixels = np.clip(np.rint(noisy), 0.0, camera.detector.saturation_dn).astype(np.uint16)
    geometry = ApparentGeometry(
        position_inertial_km=position, inertial_from_body=camera_from_body, sun_direction_inertial=sun
    )
    return BodyImage(
        image=Image(pixels=pixels, camera_from_inertial=Rotation.identity(), name=f"seed-{seed}"),
        camera=camera,
        target=Target(name="BODY", shape=shape, ephemeris=geometry, reflectance=reflectance),
        position_camera_km=position,
    )


def assert_sound(case: BodyImage, fix: PositionFix, *, sigma_px: float, sigma_range: float) -> None:
    """The error is what the covariance allows, and the covariance has not grown to allow anything.

    ``sigma_px`` bounds the standard deviation of the center along its worst axis, ``sigma_range`` that of the range
    over the range. Stated sigmas vary by half from one noise to another, so these are three times the usual value.
    """
    stated_px = float(np.sqrt(np.linalg.eigvalsh(fix.covariance_px2)[-1]))
    stated_range = fix.sigma_range_km / fix.range_km
    assert case.nees(fix) < NEES_LIMIT, (case.image.name, case.error_px(fix), stated_px)
    assert stated_px < sigma_px, (case.image.name, stated_px)
    assert stated_range < sigma_range, (case.image.name, stated_range)


def horizon_covariance(
    points_px: Float,
    model: CameraModel,
    figure: Figure,
    position_km: Float,
    *,
    sigma_px: Float | float,
    method: CraMethod = CraMethod.MAXIMUM_LIKELIHOOD,
) -> Float:
    """Covariance of a position from horizon points with independent errors, as ``fit_horizon`` states it."""
    weights = None
    if method is not CraMethod.MAXIMUM_LIKELIHOOD:
        weights = cone_weights(points_px, model, figure, position_km)
    _, design, _ = horizon_residuals(points_px, model, figure, position_km)
    noise = np.diag(np.broadcast_to(sigma_px, len(points_px)) ** 2.0)
    gain = solution_gain(design, noise, weights=weights)
    return gain @ noise @ gain.T
