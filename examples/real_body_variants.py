"""Real images of bodies under conditions that nobody tuned for.

Every image of ``real_body_cases.py`` through every estimator, in variants: turned, cropped, blurred, saturated, noisy,
in other units, with a wrong body, Sun, law, attitude or prediction. Truth is changed with the image. Where labels and
kernels don't tell the center, ``real_body_outline.py`` does. Seven images of as many kinds go through all variants; the
others through the base and every third, unless ``--all`` is given.

    python examples/real_body_variants.py DATA OUTPUT [--only VARIANT;...] [--images NAME] [--processes 2] [--all]

Prints the tables of ``real_body_report.py`` and writes them, ``variants.json``, and row by row ``variants.jsonl``.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from real_bodies import eros
from real_body_cases import Case, cassini_without_geometry, earth, europa, jupiter, vesta, voyager
from real_body_outline import Seen, measured_outline
from real_body_report import NAMES, report
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float, Mask
from giantlike.core.detector import GaussianPsf
from giantlike.core.frames import rotate
from giantlike.core.outcomes import CenterFix, Failure, PositionFix, Quality
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.ray_tracing import Lambert, McEwen
from giantlike.relative import ESTIMATORS, Auto, AutoOptions, Estimator
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid, Shape, TriangleMesh, load_shape

OFF_PX, OFF_RANGE = np.array([7.0, -5.0]), 0.01  # of the prediction in all variants but those that say otherwise
RINGS_FREE_DEG = ((-180.0, -110.0), (150.0, 180.0), (-30.0, 50.0))  # parts of Saturn's limb that no ring crosses
ROLL_RAD = 0.035  # of attitudes found by likeness to three degrees
OUTLINES = {
    "Jupiter n1350122987.2": {"sigma_roll_rad": ROLL_RAD},
    "Jupiter n1351469359.2": {"sigma_roll_rad": ROLL_RAD},
    "Jupiter n1354897340.1": {"sigma_roll_rad": ROLL_RAD, "sigma_range": 0.01},
    "Jupiter w1354897340.1": {"sigma_roll_rad": ROLL_RAD},
    "Saturn c3440346.gem": {"sectors_deg": RINGS_FREE_DEG, "sigma_range": 0.003},
    "Saturn c3440346.img": {"sectors_deg": RINGS_FREE_DEG, "sigma_range": 0.02},
    "Saturn N1460002670_1.IMG": {"sectors_deg": ((80.0, 180.0),), "sigma_roll_rad": ROLL_RAD},
    "Mimas N1644787857_1.LBL": {"lit_cosines": (-1.0, -0.5, 0.05)},  # its dark limb shows too
    "Earth hyb2_onc_w2f": {},
}
"""Images whose center comes from the outline, and what is known of each (:class:`real_body_outline.Seen`)."""
IN_ALL = (
    "Vesta 00000000.png",
    "Europa 4600R",
    "Jupiter n1350122987.2",
    "Jupiter w1354897340.1",
    "Saturn c3440346.gem",
    "Saturn N1460002670_1.IMG",
    "Earth hyb2_onc_w2f",
)
"""Images that go through all variants: one of each kind."""
SEEN_AT = {"Saturn c3440346.gem": (618.0, 395.5), "Saturn c3440346.img": (500.5, 313.0)}
"""Places read off the image, px, where the pointing of the kernel is tens of pixels off."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One image and its truth, in camera axes.

    Parameters
    ----------
    name : str
    pixels : (rows, columns), DN
    mask : (rows, columns) bool
        True where nothing was sent or measured.
    camera : Camera
    body : Target
        As it is told, but for:
    shape : Shape
    law : object
    turn : Rotation
        ``camera_from_body`` as the estimators are told.
    sun : (3,) float64
        Direction to the Sun as they are told.
    position_km : (3,) float64, km
        Truth.
    sigma_px : float, px
        Standard deviation of its center; infinite where there is no such body in the image.
    sigma_range : float
        Standard deviation of its range over the range; infinite where it is not known.
    off_px, off_range : (2,) float64, px, and float
        Error of the prediction.
    options : dict
        Options of all estimators that have them.
    """

    name: str
    pixels: NDArray[Any]
    mask: Mask
    camera: Camera
    body: Target
    shape: Shape
    law: Lambert | McEwen
    turn: Rotation
    sun: Float
    position_km: Float
    sigma_px: float
    sigma_range: float
    present: bool = True
    off_px: Float = field(default_factory=lambda: OFF_PX)
    off_range: float = OFF_RANGE
    options: dict[str, float] = field(default_factory=dict)

    @property
    def center_px(self) -> Float:
        """True center (2,), px."""
        return self.camera.model.project(self.position_km)

    @property
    def radius_px(self) -> float:
        """Apparent mean radius, px."""
        return float(self.shape.mean_radius_km / np.linalg.norm(self.position_km) / float(self.camera.ifov_rad()))

    def scene(self) -> Scene:
        """The scene as predicted."""
        place = self.center_px + self.off_px
        apparent = ApparentGeometry(
            position_inertial_km=float(np.linalg.norm(self.position_km))
            * (1.0 + self.off_range)
            * self.camera.model.unproject(place),
            inertial_from_body=self.turn,
            sun_direction_inertial=self.sun,
        )
        smooth = isinstance(self.shape, Ellipsoid)
        target = replace(
            self.body,
            shape=self.shape,
            ephemeris=apparent,
            reflectance=self.law,
            atmosphere=self.body.atmosphere if smooth else None,
            rings=self.body.rings if smooth else None,
        )
        return Scene(targets=(target,))

    def image(self) -> Image:
        """The image in camera axes."""
        return Image(pixels=self.pixels, mask=self.mask, camera_from_inertial=Rotation.identity(), name=self.name)


def frames(data: Path, output: Path) -> list[Frame]:
    """All images with their truth; outlines are measured once and kept in ``outlines.json``."""
    cache = output / "outlines.json"
    known: dict[str, list[float]] = json.loads(cache.read_text()) if cache.exists() else {}
    found = []
    for source in (vesta, europa, jupiter, voyager, cassini_without_geometry, earth, eros):
        for case in source(data):
            found.append(frame_of(case, known))
    cache.write_text(json.dumps(known, indent=1))
    return found


def frame_of(case: Case, known: dict[str, list[float]]) -> Frame:
    """A case and its truth in camera axes; outlines are taken from ``known``, or measured and added to it."""
    geometry = case.scene.geometry(case.image)
    assert not isinstance(geometry, Failure)
    camera, turn, sun = case.camera, geometry.camera_from_body, geometry.sun_direction_camera
    pixels = case.image.pixels
    range_km = geometry.range_km if case.range_km is None else case.range_km
    sight = geometry.position_camera_km / geometry.range_km
    center_px, sigma_px, scale = case.center_px, case.sigma_px, 1.0
    if case.name in OUTLINES:
        if case.name not in known:
            if case.name in SEEN_AT:
                sight = camera.model.unproject(np.array(SEEN_AT[case.name]))
            radii_km = np.array(geometry.target.shape.radii_km)  # type: ignore[attr-defined]
            seen = Seen(
                radii_km=radii_km,
                camera_from_body=turn,
                position_km=range_km * sight,
                sun_camera=sun,
                **OUTLINES[case.name],  # type: ignore[arg-type]
            )
            outline = measured_outline(pixels.astype(np.float64), camera, seen)
            known[case.name] = [*map(float, outline.center_px), outline.sigma_px, outline.scale]
        x, y, sigma_px, scale = known[case.name]
        center_px = np.array([x, y])
    if case.range_km is None:
        range_km /= scale  # the size that the body has in the image; no truth
    if center_px is None:
        center_px = camera.model.project(geometry.position_camera_km)
    frame = Frame(
        name=case.name,
        pixels=pixels,
        mask=case.image.mask,
        camera=camera,
        body=geometry.target,
        shape=geometry.target.shape,
        law=geometry.target.reflectance,  # type: ignore[arg-type]
        turn=turn,
        sun=sun,
        position_km=range_km * camera.model.unproject(center_px),
        sigma_px=sigma_px,
        sigma_range=math.inf if case.range_km is None else case.sigma_range,
        present="rings only" not in case.name,
    )
    return _binned(frame) if frame.body.name == "VESTA" else frame


def _binned(frame: Frame) -> Frame:
    """Vesta in pixels of 2 x 2: a quarter of the time of a frame of 1024 x 1024 that the body fills."""
    rows, columns = (size // 2 for size in frame.pixels.shape)
    mean = frame.pixels[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean(axis=(1, 3))
    mask = frame.mask[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).any(axis=(1, 3))
    camera = frame.camera.binned(2, detector=replace(frame.camera.detector, gain_e_per_dn=4.0, read_noise_e=2.0))
    return replace(frame, pixels=mean.astype(np.float32), mask=mask, camera=camera, sigma_px=0.5 * frame.sigma_px)


def peak_dn(frame: Frame) -> float:
    """Brightness of the body, DN above bias: all but a tenth of as many pixels as it covers are darker."""
    good = frame.pixels[~frame.mask]
    covered = min(math.pi * frame.radius_px**2 / good.size, 1.0)
    return float(np.percentile(good, 100.0 - 10.0 * covered)) - frame.camera.detector.bias_dn


def like(pixels: Float, frame: Frame) -> NDArray[Any]:
    """Pixels in the type of those of a frame."""
    kind = frame.pixels.dtype
    if kind.kind in "iu":
        limits = np.iinfo(kind)
        return np.clip(np.rint(pixels), limits.min, limits.max).astype(kind)
    return pixels.astype(kind)


def with_detector(frame: Frame, **changes: float) -> Camera:
    """The camera of a frame with another detector."""
    return replace(frame.camera, detector=replace(frame.camera.detector, **changes))


def random_of(frame: Frame) -> np.random.Generator:
    """Random numbers that depend on the name alone."""
    return np.random.default_rng(zlib.crc32(frame.name.encode()))


def base(frame: Frame) -> Frame:
    """As it is."""
    return frame


def turned(frame: Frame, quarters: int) -> Frame:
    """Image and geometry turned by so many times 90 degrees, clockwise as seen."""
    for _ in range(quarters):
        model, rows = frame.camera.model, frame.camera.rows
        lens = replace(model, fx_px=model.fy_px, fy_px=model.fx_px, cx_px=rows - 1.0 - model.cy_px, cy_px=model.cx_px)  # type: ignore[call-arg, attr-defined, type-var]
        turn = Rotation.from_rotvec([0.0, 0.0, 0.5 * np.pi])
        frame = replace(
            frame,
            pixels=np.ascontiguousarray(np.rot90(frame.pixels, -1)),
            mask=np.ascontiguousarray(np.rot90(frame.mask, -1)),
            camera=replace(frame.camera, columns=rows, rows=frame.camera.columns, model=lens),
            turn=turn * frame.turn,
            sun=rotate(turn, frame.sun),
            position_km=rotate(turn, frame.position_km),
            off_px=np.array([-frame.off_px[1], frame.off_px[0]]),
        )
    return frame


def misread(frame: Frame, flip: Callable[[NDArray[Any]], NDArray[Any]], columns: bool) -> Frame:
    """Image with its rows (and columns) in the wrong order and the geometry of the right one; the place is right."""
    x, y = frame.center_px
    moved = np.array([frame.camera.columns - 1.0 - x if columns else x, frame.camera.rows - 1.0 - y])
    position = float(np.linalg.norm(frame.position_km)) * frame.camera.model.unproject(moved)
    pixels, mask = (np.ascontiguousarray(flip(one)) for one in (frame.pixels, frame.mask))
    return replace(frame, pixels=pixels, mask=mask, position_km=position)


def cropped(frame: Frame, sign: float) -> Frame | None:
    """A window that cuts off the body half a radius from its center, on the side of the Sun (+1) or the other (-1)."""
    axis = int(np.argmax(np.abs(frame.sun[:2])))
    side = sign * float(np.sign(frame.sun[axis]))
    size = np.array([frame.camera.columns, frame.camera.rows])
    edge = round(float(frame.center_px[axis] + side * 0.5 * frame.radius_px))
    if not 0.25 * size[axis] < (edge if side > 0 else size[axis] - edge) < size[axis] - 4:
        return None
    low = np.zeros(2, dtype=int)
    if side > 0:
        size[axis] = edge
    else:
        low[axis], size[axis] = edge, size[axis] - edge
    camera = frame.camera.windowed(int(low[0]), int(low[1]), columns=int(size[0]), rows=int(size[1]))
    part = slice(low[1], low[1] + size[1]), slice(low[0], low[0] + size[0])
    pixels, mask = (np.ascontiguousarray(one[part]) for one in (frame.pixels, frame.mask))
    return replace(frame, pixels=pixels, mask=mask, camera=camera)


def blurred(frame: Frame, sigma_px: float) -> Frame:
    """Out of focus, which nobody says."""
    return replace(frame, pixels=like(gaussian_filter(frame.pixels.astype(np.float64), sigma_px), frame))


def clipped(frame: Frame, share: float, declared: bool) -> Frame:
    """Saturated at a share of the brightness of the body."""
    limit = frame.camera.detector.bias_dn + share * peak_dn(frame)
    pixels = np.minimum(frame.pixels, like(np.array(limit), frame))
    camera = with_detector(frame, saturation_dn=float(pixels.max())) if declared else frame.camera
    return replace(frame, pixels=pixels, camera=camera)


def noisy(frame: Frame, share: float, declared: bool) -> Frame:
    """With more read noise, a share of the brightness of the body."""
    sigma_dn = share * peak_dn(frame)
    pixels = frame.pixels + sigma_dn * random_of(frame).standard_normal(frame.pixels.shape)
    detector = frame.camera.detector
    noise_e = math.hypot(detector.read_noise_e, sigma_dn * detector.gain_e_per_dn)
    camera = with_detector(frame, read_noise_e=noise_e) if declared else frame.camera
    return replace(frame, pixels=pixels.astype(np.float32), camera=camera)


def as_reflectance(frame: Frame) -> Frame:
    """In units of reflectance: floating point, brightest about 0.5."""
    factor, detector = 0.5 / peak_dn(frame), frame.camera.detector
    camera = with_detector(
        frame,
        gain_e_per_dn=detector.gain_e_per_dn / factor,
        saturation_dn=detector.saturation_dn * factor,
        bias_dn=detector.bias_dn * factor,
    )
    return replace(frame, pixels=(frame.pixels * factor).astype(np.float32), camera=camera)


def sloped(frame: Frame) -> Frame:
    """With a background that rises by a fifth of the brightness of the body over the frame."""
    slope = np.linspace(0.0, 0.2 * peak_dn(frame), frame.camera.columns)
    return replace(frame, pixels=(frame.pixels + slope).astype(np.float32))


def scaled(shape: Shape, factor: float) -> Shape:
    """A shape of another size."""
    if isinstance(shape, Ellipsoid):
        return replace(shape, radii_km=factor * np.array(shape.radii_km))
    assert isinstance(shape, TriangleMesh)
    return TriangleMesh(vertices_km=factor * np.array(shape.vertices_km), faces=np.array(shape.faces), name=shape.name)


def reshaped(frame: Frame, data: Path) -> Frame:
    """Told another body of the same size: Vesta where a planet is, Saturn where Vesta is."""
    saturn = Ellipsoid(radii_km=np.array([60268.0, 60268.0, 54364.0]), name="Saturn")
    other = saturn if frame.body.name == "VESTA" else load_shape(data / "shapes" / "vesta_5002.ply")
    return replace(frame, shape=scaled(other, frame.shape.mean_radius_km / other.mean_radius_km))


def lit_from(frame: Frame, degrees: float) -> Frame:
    """Told a Sun that is turned about the line of sight."""
    turn = Rotation.from_rotvec(math.radians(degrees) * frame.position_km / np.linalg.norm(frame.position_km))
    return replace(frame, sun=rotate(turn, frame.sun))


def predicted(frame: Frame, off_px: tuple[float, float], off_range: float, **declared: float) -> Frame:
    """With a prediction that is further off."""
    return replace(frame, off_px=np.array(off_px), off_range=off_range, options={**frame.options, **declared})


def other_law(frame: Frame) -> Frame:
    """Told another reflectance law."""
    return replace(frame, law=McEwen() if isinstance(frame.law, Lambert) else Lambert())


def tilted(frame: Frame, axis: str) -> Frame:
    """Told an orientation that is 5 degrees off, about the line of sight or across."""
    sight = frame.position_km / np.linalg.norm(frame.position_km)
    vector = sight if axis == "sight" else np.cross(sight, [0.0, 1.0, 0.0])
    return replace(frame, turn=Rotation.from_rotvec(math.radians(5.0) * vector) * frame.turn)


def wide_psf(frame: Frame) -> Frame:
    """Told a point spread function half as wide again."""
    assert frame.camera.psf is not None
    return replace(frame, camera=replace(frame.camera, psf=GaussianPsf(sigma_px=1.5 * frame.camera.psf.sigma_px)))


def variants(data: Path) -> dict[str, Callable[[Frame], Frame | None]]:
    """All variants by name."""
    return {
        "base": base,
        "turned 90": lambda one: turned(one, 1),
        "turned 180": lambda one: turned(one, 2),
        "turned 270": lambda one: turned(one, 3),
        "rows reversed": lambda one: misread(one, np.flipud, False),
        "upside down": lambda one: misread(one, lambda pixels: np.rot90(pixels, 2), True),
        "cut on the lit side": lambda one: cropped(one, 1.0),
        "cut on the dark side": lambda one: cropped(one, -1.0),
        "blurred 1 px": lambda one: blurred(one, 1.0),
        "blurred 2 px": lambda one: blurred(one, 2.0),
        "clipped 70 %, declared": lambda one: clipped(one, 0.7, True),
        "clipped 70 %": lambda one: clipped(one, 0.7, False),
        "clipped 50 %, declared": lambda one: clipped(one, 0.5, True),
        "clipped 50 %": lambda one: clipped(one, 0.5, False),
        "noise 10 %, declared": lambda one: noisy(one, 0.1, True),
        "noise 10 %": lambda one: noisy(one, 0.1, False),
        "reflectance units": as_reflectance,
        "sloped background": sloped,
        "size +10 %": lambda one: replace(one, shape=scaled(one.shape, 1.1)),
        "size -8 %": lambda one: replace(one, shape=scaled(one.shape, 0.92)),
        "another shape": lambda one: reshaped(one, data),
        "Sun turned 180": lambda one: lit_from(one, 180.0),
        "Sun turned 30": lambda one: lit_from(one, 30.0),
        "off 20 px, 2.5 %": lambda one: predicted(one, (-16.0, 12.0), 0.025),
        "off 36 px, -2.5 %": lambda one: predicted(one, (30.0, -20.0), -0.025),
        "off 80 px, 5 %": lambda one: predicted(one, (60.0, 53.0), 0.05),
        "off 80 px, 5 %, declared": lambda one: predicted(
            one, (60.0, 53.0), 0.05, search_px=110, search_range=0.08, range_sigma=0.05
        ),
        "other law": other_law,
        "rolled 5": lambda one: tilted(one, "sight"),
        "pole 5": lambda one: tilted(one, "across"),
        "psf 1.5 times": wide_psf,
    }


def configured(name: str, wanted: dict[str, float]) -> Any:
    """An estimator with those of the options that it, or what it chooses from, has."""
    estimator = ESTIMATORS[name]()
    return ESTIMATORS[name](_with(estimator.options, wanted))


def _with(options: Any, wanted: dict[str, float]) -> Any:
    changes: dict[str, Any] = {}
    for one in dataclasses.fields(options):
        now = getattr(options, one.name)
        if dataclasses.is_dataclass(now):
            changes[one.name] = _with(now, wanted)
        elif one.name in wanted:
            changes[one.name] = wanted[one.name]
    return replace(options, **changes)


class _Told:
    """An estimator that gives what it gave before."""

    name: ClassVar[str] = "told"
    options = None

    def __init__(self, outcome: CenterFix | Failure) -> None:
        self._outcome = outcome

    def estimate(self, image: Image, camera: Camera, scene: Scene, target: str | None = None) -> CenterFix | Failure:
        return self._outcome


class _SharedAuto(Auto):
    """Auto that does not run again what has been run on the same frame."""

    def __init__(self, options: AutoOptions, outcomes: dict[str, CenterFix | Failure]) -> None:
        super().__init__(options)
        self._outcomes = outcomes

    def _estimator(self, name: str) -> Estimator:
        return _Told(self._outcomes[name]) if name in self._outcomes else super()._estimator(name)


def judged(frame: Frame, name: str, outcomes: dict[str, CenterFix | Failure]) -> dict[str, Any]:
    """What an estimator makes of a frame, against the truth; outcomes are added to, for ``auto`` to use them."""
    started = time.process_time()
    estimator = configured(name, frame.options)
    if name == Auto.name:
        estimator = _SharedAuto(estimator.options, outcomes)
    fix = estimator.estimate(frame.image(), frame.camera, frame.scene())
    outcomes[name] = fix
    row: dict[str, Any] = {"image": frame.name, "estimator": name, "cpu_s": round(time.process_time() - started, 2)}
    if isinstance(fix, Failure):
        return row | {"status": "failed", "reason": str(fix.reason), "detail": fix.detail.split(": ", 3)[-1]}
    row["status"] = "suspect" if fix.flags.suspect else "ok"
    row["flags"] = list((fix.flags & Quality.SUSPECT).names())
    row |= {key: text for key, text in fix.findings.texts.items() if key in ("chosen", "checked_by")}
    error = fix.center_px - frame.center_px
    total = fix.covariance_px2 + frame.sigma_px**2 * np.eye(2)
    row |= {
        "error_px": [round(float(one), 3) for one in error],
        "sigma_px": [round(float(one), 3) for one in np.sqrt(np.diag(fix.covariance_px2))],
        "off": math.sqrt(float(error @ np.linalg.solve(total, error))) if frame.present else math.inf,
    }
    if isinstance(fix, PositionFix) and math.isfinite(frame.sigma_range):
        true_km = float(np.linalg.norm(frame.position_km))
        row["range_error"] = fix.range_km / true_km - 1.0
        row["sigma_range"] = fix.sigma_range_km / fix.range_km
        row["range_off"] = row["range_error"] / math.hypot(row["sigma_range"], frame.sigma_range)
    row["worst"] = max(row["off"], abs(row.get("range_off", 0.0)))
    return row


_FRAMES: list[Frame] = []


def _task(job: tuple[int, str, str]) -> list[dict[str, Any]]:
    number, variant, data = job
    frame = _variants(data)[variant](_FRAMES[number])
    if frame is None:
        return []
    outcomes: dict[str, CenterFix | Failure] = {}
    return [{"variant": variant, **judged(frame, name, outcomes)} for name in NAMES]


@lru_cache(maxsize=1)
def _variants(data: str) -> dict[str, Callable[[Frame], Frame | None]]:
    return variants(Path(data))


@contextmanager
def _pool(processes: int) -> Iterator[Callable[..., Iterable[list[dict[str, Any]]]]]:
    """A ``map`` over so many processes; the built-in one where one is enough."""
    if processes == 1:
        yield map
        return
    with ProcessPoolExecutor(processes, mp_context=get_context("fork")) as pool:
        yield pool.map


def run(
    data: Path, output: Path, *, only: Iterable[str] = (), images: str = "", processes: int = 2, every: bool = False
) -> list[dict[str, Any]]:
    """Run variants on images; all of them by default."""
    output.mkdir(parents=True, exist_ok=True)
    _FRAMES[:] = [frame for frame in frames(data, output) if images.lower() in frame.name.lower()]
    names = [name for name in variants(data) if not only or name in only]
    jobs = [
        (number, name, str(data))
        for index, name in enumerate(names)
        for number, frame in enumerate(_FRAMES)
        if every or name == "base" or frame.name in IN_ALL or (index + number) % 3 == 0
    ]
    found: list[dict[str, Any]] = []
    with (output / "variants.jsonl").open("w") as lines, _pool(processes) as each:
        for rows in each(_task, jobs):
            found += rows
            lines.writelines(json.dumps(row) + "\n" for row in rows)
            lines.flush()
    return found


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--only", default="", help="names of variants, by semicolons")
    parser.add_argument("--images", default="", help="part of the names of images")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--all", action="store_true", help="every image in every variant")
    given = parser.parse_args()
    only = [one.strip() for one in given.only.split(";") if one.strip()]
    rows = run(given.data, given.output, only=only, images=given.images, processes=given.processes, every=given.all)
    (given.output / "variants.json").write_text(json.dumps(rows, indent=1))
    text = report(rows)
    (given.output / "variants.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
