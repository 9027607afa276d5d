"""Fixes of images to be taken: images drawn from what is declared uncertain, given to the estimators themselves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float, require_number, unit
from giantlike.core.causes import IN_IMAGE, Cause, sum_parts
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX, GaussianPsf
from giantlike.core.frames import rotate
from giantlike.core.outcomes import CenterFix, Failure, PositionFix
from giantlike.core.values import Value
from giantlike.ephemeris import ApparentGeometry
from giantlike.image_model.field import AMPLITUDE_FACTOR, AMPLITUDES, LENGTHS, MEDIAN_AMPLITUDE, UNMARKED
from giantlike.planning.candidates import Candidate
from giantlike.ray_tracing import Lambert, LommelSeeliger, Reflectance, UserReflectance
from giantlike.relative import ESTIMATORS, Estimator
from giantlike.relative.light.law_mixture import LAW_SHARE_SIGMA
from giantlike.scene import Scene, Target, TargetGeometry
from giantlike.shapes import Ellipsoid, Point, TriangleMesh, VertexAlbedo, mesh_from_ellipsoid
from giantlike.shapes.detail import LevelsOfDetail
from giantlike.shapes.generate import surface_waves
from giantlike.simulation import Sources, simulate_image

_MARGIN_PX = 60  # sky around the drawn body: the widest search of an estimator by default, 40 px, and background beyond
_FACETS = (2_000, 80_000)  # fewest and most of a drawn body declared an ellipsoid; between, two a square pixel
_RELIEF_WAVES = ((3.0, 1.0), (7.0, 0.5), (16.0, 0.25))
"""Wave numbers of relief, per radius, and their amplitudes: shorter waves are as steep as longer ones."""
_WAVES = 24  # plane waves of a random field, of which half were too few for a normal distribution
_DARKEST = 0.05  # smallest relative albedo of a drawn surface
_OF_MODEL = frozenset(
    {
        Cause.REFLECTANCE,
        Cause.ALBEDO,
        Cause.RELIEF,
        Cause.SHAPE_SCALE,
        Cause.POLE,
        Cause.SPIN,
        Cause.SUN,
        Cause.ORIENTATION,
    }
)
"""Causes whose errors in the image grow with the size of the body."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthOptions:
    """Standard deviations from which bodies and optics are drawn, in addition to the uncertainties of the target.

    Parameters
    ----------
    relief : float; of the surface about the declared shape, over its radius
    albedo : float, optional; of albedo, relative; default: drawn from the prior of :mod:`giantlike.image_model.field`
    brightness : float; relative, of the normal albedo
    law : float; of the share of Lambert's law less that of Lommel and Seeliger's, and of the phase slope, 1/rad
    psf : float; relative, of the width of the point spread function

    Raises
    ------
    InputError
        A value is out of range.
    """

    relief: float = 0.01
    albedo: float | None = None
    brightness: float = 0.2
    law: float = LAW_SHARE_SIGMA
    psf: float = 0.05

    def __post_init__(self) -> None:
        require_number(self.relief, "truth relief", least=0.0, most=0.2)
        require_number(0.0 if self.albedo is None else self.albedo, "truth albedo", least=0.0, most=1.0)
        require_number(self.brightness, "truth brightness", least=0.0, most=1.0)
        require_number(self.law, "truth law", least=0.0, most=2.0)
        require_number(self.psf, "truth psf", least=0.0, most=0.5)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FixForecast(Value):
    """Fix that an estimator will make of an image, by drawn images.

    Parameters
    ----------
    estimator : str
    draws : int; number of drawn images of about this size, phase and brightness
    failures : mapping of str to int; number of draws by reason; of suspect fixes as ``suspect``
    covariance : (k, k) float64, optional
        Expected covariance of x and y, px, and, where the fix has a range (k = 3), of its natural logarithm. None where
        no draw gave a fix.
    parts : mapping of Cause to (k, k) float64; that covariance by cause
    nees : float; mean normalized squared error over dimension, near 1 if covariances hold; NaN without fixes
    """

    estimator: str
    draws: int
    failures: Mapping[str, int] = field(default_factory=dict)
    covariance: Float | None = None
    parts: Mapping[Cause, Float] = field(default_factory=dict)
    nees: float = math.nan

    @property
    def failure_probability(self) -> float:
        """Probability of no usable fix: the mean of Jeffreys' posterior."""
        return (sum(self.failures.values()) + 0.5) / (self.draws + 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drawn(Value):
    """Result of an estimator on a drawn image; axes along the Sun in the image and across it."""

    reason: str = ""
    parts: Mapping[Cause, Float] = field(default_factory=dict)  # (k, k) by cause; empty for a failure
    error: Float = field(default_factory=lambda: np.zeros(0))  # (k,)
    diameter_px: float = 1.0


def draw_law(law: Reflectance, sigma: float, random: np.random.Generator) -> Reflectance:
    """Law that a surface may follow where another is declared: a share of Lambert's, and a slope over the phase."""
    share, slope = sigma * random.standard_normal(2)
    return UserReflectance(function=partial(_mixed_law, law, float(share), float(slope)), name="drawn")


def _mixed_law(law: Reflectance, share: float, slope: float, mu0: Float, mu: Float, phase_rad: Float) -> Float:
    change = share * (Lambert()(mu0, mu, phase_rad) - LommelSeeliger()(mu0, mu, phase_rad))
    return np.maximum(law(mu0, mu, phase_rad) + change, 0.0) * np.exp(-slope * phase_rad)


def draw_target(target: Target, truth: TruthOptions, diameter_px: float, random: np.random.Generator) -> Target:
    """Body that a target may be: relief, markings, law, brightness and size drawn, orientation in body axes too."""
    known, shape = target.uncertainty, target.shape
    if isinstance(shape, LevelsOfDetail):
        shape = shape.finest
    if isinstance(shape, Ellipsoid):
        shape = mesh_from_ellipsoid(shape, facets=int(np.clip(2.0 * diameter_px**2, *_FACETS)))
    assert isinstance(shape, TriangleMesh)
    points = unit(shape.vertices_km)
    amplitudes = truth.relief / math.hypot(*(part for _, part in _RELIEF_WAVES))
    relief = np.zeros(len(points))
    for wavenumber, part in _RELIEF_WAVES if truth.relief else ():
        relief += amplitudes * part * surface_waves(points, random, wavenumber=wavenumber, waves=_WAVES)
    moved = np.column_stack([np.ones(len(points)), points])  # another size or center is no relief
    relief -= moved @ np.linalg.lstsq(moved, relief, rcond=None)[0]
    amplitude = truth.albedo
    if amplitude is None:
        amplitude = MEDIAN_AMPLITUDE * AMPLITUDE_FACTOR ** float(random.standard_normal())
        amplitude = 0.0 if random.random() < UNMARKED else min(amplitude, float(AMPLITUDES[-1]))
    wavenumber = math.sqrt(3.0) / float(random.choice(LENGTHS))  # root mean square of a Gaussian spectrum
    markings = 1.0 + amplitude * surface_waves(points, random, wavenumber=wavenumber, waves=_WAVES)
    own = shape.albedo.values if isinstance(shape.albedo, VertexAlbedo) else 1.0
    turn = Rotation.from_rotvec(random.standard_normal(3) * [known.pole_rad, known.pole_rad, known.spin_rad])
    if known.pole_unknown:
        turn = Rotation.random(random_state=random)
    size = (1.0 + relief) * (1.0 + known.scale * random.standard_normal())
    drawn = TriangleMesh(rotate(turn, shape.vertices_km * size[:, None]), shape.faces, "drawn")
    albedo = target.normal_albedo
    return replace(
        target,
        shape=drawn.with_albedo(VertexAlbedo(np.maximum(markings, _DARKEST) * own)),
        reflectance=draw_law(target.reflectance, truth.law, random),
        normal_albedo=None if albedo is None else albedo * math.exp(truth.brightness * random.standard_normal()),
        terrain=None,
        atmosphere=None,
        rings=None,
    )


def can_be_drawn(target: Target) -> bool:
    """True for a body that images can be drawn of: one with a surface, and without an atmosphere."""
    return target.atmosphere is None and not isinstance(target.shape, Point)


def draw_fixes(
    candidate: Candidate,
    geometry: TargetGeometry,
    exposure_s: float,
    camera: Camera,
    scene: Scene,
    estimators: Sequence[str],
    *,
    truth: TruthOptions,
    sources: Sources,
    seed: tuple[int, ...],
) -> dict[str, Drawn]:
    """Draw an image of a candidate and run estimators on it, with the scene as it is declared; results by name."""
    random, name = np.random.default_rng([*seed, 2]), geometry.target.name
    attitude = candidate.camera_from_inertial
    assert attitude is not None
    known = geometry.target.uncertainty
    diameter_px = 2.0 * geometry.target.shape.mean_radius_km / geometry.range_km * camera.model.focal_length_px
    offset_km = np.linalg.cholesky(known.covariance_ephemeris_km2 + 1e-18 * np.eye(3)) @ random.standard_normal(3)
    inertial_from_camera = attitude.inv()
    sun_turn = Rotation.from_rotvec(known.sun_rad * random.standard_normal(3))
    place = ApparentGeometry(
        position_inertial_km=rotate(inertial_from_camera, geometry.position_camera_km) + offset_km,
        inertial_from_body=inertial_from_camera * geometry.camera_from_body,
        sun_direction_inertial=rotate(sun_turn * inertial_from_camera, geometry.sun_direction_camera),
    )
    body = replace(draw_target(geometry.target, truth, diameter_px, random), ephemeris=place)
    declared = candidate.scene(scene)
    others = (body if other.name == name else other for other in declared.targets)
    psf_px = UNKNOWN_PSF_SIGMA_PX if camera.psf is None else camera.psf.sigma_px
    blurred = GaussianPsf(sigma_px=psf_px * math.exp(truth.psf * random.standard_normal()))
    window = _window_about(camera, geometry, diameter_px)
    taken = simulate_image(
        candidate.shot(exposure_s),
        replace(window, psf=blurred),
        replace(sources, scene=replace(declared, targets=tuple(others))),
        seed=(*seed, 3),
    )
    position_km = rotate(attitude, place.position_inertial_km)
    results = {}
    for estimator in estimators:
        solver: Estimator = ESTIMATORS[estimator]()
        fix = solver.estimate(taken.image, window, declared, name)
        results[estimator] = _result_of(fix, window, position_km, geometry, diameter_px)
    return results


def _window_about(camera: Camera, geometry: TargetGeometry, diameter_px: float) -> Camera:
    """Camera of the part of the frame around a body: an estimate depends on no more."""
    reach = geometry.target.shape.circumscribing_radius_km / geometry.target.shape.mean_radius_km
    half = 0.5 * reach * diameter_px + _MARGIN_PX
    center, size = camera.model.project(geometry.position_camera_km), np.array([camera.columns, camera.rows])
    low = np.clip(np.floor(center - half), 0, size - 1).astype(int)
    high = np.clip(np.ceil(center + half) + 1, low + 1, size).astype(int)
    columns, rows = (high - low).tolist()
    return camera.windowed(int(low[0]), int(low[1]), columns=columns, rows=rows)


def _axes_along_sun(camera: Camera, geometry: TargetGeometry, size: int) -> Float:
    """Matrix (size, size) from x, y and what follows to the axes along the Sun in the image and across it."""
    sun = camera.model.project_jacobian(geometry.position_camera_km[None])[0] @ geometry.sun_direction_camera
    x, y = unit(sun) if np.hypot(*sun) > 0.0 else np.array([1.0, 0.0])
    axes = np.eye(size)
    axes[:2, :2] = [[x, y], [-y, x]]
    return axes


def _result_of(
    fix: CenterFix | Failure, camera: Camera, position_km: Float, geometry: TargetGeometry, diameter_px: float
) -> Drawn:
    """Error of a fix and its covariance by cause, about the true position."""
    if isinstance(fix, Failure):
        return Drawn(reason="not_applicable" if fix.not_applicable else str(fix.reason))
    error = fix.center_px - camera.model.project(position_km)
    if isinstance(fix, PositionFix):
        error = np.append(error, math.log(fix.range_km / float(np.linalg.norm(position_km))))
    axes = _axes_along_sun(camera, geometry, len(error))
    return Drawn(
        reason="suspect" if fix.flags.suspect else "",
        parts={cause: axes @ part @ axes.T for cause, part in fix.parts.items() if cause in IN_IMAGE},
        error=axes @ error,
        diameter_px=diameter_px,
    )


def forecast_fix(
    estimator: str, drawn: Sequence[Drawn], camera: Camera, geometry: TargetGeometry, diameter_px: float
) -> FixForecast:
    """Mean of the covariances of the fixes of drawn images, for an image of one of them."""
    reasons = [one.reason for one in drawn if one.reason]
    failures = {reason: reasons.count(reason) for reason in sorted(set(reasons))}
    plain = FixForecast(estimator=estimator, draws=len(drawn), failures=failures)
    usable = [one for one in drawn if one.parts and not one.reason] or [one for one in drawn if one.parts]
    if not usable:
        return plain
    size = max(len(one.error) for one in usable)
    usable = [one for one in usable if len(one.error) == size]
    squares = [one.error @ np.linalg.solve(sum_parts(one.parts), one.error) / size for one in usable]
    back = _axes_along_sun(camera, geometry, size).T
    parts: dict[Cause, Float] = {}
    for one in usable:
        for cause, part in one.parts.items():
            grown = np.ones(size)
            grown[:2] = diameter_px / one.diameter_px if cause in _OF_MODEL else 1.0
            scaled = back * grown @ part @ (back * grown).T / len(usable)
            parts[cause] = parts.get(cause, np.zeros((size, size))) + 0.5 * (scaled + scaled.T)
    return replace(plain, covariance=sum_parts(parts), parts=parts, nees=float(np.mean(squares)))
