"""Maplets of stereophotoclinometry (SPC): binary files of heights and albedo, MAPFILES/NAME.MAP."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike._system.reading import check, reads
from giantlike.shapes.local_map import LocalMap

_RECORD = 72  # bytes before the pixels [1]_ of read_maplet
_ALBEDO_STEP = 0.01  # of the stored albedo, same source
_MAX_HALF_SIZE = 4096  # bounds the memory that a damaged header can request
_SKEW = 1e-3  # axes in single precision are perpendicular to 1e-7; more is damage


@reads("an SPC maplet")
def read_maplet(path: Path) -> LocalMap:
    """Read an SPC maplet.

    The result has NaN where the file has no height.

    Bytes count from 1. Of the first 72: 7-10 the scale, km per pixel; 11-12 the half size q, of 2q + 1 by 2q + 1
    pixels, its low byte first; 16-27 the position of the middle, km, body-fixed; 28-39, 40-51, 52-63 the unit vectors
    Ux, Uy, Uz; 64-67 the step of the heights; floats are single precision, high byte first. Then three bytes for each
    pixel: height over its step (signed, high byte first) and albedo times 100; albedo 0 means that there is nothing.
    Heights are in units of the scale. Pixels run along Uy first, then along Ux [2]_ [3]_.

    References
    ----------
    .. [1] Palmer, Campbell, Mittan: SPC wiki, "MAPFILES", https://web.psi.edu/spc_wiki/MAPFILES.
    .. [2] Palmer: SPC-Web-tools, phasei.f (reads and writes maplets), https://github.com/ericepalmer/SPC-Web-tools.
    .. [3] NASA GIANT: giant/utilities/stereophotoclinometry.py, which takes pixels in the same order.
    """
    content = path.read_bytes()
    check(len(content) >= _RECORD, f"needed at least {_RECORD} bytes, got {len(content)}")
    if content.startswith(b"DOUBLE"):
        raise ValueError("it is in double precision by its first bytes: maplets are in single precision")
    (scale_km,) = struct.unpack_from(">f", content, 6)
    (half,) = struct.unpack_from("<H", content, 10)
    numbers = np.array(struct.unpack_from(">13f", content, 15))
    center, axes, step = numbers[:3], numbers[3:12].reshape(3, 3).T, float(numbers[12])
    if not (np.isfinite(numbers).all() and np.isfinite(scale_km) and scale_km > 0.0 and 1 <= half <= _MAX_HALF_SIZE):
        raise ValueError(f"no maplet has a scale of {scale_km:g} km, half size {half}, or a number that is not finite")
    if np.abs(axes.T @ axes - np.eye(3)).max() > _SKEW or np.linalg.det(axes) < 0.0:
        raise ValueError("its axes are not three orthogonal unit vectors, right-handed")
    grid = _pixels(content, 2 * half + 1)
    known = grid["albedo"] > 0
    return LocalMap(
        center_body_km=center,
        body_from_map=Rotation.from_matrix(axes),
        heights_km=np.where(known, grid["height"].astype(np.float64) * step * scale_km, np.nan),
        spacing_km=float(scale_km),
        albedo=np.where(known, grid["albedo"] * _ALBEDO_STEP, 1.0),
        name=path.stem,
    )


def _pixels(content: bytes, side: int) -> NDArray[np.void]:
    """Heights and albedo (side, side): rows along y = Uy, columns along x = Ux."""
    needed = _RECORD + 3 * side * side
    check(len(content) >= needed, f"needed {side} x {side} pixels, {needed} bytes, got {len(content)}")
    pixels = np.frombuffer(content, dtype=[("height", ">i2"), ("albedo", "u1")], count=side * side, offset=_RECORD)
    return pixels.reshape(side, side).T
