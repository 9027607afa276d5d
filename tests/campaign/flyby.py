"""A flyby of Rhea with kernels made for it: three images with stars, a campaign file, and one mistake at a time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import spiceypy
import tomli_w
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.catalogs import load_catalog
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.frames import quaternion_xyzw
from giantlike.core.photometry import Photometry
from giantlike.core.time import et_from_time, time_from_et, time_from_utc, utc_text
from giantlike.ephemeris import BARYCENTER, SpiceEphemeris
from giantlike.image import ObserverState
from giantlike.io.fits import write_fits
from giantlike.io.fits_keywords import QUATERNION_KEYS
from giantlike.io.spice import load_kernels, spk_state
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid
from giantlike.simulation import Shot, Sources, simulate_image

RADII_KM = (765.0, 763.1, 762.4)
COLUMNS, FOV_DEG, EXPOSURE_S, SPACING_S = 400, 5.0, 2.0, 400.0
DETECTOR = Detector(gain_e_per_dn=1.0, read_noise_e=5.0, saturation_dn=60000.0, bias_dn=100.0)
ZERO_POINT_E_S = 1.5e6
APRIORI_DEG = 0.02
K1 = -0.5
"""Of the lens: 1.1 px in the corners."""
START_ET = et_from_time(time_from_utc("2010-03-02T12:00:00"))
RNG_SEED = 20100302
CRAFT, OTHER_CRAFT = -990, -991
"""Two spacecraft: PROBE and, on the other side of Saturn, RELAY."""
_SATURN_KM, _SATURN_KM_S = np.array([-1.42e9, 1.0e8, 1.0e8]), np.array([-1.2, -9.4, -3.8])
_RHEA_KM, _RHEA_KM_S = np.array([5.2e5, 7.0e4, -2.0e4]), np.array([-1.1, 8.3, 0.8])
_DIONE_KM, _DIONE_KM_S = np.array([-3.1e5, 2.1e5, 3.0e4]), np.array([-5.5, -8.2, 0.7])
_CRAFT_KM, _CRAFT_KM_S = np.array([6.1e5, 1.3e5, 2.5e4]), np.array([-5.0, 3.0, 2.0])

_LEAP = """KPL/LSK
\\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K = 1.657D-3
DELTET/EB = 1.671D-2
DELTET/M = ( 6.239996D0 1.99096871D-7 )
DELTET/DELTA_AT = ( 33, @2006-JAN-1 34, @2009-JAN-1 )
\\begintext
"""
_NAMES = f"""KPL/FK
\\begindata
NAIF_BODY_NAME += ( 'PROBE', 'RELAY' )
NAIF_BODY_CODE += ( {CRAFT}, {OTHER_CRAFT} )
\\begintext
"""
_CONSTANTS = """KPL/PCK
\\begindata
BODY605_RADII = ( 765.0 763.1 762.4 )
BODY605_POLE_RA = ( 40.38 -0.036 0.0 )
BODY605_POLE_DEC = ( 83.55 -0.004 0.0 )
BODY605_PM = ( 235.16 79.69 0.0 )
BODY604_RADII = ( 563.4 561.3 559.6 )
BODY604_POLE_RA = ( 40.66 -0.036 0.0 )
BODY604_POLE_DEC = ( 83.52 -0.004 0.0 )
BODY604_PM = ( 357.6 131.53 0.0 )
BODY699_RADII = ( 60268.0 60268.0 54364.0 )
BODY699_POLE_RA = ( 40.589 -0.036 0.0 )
BODY699_POLE_DEC = ( 83.537 -0.004 0.0 )
BODY699_PM = ( 38.9 810.79 0.0 )
\\begintext
"""
KERNELS = {"leap.tls": _LEAP, "names.tf": _NAMES, "constants.tpc": _CONSTANTS}


def flyby_camera(fov_deg: float = FOV_DEG, k1: float = K1) -> Camera:
    camera = Camera.from_fov(fov_deg, COLUMNS, COLUMNS, type_name="brown")
    values = dict(zip(camera.model.parameter_names, camera.model.parameters.tolist(), strict=True)) | {"k1": k1}
    model = camera.model.with_parameters(list(values.values()))
    return dataclasses.replace(camera, model=model, psf=GaussianPsf(sigma_px=0.9), detector=DETECTOR)


def write_spk(
    path: Path, *, craft_scale: float = 1.0, craft_turn: Rotation | None = None, craft_shift_km: float = 0.0
) -> None:
    """States of Sun, Saturn, two moons and two spacecraft, along straight lines over a day."""
    turn = Rotation.identity() if craft_turn is None else craft_turn
    craft = [craft_scale * turn.apply(vector) for vector in (_CRAFT_KM, _CRAFT_KM_S)]
    craft[0] = craft[0] + craft_shift_km * np.array([0.0, 0.0, 1.0])
    handle = spiceypy.spkopn(str(path), "made up", 0)
    times = START_ET + np.linspace(-43200.0, 43200.0, 25)
    rows: list[tuple[int, int, Float, Float]] = [
        (10, 0, np.zeros(3), np.zeros(3)),
        (6, 0, _SATURN_KM, _SATURN_KM_S),
        (699, 6, np.zeros(3), np.zeros(3)),
        (605, 6, _RHEA_KM, _RHEA_KM_S),
        (604, 6, _DIONE_KM, _DIONE_KM_S),
        (CRAFT, 6, craft[0], craft[1]),
        (OTHER_CRAFT, 6, -_CRAFT_KM, -_CRAFT_KM_S),
    ]
    for body, center, position, velocity in rows:
        states = np.hstack([position + np.outer(times - START_ET, velocity), np.tile(velocity, (len(times), 1))])
        spiceypy.spkw09(
            handle, body, center, "J2000", times[0], times[-1], f"body {body}", 3, len(times), states, times.tolist()
        )
    spiceypy.spkcls(handle)


@dataclasses.dataclass(frozen=True)
class Flyby:
    """Images of a flyby, and the data of their headers.

    pixels: by name; attitudes: a priori; epochs_et: middle of the exposure.
    """

    folder: Path
    pixels: dict[str, NDArray[Any]]
    attitudes: dict[str, Rotation]
    epochs_et: dict[str, float]


def make_flyby(folder: Path) -> Flyby:
    """Write the kernels and the camera, and simulate the images."""
    for name, text in KERNELS.items():
        (folder / name).write_text(text)
    write_spk(folder / "flyby.bsp")
    camera = flyby_camera()
    camera.save(folder / "camera.toml")
    scene = Scene(
        targets=(
            Target(
                name="RHEA",
                shape=Ellipsoid(radii_km=np.array(RADII_KM), name="RHEA"),
                ephemeris=SpiceEphemeris("RHEA", "IAU_RHEA", BARYCENTER),
            ),
        ),
        observer=SpiceEphemeris("PROBE", origin=BARYCENTER),
        light=SpiceEphemeris("SUN", origin=BARYCENTER),
    )
    sources = Sources(
        scene=scene,
        catalog=load_catalog("default"),
        photometry=Photometry(zero_point_e_s=ZERO_POINT_E_S),
        albedo=1e-4,
        sun_distance_au=9.5,
    )
    made = Flyby(folder, {}, {}, {})
    random = np.random.default_rng(RNG_SEED)
    with load_kernels([folder / name for name in (*KERNELS, "flyby.bsp")], "."):
        for number in range(3):
            name, et = f"rhea{number}.fits", START_ET + SPACING_S * number
            ahead = unit_to(spk_state("RHEA", et, observer="PROBE")[0])
            aside = Rotation.from_rotvec(np.radians([0.6 - 0.3 * number, 0.5, 0.0]))
            true = aside * pointing_at(ahead)
            position, velocity = spk_state("PROBE", et, observer=BARYCENTER)
            shot = Shot(
                name=name,
                epoch=time_from_et(et),
                exposure_s=EXPOSURE_S,
                camera_from_inertial=true,
                observer=ObserverState(position_km=position, velocity_km_s=velocity),
            )
            made.pixels[name] = simulate_image(shot, camera, sources, seed=number).image.pixels
            error = np.radians(APRIORI_DEG) * random.normal(size=3)
            made.attitudes[name] = Rotation.from_rotvec(error) * true
            made.epochs_et[name] = et
    return made


def unit_to(vector: Float) -> Float:
    return vector / np.linalg.norm(vector)


def pointing_at(direction: Float) -> Rotation:
    """Attitude of a camera whose boresight has this direction, its columns along no special one."""
    across = unit_to(np.cross([0.2, 0.5, 0.8], direction))
    return Rotation.from_matrix(np.array([across, np.cross(direction, across), direction]))


@dataclasses.dataclass
class Session:
    """Inputs of a campaign before they are written: a mistake changes them.

    table: of the campaign file; headers: by image; camera: of the camera file.
    """

    folder: Path
    flyby: Flyby
    table: dict[str, Any]
    headers: dict[str, dict[str, Any]]
    pixels: dict[str, NDArray[Any]]
    camera: Camera

    @property
    def target(self) -> dict[str, Any]:
        """Table of the only target."""
        return self.table["targets"][0]  # type: ignore[no-any-return]

    def without_kernel(self, name: str) -> None:
        """Leave out a kernel."""
        self.table["spice"]["kernels"] = [path for path in self.table["spice"]["kernels"] if not path.endswith(name)]

    def with_spk(self, **changes: Any) -> None:
        """Replace the trajectories."""
        self.without_kernel("flyby.bsp")
        write_spk(self.folder / "other.bsp", **changes)
        self.table["spice"]["kernels"].append("other.bsp")

    def turn_attitudes(self, change: Callable[[Rotation], Rotation]) -> None:
        """Replace the a priori attitudes of the headers."""
        for name, header in self.headers.items():
            header.update(attitude_cards(change(self.flyby.attitudes[name])))

    def reorder_quaternions(self) -> None:
        """Write the scalar first."""
        for header in self.headers.values():
            x, y, z, w = (header[key] for key in QUATERNION_KEYS)
            header.update(zip(QUATERNION_KEYS, (w, x, y, z), strict=True))


Change = Callable[[Session], Any]


def attitude_cards(attitude: Rotation) -> dict[str, float]:
    return dict(zip(QUATERNION_KEYS, quaternion_xyzw(attitude).tolist(), strict=True))


def write_session(flyby: Flyby, folder: Path, change: Change | None = None, *, images: int = 3) -> Path:
    """Write the images and the campaign file with a mistake; returns the campaign file."""
    folder.mkdir(exist_ok=True)
    names = list(flyby.pixels)[:images]
    headers: dict[str, dict[str, Any]] = {}
    for name in names:
        start = time_from_et(flyby.epochs_et[name] - EXPOSURE_S / 2.0)
        dates = {"TIMESYS": "UTC", "DATE-OBS": utc_text(start), "EXPTIME": EXPOSURE_S}
        headers[name] = dates | attitude_cards(flyby.attitudes[name])
    table: dict[str, Any] = {
        "campaign": {"name": "flyby", "output": "run"},
        "images": {"files": names, "attitude_sigma_deg": APRIORI_DEG},
        "camera": {"file": "camera.toml"},
        "spice": {"kernels": [str(flyby.folder / name) for name in (*KERNELS, "flyby.bsp")], "spacecraft": "PROBE"},
        "stars": {"options": {"all_stars": True}},
        "targets": [{"name": "RHEA", "shape": {"radii_km": list(RADII_KM)}, "estimators": ["limb_matching"]}],
        "report": {"max_overlays": 0},
    }
    session = Session(folder, flyby, table, headers, {name: flyby.pixels[name] for name in names}, flyby_camera())
    if change is not None:
        change(session)
    session.camera.save(folder / "camera.toml")
    for name, header in session.headers.items():
        write_fits(folder / name, session.pixels[name], header=header)
    path = folder / "campaign.toml"
    path.write_text(tomli_w.dumps(session.table))
    return path
