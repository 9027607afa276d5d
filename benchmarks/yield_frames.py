"""Images for ``yield.py`` with their truth: real frames and their variants, images of the gauntlet, cases of stress.

Not a benchmark itself. A trial is one image as the estimators get it, the estimators, and the truth.
"""

from __future__ import annotations

import csv
import json
import math
import re
import sys
import tempfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from stress_truth import CASES, draw_of, view_of

from giantlike.atmosphere import Atmosphere
from giantlike.camera import Camera
from giantlike.campaign import Campaign
from giantlike.campaign.run.image_loading import open_image, scene_of
from giantlike.campaign.run.worker_context import Workbench
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.ephemeris import ApparentGeometry
from giantlike.gauntlet.rule import facts_of, solvable
from giantlike.gauntlet.stage import kind_of, stage_of
from giantlike.gauntlet.trial import names_for
from giantlike.image import Image
from giantlike.ray_tracing import Lambert
from giantlike.relative import ESTIMATORS, Estimator
from giantlike.scene import Scene, Target, TargetUncertainty
from giantlike.shapes import Ellipsoid

sys.path.insert(0, str(Path(__file__).parent.parent / "examples"))
from real_body_variants import IN_ALL, Frame, configured, frames, variants

NAMES = ("moment", "cross_correlation", "limb_matching", "ellipsoid_cra", "sigmoid_limb", "ellipse_fit", "auto")
"""Estimators of bodies that are resolved; ``auto`` last, as it may use the results of the others."""
SEARCH_PX, SEARCH_RANGE = 40.0, 0.03
"""Search by default, px and relative: the narrowest one of all estimators, as in the rule of the gauntlet."""
WRONG_INPUTS = (
    "rows reversed",
    "upside down",
    "size +10 %",
    "size -8 %",
    "another shape",
    "Sun turned 180",
)
"""Variants in which the body, its Sun or the image is another than was declared: nothing correct can be found."""
MADE_UP = ("Mimas N1644787857_1.LBL", "Saturn N1460002670_1.IMG")
"""Real frames whose declared geometry (Sun, orientation, size) is a reading of the picture itself."""
NOT_OBSERVABLE = ("focal", "twin")
"""Kinds of the gauntlet whose error no image shows (docs/gauntlet.md, "What no image can reveal")."""
EPIC_SIGMA_RANGE = 0.003
"""Relative error of the range of EPIC frames, whose truth has none: the 0.3 % of scale that is declared with them."""
GOES_RAD_PER_PX = 56e-6 * 5424 / 1024  # of the fixed grid, reduced to 1024 px


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One image as the estimators get it, and its truth.

    Parameters
    ----------
    collection, frame, variant : str
    image : Image
    camera : Camera
    scene : Scene
    estimators : mapping of str to Estimator
        By name, in the order in which they run.
    center_px : (2,) float64, px
        Truth.
    range_km : float, km
        Truth.
    covariance : (3, 3) float64
        Of the truth: x, y in px and ln range; an infinite variance where the range is not known.
    present : bool
        False where there is no such body in the image.
    observable : bool
        False where no image shows the error of the inputs.
    search : (float, float)
        Half width of the search in px and relative range.
    answerable : tuple of str or None
        Estimators of which an answer is demanded; None where the committed list says so.
    total : bool
        Judge by the sum of all parts of the covariance: attitude and camera are part of the truth.
    """

    collection: str
    frame: str
    variant: str
    image: Image
    camera: Camera
    scene: Scene
    estimators: Mapping[str, Estimator]
    center_px: Float
    range_km: float
    covariance: Float
    present: bool = True
    observable: bool = True
    search: tuple[float, float] = (SEARCH_PX, SEARCH_RANGE)
    answerable: tuple[str, ...] | None = None
    total: bool = False

    @property
    def radius_px(self) -> float:
        """Apparent mean radius of the body at its true range, px."""
        radius_km = self.scene.target().shape.mean_radius_km
        return float(radius_km / self.range_km * self.camera.model.focal_length_px)

    def prediction(self) -> tuple[Float, float, Float | None] | None:
        """Center, px, range, km, and the covariance (3, 3) of x, y and ln range where one is declared.

        None where the geometry is refused, or the body is behind the camera.
        """
        geometry = self.scene.geometry(self.image)
        if isinstance(geometry, Failure):
            return None
        position, model = geometry.position_camera_km, self.camera.model
        sigma_km = geometry.target.uncertainty.ephemeris_km
        covariance = None
        if sigma_km is not None and np.any(np.asarray(sigma_km) > 0):
            spread = np.eye(3) * np.asarray(sigma_km) ** 2
            turn = self.image.attitude_covariance_rad2
            if turn is not None:
                cross = np.cross(np.eye(3), position)  # rows: derivative of e x position by e
                spread = spread + cross.T @ turn @ cross
            jacobian = np.vstack([model.project_jacobian(position), position / (position @ position)])
            covariance = jacobian @ spread @ jacobian.T
        return model.project(position), float(np.linalg.norm(position)), covariance


# Real frames of examples/real_body_variants.py


@lru_cache(maxsize=1)
def _real(data: Path, cache: Path) -> list[Frame]:
    """All frames; their measured outlines are kept in a folder."""
    cache.mkdir(parents=True, exist_ok=True)
    return frames(data, cache)


def real_jobs(data: Path, cache: Path, *, every: bool = False) -> list[tuple[str, str]]:
    """Names of frames and variants, in the sampling of ``real_body_variants.py``."""
    found = _real(data, cache)
    return [
        (frame.name, name)
        for index, name in enumerate(variants(data))
        for number, frame in enumerate(found)
        if every or name == "base" or frame.name in IN_ALL or (index + number) % 3 == 0
    ]


def real_trial(data: Path, cache: Path, name: str, variant: str) -> Trial | None:
    """A variant of a real frame; None where it does not apply."""
    original = next(frame for frame in _real(data, cache) if frame.name == name)
    frame = variants(data)[variant](original)
    if frame is None:
        return None
    variance = frame.sigma_px**2 if math.isfinite(frame.sigma_px) else math.inf
    return Trial(
        collection="real",
        frame=name,
        variant=variant,
        image=frame.image(),
        camera=frame.camera,
        scene=frame.scene(),
        estimators={one: configured(one, frame.options) for one in NAMES},
        center_px=frame.center_px,
        range_km=float(np.linalg.norm(frame.position_km)),
        covariance=np.diag([variance, variance, frame.sigma_range**2]),
        present=frame.present,
        search=(frame.options.get("search_px", SEARCH_PX), frame.options.get("search_range", SEARCH_RANGE)),
    )


# Campaigns of real2


@dataclass(frozen=True)
class FixedGrid:
    """The fixed grid of GOES-R imagers as a lens of a user: ``u = asin(X / |p|)``, ``v = atan(Y / Z)``.

    Parameters
    ----------
    scale_rad, cx_px, cy_px : float
        Angle of a pixel; center of projection.
    """

    type_name: ClassVar[str] = "goes_fixed_grid"
    parameter_names: ClassVar[tuple[str, ...]] = ("scale_rad", "cx_px", "cy_px")
    scale_rad: float = GOES_RAD_PER_PX
    cx_px: float = 511.5
    cy_px: float = 511.5

    @property
    def parameters(self) -> Float:
        """Values of :attr:`parameter_names`."""
        return np.array([self.scale_rad, self.cx_px, self.cy_px])

    def with_parameters(self, values: ArrayLike) -> Self:
        """Return the model with other values."""
        return type(self)(*np.asarray(values, dtype=float).tolist())

    @property
    def focal_length_px(self) -> float:
        """Pixels per radian."""
        return 1.0 / self.scale_rad

    def project(self, points_camera: ArrayLike) -> Float:
        """Pixels of points."""
        points = np.asarray(points_camera, dtype=float)
        x, y, z = np.moveaxis(points, -1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            angles = np.stack([np.arcsin(x / np.linalg.norm(points, axis=-1)), np.arctan(y / z)], axis=-1)
        angles = np.where((z > 0.0)[..., None], angles, np.nan)
        return np.asarray([self.cx_px, self.cy_px] + angles / self.scale_rad)

    def unproject(self, points_px: ArrayLike) -> Float:
        """Directions of pixels."""
        u, v = np.moveaxis((np.asarray(points_px, dtype=float) - [self.cx_px, self.cy_px]) * self.scale_rad, -1, 0)
        return np.stack([np.sin(u), np.cos(u) * np.sin(v), np.cos(u) * np.cos(v)], axis=-1)

    def project_jacobian(self, points_camera: ArrayLike) -> Float:
        """Derivative of the pixels by the points."""
        points = np.asarray(points_camera, dtype=float)
        x, y, z = np.moveaxis(points, -1, 0)
        across, square = np.hypot(y, z), np.sum(points**2, axis=-1)
        by_u = np.stack([across / square, -x * y / (across * square), -x * z / (across * square)], axis=-1)
        by_v = np.stack([np.zeros_like(x), z / across**2, -y / across**2], axis=-1)
        return np.asarray(np.stack([by_u, by_v], axis=-2) / self.scale_rad)

    def unproject_jacobian(self, points_px: ArrayLike) -> Float:
        """Derivative of the directions by the pixels."""
        u, v = np.moveaxis((np.asarray(points_px, dtype=float) - [self.cx_px, self.cy_px]) * self.scale_rad, -1, 0)
        by_u = np.stack([np.cos(u), -np.sin(u) * np.sin(v), -np.sin(u) * np.cos(v)], axis=-1)
        by_v = np.stack([np.zeros_like(u), np.cos(u) * np.cos(v), -np.cos(u) * np.sin(v)], axis=-1)
        return np.asarray(np.stack([by_u, by_v], axis=-1) * self.scale_rad)

    def parameter_jacobian(self, points_camera: ArrayLike, temperature_c: float = 0.0) -> Float:
        """Derivative of the pixels by the parameters."""
        offset = self.project(points_camera) - [self.cx_px, self.cy_px]
        ones, zeros = np.ones(offset.shape[:-1]), np.zeros(offset.shape[:-1])
        centers = np.stack([np.stack([ones, zeros], -1), np.stack([zeros, ones], -1)], -1)
        return np.concatenate([-offset[..., None] / self.scale_rad, centers], axis=-1)

    def at_temperature(self, temperature_c: float) -> Self:
        """Return the model itself: it has no temperature terms."""
        return self


REAL2_VARIANTS = ("base", "turned 90", "blurred 1 px", "noise 5 %", "off -7, 5 px, -1 %")
"""Variants that keep the truth; the campaigns themselves are off by (7, -5) px and 1 % of range."""


def real2_jobs(data: Path) -> list[tuple[str, str]]:
    """Names of folders and variants; negatives as they are."""
    folders = sorted(path.name for path in (data / "real2").iterdir() if path.is_dir())
    return [
        (folder, variant)
        for variant in REAL2_VARIANTS
        for folder in folders
        if variant == "base" or not _truth_of(data / "real2" / folder).get("negative")
    ]


def real2_trial(data: Path, name: str, variant: str) -> Trial | None:
    """A variant of a campaign of ``real2``; None where it does not apply."""
    folder = data / "real2" / name
    truth = _truth_of(folder)
    image, camera, scene, estimators = (_goes if name == "goes16_earth" else _campaign)(folder)
    sigma_range = truth.get("sig_rng", EPIC_SIGMA_RANGE)
    trial = Trial(
        collection="real2",
        frame=name,
        variant="base",
        image=image,
        camera=camera,
        scene=scene,
        estimators={one: estimators[one] for one in NAMES if one in estimators},
        center_px=np.array(truth["center"]),
        range_km=truth["range_km"],
        covariance=np.diag([*np.square(truth["sig"]), sigma_range**2]),
        present=not truth.get("negative", False),
    )
    return _real2_variant(trial, variant)


def _truth_of(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "truth.json").read_text())
    return found


def _campaign(folder: Path) -> tuple[Image, Camera, Scene, dict[str, Estimator]]:
    """Image, camera, scene and estimators of a campaign of one image and one target.

    A path of kernels that was written elsewhere is replaced by that of the data, in a copy of the file.
    """
    data, text = folder.parent.parent.resolve(), (folder / "campaign.toml").read_text()
    with tempfile.TemporaryDirectory() as copy:
        for path in folder.iterdir():
            if path.name != "campaign.toml":
                (Path(copy) / path.name).symlink_to(path.resolve())
        (Path(copy) / "campaign.toml").write_text(re.sub(r"[\w./-]*shared/data", data.as_posix(), text))
        campaign = Campaign.load(Path(copy) / "campaign.toml")
        bench = Workbench.load(campaign)
        image = open_image(campaign, campaign.images[0]).image
    (target,) = campaign.targets
    scene = scene_of(campaign, image, target, bench.shapes[target.name])
    if isinstance(scene, Failure):
        scene.unwrap()
    return image, campaign.camera, scene, {one.name: one for one in target.estimators}


def _goes(folder: Path) -> tuple[Image, Camera, Scene, dict[str, Estimator]]:
    """The frame of GOES-16, whose lens is none of the package; the Earth is declared as in the campaigns of EPIC."""
    with (folder / "geometry.csv").open() as lines:
        (row,) = csv.DictReader(lines)

    def numbers(*names: str) -> Float:
        return np.array([float(row[name]) for name in names])

    camera = Camera(
        name="GOES-16 ABI",
        columns=1024,
        rows=1024,
        model=FixedGrid(),
        psf=GaussianPsf(sigma_px=0.6),
        detector=Detector(gain_e_per_dn=20.0, read_noise_e=20.0, saturation_dn=250.0),
    )
    geometry = ApparentGeometry(
        position_inertial_km=numbers("target_x_km", "target_y_km", "target_z_km"),
        inertial_from_body=Rotation.from_quat(numbers("body_qx", "body_qy", "body_qz", "body_qw")).inv(),
        sun_direction_inertial=numbers("sun_x", "sun_y", "sun_z"),
    )
    target = Target(
        name="EARTH",
        shape=Ellipsoid(radii_km=np.array([6378.137, 6378.137, 6356.752]), name="EARTH"),
        ephemeris=geometry,
        reflectance=Lambert(),
        atmosphere=Atmosphere.of("EARTH"),
        uncertainty=TargetUncertainty(albedo=0.5, scale=0.003),
    )
    image = Image.open(folder / row["file"]).with_attitude(Rotation.identity())
    return image, camera, Scene(targets=(target,)), {name: ESTIMATORS[name]() for name in NAMES}


def _real2_variant(trial: Trial, variant: str) -> Trial | None:
    """A variant of a trial; None where it does not apply."""
    image, camera, pixels = trial.image, trial.camera, np.asarray(trial.image.pixels)
    if variant == "base":
        return trial
    if variant == "turned 90":
        return _turned(trial)
    if variant == "blurred 1 px":
        soft = gaussian_filter(pixels.astype(np.float64), 1.0)
        if pixels.dtype.kind in "iu":
            limits = np.iinfo(pixels.dtype)
            soft = np.clip(np.rint(soft), limits.min, limits.max)
        return replace(trial, variant=variant, image=replace(image, pixels=soft.astype(pixels.dtype)))
    if variant == "noise 5 %":
        good = pixels[~image.mask]
        covered = min(math.pi * trial.radius_px**2 / good.size, 1.0)
        detector = image.detector or camera.detector
        sigma_dn = 0.05 * (float(np.percentile(good, 100.0 - 10.0 * covered)) - detector.bias_dn)
        random = np.random.default_rng(zlib.crc32(trial.frame.encode()))
        noisy = pixels + sigma_dn * random.standard_normal(pixels.shape)
        if not detector.estimated:  # a detector that is not declared takes its noise from the image
            noise_e = math.hypot(detector.read_noise_e, sigma_dn * detector.gain_e_per_dn)
            camera = replace(camera, detector=replace(detector, read_noise_e=noise_e))
        return replace(trial, variant=variant, image=replace(image, pixels=noisy.astype(np.float32)), camera=camera)
    assert variant == "off -7, 5 px, -1 %"
    return _predicted(trial, np.array([-7.0, 5.0]), -0.01, variant)


def _turned(trial: Trial) -> Trial | None:
    """The image turned by 90 degrees, clockwise as seen, and with it lens and attitude; for pinhole cameras."""
    camera, rows = trial.camera, trial.camera.rows
    if camera.model.type_name != "pinhole":
        return None
    model: Any = camera.model
    lens = replace(model, fx_px=model.fy_px, fy_px=model.fx_px, cx_px=rows - 1.0 - model.cy_px, cy_px=model.cx_px)
    attitude, quarter = trial.image.camera_from_inertial, Rotation.from_rotvec([0.0, 0.0, 0.5 * math.pi])
    assert attitude is not None
    image = replace(
        trial.image,
        pixels=np.ascontiguousarray(np.rot90(trial.image.pixels, -1)),
        mask=np.ascontiguousarray(np.rot90(trial.image.mask, -1)),
        camera_from_inertial=quarter * attitude,
    )
    x, y = trial.center_px
    flip = np.array([1, 0, 2])
    return replace(
        trial,
        variant="turned 90",
        image=image,
        camera=replace(camera, columns=rows, rows=camera.columns, model=lens),
        center_px=np.array([rows - 1.0 - y, x]),
        covariance=trial.covariance[np.ix_(flip, flip)],
    )


def _predicted(trial: Trial, off_px: Float, off_range: float, variant: str) -> Trial:
    """With another error of the prediction."""
    (target,), attitude = trial.scene.targets, trial.image.camera_from_inertial
    assert attitude is not None
    assert isinstance(target.ephemeris, ApparentGeometry)
    sight = attitude.inv().apply(trial.camera.model.unproject(trial.center_px + off_px))
    moved = replace(target.ephemeris, position_inertial_km=trial.range_km * (1.0 + off_range) * sight)
    return replace(trial, variant=variant, scene=replace(trial.scene, targets=(replace(target, ephemeris=moved),)))


# Made-up images


def gauntlet_jobs(seed: int, images: int) -> list[tuple[str, str]]:
    """Images of bodies among the first of a seed."""
    return [(f"{seed} {index}", "base") for index in range(images) if kind_of(seed, index).body]


def gauntlet_trial(name: str) -> Trial | None:
    """An image of the gauntlet; None where there is no body to look for."""
    stage = stage_of(*map(int, name.split()))
    if stage.scene is None:
        return None
    facts = facts_of(stage.plan, stage.signal_dn, undisturbed=stage.kind.undisturbed)
    names = [one for one in names_for(stage, facts) if one in ESTIMATORS]
    return Trial(
        collection="gauntlet",
        frame=name,
        variant=stage.kind.name,
        image=stage.image,
        camera=stage.camera,
        scene=stage.scene,
        estimators={one: ESTIMATORS[one]() for one in names},
        center_px=stage.world.center_px,
        range_km=stage.world.range_km,
        covariance=np.zeros((3, 3)),
        present=not facts.absent,
        observable=stage.kind.name not in NOT_OBSERVABLE,
        answerable=tuple(one for one in names if solvable(one, facts)),
    )


def stress_jobs(views: range, draws: int) -> list[tuple[str, str]]:
    """Views of all cases, and draws of noise."""
    return [(f"{case.name}: {view}", f"draw {draw}") for case in CASES for view in views for draw in range(draws)]


@lru_cache(maxsize=2)
def _view(name: str) -> Any:
    """A rendered view of a case."""
    case, number = name.rsplit(": ", 1)
    return view_of(next(one for one in CASES if one.name == case), int(number))


def stress_trial(name: str, variant: str) -> Trial:
    """A draw of a view of a case of ``stress.py``, all of whose estimators are to answer."""
    from stress import estimator_of

    seen = _view(name)
    draw = draw_of(seen, int(variant.split()[-1]))
    position, center = seen.position_camera_km, seen.center_px
    if seen.case.observed:
        told = draw.image.camera_from_inertial
        assert told is not None
        position = (told * seen.attitude.inv()).apply(position)
        center = seen.camera.model.project(position)
    return Trial(
        collection="stress",
        frame=name,
        variant=variant,
        image=draw.image,
        camera=seen.camera,
        scene=draw.scene,
        estimators={one: estimator_of(one, seen.case) for one in seen.case.estimators},
        center_px=center,
        range_km=float(np.linalg.norm(position)),
        covariance=np.zeros((3, 3)),
        answerable=seen.case.estimators,
        total=seen.case.observed,
    )


# The list of what can be answered, by the truth and the picture alone


TEMPLATE_PX, LIMB_PX, ELLIPSE_PX, LIT_LIMB_PX, MARGIN_PX, LARGEST_PHASE_DEG = 15.0, 40.0, 60.0, 60.0, 10.0, 110.0
"""Limits of ``giantlike.gauntlet.rule`` at f8b34e9, repeated here so that the list does not follow later changes."""
LEAST_IN_FRAME = 0.5
"""Share of the disk in the frame from which on a template is demanded of a body that the frame cuts."""
NO_MOMENT = {
    "titan_N1689372": "another moon touches the disk",
    "vgr_jupiter_1464114": "lines missing across the disk",
    "vgr_uranus_2654655": "lines missing across the disk",
    "Saturn c3440346.gem": "rings",
    "Saturn c3440346.img": "rings",
}
"""Frames with other light at the body, or without a part of its light: no center of brightness."""
NO_ELLIPSE = {
    "titan_N1689372": "another moon touches the disk",
    "vgr_jupiter_1464114": "lines missing across the disk",
    "vgr_uranus_2654655": "lines missing across the disk",
}
"""Frames whose outline is not that of the body alone: no free ellipse without a prediction."""


@dataclass(frozen=True, kw_only=True)
class Demand:
    """Estimators of which an answer is demanded, and why not of others."""

    names: tuple[str, ...] = ()
    why_not: str = ""
    reasons: dict[str, str] = field(default_factory=dict)


def demanded(trial: Trial) -> Demand:
    """What is demanded on a real frame, by its truth and the picture alone.

    Nothing is demanded of an image without the body, of wrong inputs (:data:`WRONG_INPUTS`), of geometry read off the
    picture (:data:`MADE_UP`), beyond 110 degrees of phase, or where the prediction is off by more than the search. Of
    the rest:

    - ``moment``: whole bodies from 15 px on;
    - ``cross_correlation``: bodies from 15 px on with half of the disk in the frame;
    - ``limb_matching``: bodies from 40 px on with 60 px of lit limb in the frame;
    - ``ellipsoid_cra`` and ``sigmoid_limb``: the same of ellipsoids;
    - ``ellipse_fit``: whole ellipsoids from 60 px on;
    - ``auto``: where one of the first four is to answer.
    """
    if not trial.present:
        return Demand(why_not="the body is not in the image")
    if trial.variant in WRONG_INPUTS:
        return Demand(why_not="wrong inputs")
    if trial.frame in MADE_UP:
        return Demand(why_not="geometry read off the picture")
    geometry, prediction = trial.scene.geometry(trial.image), trial.prediction()
    assert not isinstance(geometry, Failure)
    assert prediction is not None
    offset, ratio = float(np.hypot(*(prediction[0] - trial.center_px))), prediction[1] / trial.range_km
    if offset > trial.search[0] or abs(ratio - 1.0) > trial.search[1]:
        return Demand(why_not="prediction outside the search")
    sight = trial.camera.model.unproject(trial.center_px)
    phase_deg = math.degrees(math.acos(float(np.clip(-(geometry.sun_direction_camera @ sight), -1.0, 1.0))))
    if phase_deg > LARGEST_PHASE_DEG:
        return Demand(why_not="phase angle")
    return _by_appearance(trial, geometry.sun_direction_camera, isinstance(geometry.target.shape, Ellipsoid))


def _by_appearance(trial: Trial, sun: Float, ellipsoid: bool) -> Demand:
    """What is demanded by size, limb and disk in the frame as far as it was sent, of a sphere of the mean radius."""
    radius, diameter = trial.radius_px, 2.0 * trial.radius_px
    rows, columns = (np.flatnonzero((~trial.image.mask).any(axis=axis)) for axis in (1, 0))
    low, high = np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]])
    angles = np.arange(360) * (2.0 * math.pi / 360)
    outward = np.stack([np.cos(angles), np.sin(angles)], axis=1)

    def inside(points: Float) -> Any:
        return ((points >= low) & (points <= high)).all(axis=-1)

    lit = inside(trial.center_px + radius * outward) & (outward @ sun[:2] > 0.0)
    limb_px = float(lit.sum()) * math.pi * diameter / len(angles)
    shells = np.sqrt((np.arange(50) + 0.5) / 50)[:, None, None]  # equal areas
    share = float(inside(trial.center_px + radius * shells * outward).mean())
    reach = radius * trial.scene.target().shape.circumscribing_radius_km / trial.scene.target().shape.mean_radius_km
    whole = bool(inside(trial.center_px - reach - MARGIN_PX) and inside(trial.center_px + reach + MARGIN_PX))
    limb = diameter >= LIMB_PX and limb_px >= LIT_LIMB_PX
    found = {
        "moment": whole and diameter >= TEMPLATE_PX and trial.frame not in NO_MOMENT,
        "cross_correlation": share >= LEAST_IN_FRAME and diameter >= TEMPLATE_PX,
        "limb_matching": limb,
        "ellipsoid_cra": limb and ellipsoid,
        "sigmoid_limb": limb and ellipsoid,
        "ellipse_fit": whole and diameter >= ELLIPSE_PX and ellipsoid and trial.frame not in NO_ELLIPSE,
    }
    found["auto"] = any(found[name] for name in NAMES[:4])
    reasons = {
        name: why[trial.frame]
        for name, why in (("moment", NO_MOMENT), ("ellipse_fit", NO_ELLIPSE))
        if trial.frame in why
    }
    names = tuple(name for name in NAMES if found[name] and name in trial.estimators)
    return Demand(names=names, why_not="" if names else "no limb, and no whole disk", reasons=reasons)
