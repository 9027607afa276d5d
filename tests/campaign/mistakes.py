"""Mistakes that users make in a campaign of a flyby, one at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.time import time_from_et, utc_text
from tests.campaign.flyby import EXPOSURE_S, FOV_DEG, K1, RADII_KM, Change, Session, flyby_camera

J2000_FROM_ECLIPTIC = Rotation.from_euler("x", 23.4392911, degrees=True)
"""Obliquity of the ecliptic at J2000, as IAU 1976 and SPICE have it."""


def _radii(factor: float) -> Change:
    return lambda one: one.target.update(shape={"radii_km": [factor * radius for radius in RADII_KM]})


def _ecliptic(one: Session) -> None:
    one.turn_attitudes(lambda attitude: attitude * J2000_FROM_ECLIPTIC)


def _lost(one: Session) -> None:
    _ecliptic(one)
    one.table["stars"]["lost_in_space"] = True


def _roll(one: Session) -> None:
    one.turn_attitudes(lambda attitude: Rotation.from_euler("z", 90.0, degrees=True) * attitude)


def _dates(scale: str, said: str) -> Change:
    def change(one: Session) -> None:
        for name, header in one.headers.items():
            epoch = time_from_et(one.flyby.epochs_et[name])
            text = str(epoch.tdb.isot) if scale == "TDB" else utc_text(epoch)
            del header["DATE-OBS"]
            header.update({"TIMESYS": said, "DATE-AVG": text})

    return change


def _milliseconds(one: Session) -> None:
    for header in one.headers.values():
        header["EXPTIME"] = 1000.0 * EXPOSURE_S


def _middle(one: Session) -> None:
    for name, header in one.headers.items():
        header["DATE-OBS"] = utc_text(time_from_et(one.flyby.epochs_et[name]))


def _no_attitude(one: Session) -> None:
    for header in one.headers.values():
        for key in [key for key in header if key.startswith("GL_Q")]:
            del header[key]


def _late(one: Session) -> None:
    for name, header in one.headers.items():
        header["DATE-OBS"] = utc_text(time_from_et(one.flyby.epochs_et[name] + 10 * 86400.0))


def _no_pck_radii(one: Session) -> None:
    one.without_kernel("constants.tpc")
    one.target["shape"] = {"radii": "pck"}


def _spice(**changes: Any) -> Change:
    return lambda one: one.table["spice"].update(changes)


def _target(**changes: Any) -> Change:
    return lambda one: one.target.update(changes)


def _uncertainty(**changes: Any) -> Change:
    return lambda one: one.target.setdefault("uncertainty", {}).update(changes)


def _sigma(value: float) -> Change:
    return lambda one: one.table["images"].update(attitude_sigma_deg=value)


def _focal(factor: float) -> Change:
    def change(one: Session) -> None:
        fov = 2.0 * np.degrees(np.arctan(np.tan(np.radians(FOV_DEG) / 2.0) / factor))
        one.camera = flyby_camera(float(fov))

    return change


def _radians(one: Session) -> None:
    one.camera = flyby_camera(float(np.radians(FOV_DEG)))


def _wrong_k1(one: Session) -> None:
    one.camera = flyby_camera(k1=-K1)


def _upside_down(one: Session) -> None:
    one.pixels = {name: pixels[::-1].copy() for name, pixels in one.pixels.items()}


def _wrong_body(one: Session) -> None:
    one.target.update(name="DIONE")


def _far(one: Session) -> None:
    one.with_spk(craft_scale=1000.0)


def _moved(one: Session) -> None:
    one.with_spk(craft_shift_km=300.0)
    one.target["uncertainty"] = {"ephemeris_km": 30.0}


MISTAKES: dict[str, Change | None] = {
    "baseline": None,
    "radii_km in m": _radii(1000.0),
    "radii in Mm": _radii(0.001),
    "attitude header in ECLIPJ2000": _ecliptic,
    "same, lost_in_space": _lost,
    "quaternion inverse": lambda one: one.turn_attitudes(lambda attitude: attitude.inv()),
    "quaternion scalar first": Session.reorder_quaternions,
    "camera rolled 90 deg in header": _roll,
    "DATE-AVG TDB, TIMESYS UTC": _dates("TDB", "UTC"),
    "DATE-AVG TDB, TIMESYS TDB": _dates("TDB", "TDB"),
    "EXPTIME in ms": _milliseconds,
    "DATE-OBS is really mid, no comment": _middle,
    "no a priori attitude at all, no lost_in_space": _no_attitude,
    "epoch outside the SPK": _late,
    "no leapseconds kernel": lambda one: one.without_kernel("leap.tls"),
    "no PCK": lambda one: one.without_kernel("constants.tpc"),
    'radii "pck", no PCK': _no_pck_radii,
    "no spacecraft SPK": lambda one: one.without_kernel("flyby.bsp"),
    "kernel file missing": lambda one: one.table["spice"]["kernels"].append("gone.bsp"),
    "unknown spacecraft name": _spice(spacecraft="PROBBE"),
    "spacecraft id of another": _spice(spacecraft="-82"),
    "target not in kernels": _target(name="PHOEBE", shape={"radii_km": [109.0, 108.0, 101.0]}),
    "target misspelled": _target(name="RHEIA"),
    "target name valid but wrong body": _wrong_body,
    "SPK in ECLIPJ2000 labelled J2000": lambda one: one.with_spk(craft_turn=J2000_FROM_ECLIPTIC.inv()),
    "SPK in m": _far,
    "focal 2x too small": _focal(0.5),
    "fov_deg in rad": _radians,
    "k1 wrong sign": _wrong_k1,
    "rows upside down": _upside_down,
    "scale uncertainty in percent": _uncertainty(scale=0.5),
    "attitude_sigma in arcsec": _sigma(72.0),
    "attitude_sigma in rad": _sigma(3.5e-4),
    "ephemeris_km in m": _uncertainty(ephemeris_km=400000.0),
    "ephemeris 10x too small": _moved,
    "negative scale": _uncertainty(scale=-0.01),
    "max_magnitude 3": lambda one: one.table["stars"].update(max_magnitude=3.0),
    "frame of another body": _target(frame="IAU_SATURN"),
    "frame misspelled": _target(frame="IAU_RHEIA"),
}
