"""Effect of an error of the predicted range on template matching: the study that the paper calls its reference 22.

The paper says that correlation "can begin to become biased" by an error of range or size and that there is another way.
Its study lies elsewhere, with poorly detailed bodies. Here a body of the independent renderer, with relief that its
shape model does not have, is searched at wrong ranges: by the peak of the correlation with one template, and by the
template that is fitted in range too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import Failure, PositionFix
from giantlike.core.values import Value
from giantlike.ephemeris import ApparentGeometry
from giantlike.gauntlet.bodies import relief, rock
from giantlike.image import Image
from giantlike.independent import PinholeView, Pose, Psf, record, render_body
from giantlike.independent.record import Recorder
from giantlike.missions.replay import ReplaySettings
from giantlike.processing.correlate import CorrelationOptions, locate_template
from giantlike.ray_tracing import RenderOptions, Template, render
from giantlike.relative import CrossCorrelation
from giantlike.relative.template.cross_correlation import CrossCorrelationOptions
from giantlike.scene import Scene, Target, TargetGeometry

_SIDE_PX, _FOCAL_PX = 400, 14737.0  # size of the images, and the focal length of MapCam
_DIAMETER_PX = 200.0
"""Apparent diameter: the maximum for template matching in the paper's Approach and Preliminary Survey."""
_CENTER_ERROR_PX = np.array([6.3, -4.7])
"""Error of the predicted center [assumed]; the search has to find it at every range."""
_UNLISTED_RELIEF = 0.01
"""Rms of the relief that the shape model lacks, as a fraction of the radius: a poorly detailed object [assumed]."""
_RANGE_ERRORS = (-0.08, -0.06, -0.04, -0.02, 0.0, 0.02, 0.04, 0.06, 0.08)
_SMALL_RANGE_ERRORS = (-0.04, 0.0, 0.04)
_PHASES_DEG = (20.0, 60.0, 90.0)
_PSF_PX, _READ_NOISE_E, _GAIN, _PEAK_DN = 0.8, 14.0, 4.0, 2500.0  # optics and detector as in ``mission.toml``
_RAYS = 4  # rays along a pixel's side of the template


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeErrorStudy(Value):
    """Errors of the center against the error of the predicted range.

    correlation_px, fitted_px: (p, n, 2); measured minus true center: by the peak of the correlation, and with the range
        fitted; NaN where none was found.
    """

    range_errors: Float  # (n,); predicted / true range - 1
    phases_deg: Float  # (p,)
    correlation_px: Float
    fitted_px: Float


def study_range_errors(settings: ReplaySettings) -> RangeErrorStudy:
    """Match templates of a body at wrong ranges."""
    errors: tuple[float, ...] = _SMALL_RANGE_ERRORS if settings.small else _RANGE_ERRORS
    phases = _PHASES_DEG[1:2] if settings.small else _PHASES_DEG
    if settings.change == "range_known":
        errors = tuple(0.05 * error for error in errors)
    rows = []
    for number, phase_deg in enumerate(phases):
        case = _Case.from_phase(phase_deg, settings.seed)
        rows.append([case.find_errors(error) for error in errors])
        settings.progress("errors of the range", number + 1, len(phases))
    table = np.array(rows)
    return RangeErrorStudy(
        range_errors=np.array(errors),
        phases_deg=np.array(phases),
        correlation_px=table[:, :, :2],
        fitted_px=table[:, :, 2:],
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Case(Value):
    """An image at one phase angle, with its truth and its declared values."""

    image: Image
    camera: Camera
    target: Target
    position_km: Float
    camera_from_body: Rotation
    sun: Float

    @classmethod
    def from_phase(cls, phase_deg: float, seed: int) -> _Case:
        view = PinholeView(
            focal_px=_FOCAL_PX, center_px=((_SIDE_PX - 1) / 2, (_SIDE_PX - 1) / 2), columns=_SIDE_PX, rows=_SIDE_PX
        )
        body, mesh = rock(0, relief(1, _UNLISTED_RELIEF))
        range_km = 2.0 * mesh.mean_radius_km * _FOCAL_PX / _DIAMETER_PX
        rng = np.random.default_rng([seed, 30, round(phase_deg)])
        turn, angle = Rotation.random(random_state=rng), rng.uniform(0.0, 2.0 * np.pi)
        position = range_km * np.array([*(rng.uniform(-10.0, 10.0, 2) / _FOCAL_PX), 1.0])
        phase = np.radians(phase_deg)
        sun = np.array([np.sin(phase) * np.cos(angle), np.sin(phase) * np.sin(angle), -np.cos(phase)])
        signal = render_body(
            body, view, Pose(position, turn, sun), law="hapke", peak_dn=_PEAK_DN, psf=Psf(sigma_px=_PSF_PX)
        )
        pixels = record(signal, rng, Recorder(gain_e_per_dn=_GAIN, read_noise_e=_READ_NOISE_E)).pixels
        camera = Camera(
            name="study",
            columns=_SIDE_PX,
            rows=_SIDE_PX,
            model=PinholeModel(fx_px=_FOCAL_PX, fy_px=_FOCAL_PX, cx_px=view.center_px[0], cy_px=view.center_px[1]),
            psf=GaussianPsf(sigma_px=_PSF_PX),
            detector=Detector(gain_e_per_dn=_GAIN, read_noise_e=_READ_NOISE_E),
        )
        still = ApparentGeometry(position_inertial_km=position, inertial_from_body=turn, sun_direction_inertial=sun)
        return cls(
            image=Image(pixels=pixels.astype(np.float32), camera_from_inertial=Rotation.identity(), name="study"),
            camera=camera,
            target=Target(name="ROCK", shape=mesh, ephemeris=still),
            position_km=position,
            camera_from_body=turn,
            sun=sun,
        )

    def find_errors(self, range_error: float) -> Float:
        """Errors (4,) of the center: by the correlation, and with the range fitted."""
        true_px = self.camera.model.project(self.position_km)
        range_km = float(np.linalg.norm(self.position_km)) * (1.0 + range_error)
        predicted_km = range_km * self.camera.model.unproject(true_px + _CENTER_ERROR_PX)
        return np.concatenate([self._correlate(predicted_km) - true_px, self._fit(predicted_km, true_px)])

    def _correlate(self, predicted_km: Float) -> Float:
        """Center (2,) by the peak of the normalized correlation with a template at the predicted range."""
        geometry = TargetGeometry(
            target=self.target,
            position_camera_km=predicted_km,
            camera_from_body=self.camera_from_body,
            sun_direction_camera=self.sun,
        )
        template = render(
            geometry.body(),
            self.camera.model,
            sun_direction_camera=self.sun,
            psf=self.camera.psf,
            columns=_SIDE_PX,
            rows=_SIDE_PX,
            options=RenderOptions(rays_per_pixel_side=_RAYS),
        )
        if not isinstance(template, Template):
            return np.full(2, np.nan)
        pixels = self.image.pixels.astype(np.float64)
        peak = locate_template(
            pixels, np.ones(pixels.shape, bool), template.brightness, _corner(template), options=CorrelationOptions()
        )
        return np.full(2, np.nan) if isinstance(peak, Failure) else template.center_px + peak.offset_px

    def _fit(self, predicted_km: Float, true_px: Float) -> Float:
        """Error (2,) of the center of the estimator that fits the template's range."""
        ephemeris = self.target.ephemeris
        assert isinstance(ephemeris, ApparentGeometry)
        scene = Scene(targets=(replace(self.target, ephemeris=replace(ephemeris, position_inertial_km=predicted_km)),))
        estimator = CrossCorrelation(CrossCorrelationOptions(search_range=2.0 * max(_RANGE_ERRORS)))
        fix = estimator.estimate(self.image, self.camera, scene)
        if not isinstance(fix, PositionFix):
            return np.full(2, np.nan)
        return fix.center_px - true_px


def _corner(template: Template) -> tuple[int, int]:
    """Column and row of the first pixel of a template."""
    column, row = template.corner_px.tolist()
    return column, row
