"""Reader of UCAC4: binary zone files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from giantlike._system.reading import reads
from giantlike.catalogs.readers.rows import ReadStars, rms, stars_of
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError

RECORD = np.dtype(
    [
        ("ra", "<i4"), ("spd", "<i4"), ("magm", "<u2"), ("maga", "<u2"), ("sigmag", "u1"), ("objt", "u1"),
        ("cdf", "u1"), ("sigra", "i1"), ("sigdc", "i1"), ("na1", "u1"), ("nu1", "u1"), ("cu1", "u1"),
        ("cepra", "<u2"), ("cepdc", "<u2"), ("pmrac", "<i2"), ("pmdc", "<i2"), ("sigpmr", "i1"), ("sigpmd", "i1"),
        ("pts_key", "<u4"), ("jhk_m", "<u2", 3), ("icqflg", "u1", 3), ("e2mpho", "u1", 3), ("apasm", "<u2", 5),
        ("apase", "i1", 5), ("gcflg", "u1"), ("icf", "<u4"), ("leda", "u1"), ("x2m", "u1"), ("rnm", "<u4"),
        ("zn2", "<u2"), ("rn2", "<u4"),
    ]
)  # fmt: skip
"""Record of one star, 78 bytes: readme of UCAC4 (CDS I/322A)."""
NO_MAGNITUDE, FAST = 20000, 32767
"""Values that stand for no magnitude, and for a proper motion that is in ``u4hpm.dat`` (same readme)."""
_LARGE_ERRORS = np.concatenate([np.arange(251), [275, 325, 375, 425, 500]]).astype(np.float64)
"""Errors of proper motion, 0.1 mas/yr, by the stored number plus 128 (``ucac4.c`` [2]_ of ``read_ucac4``)."""


@reads("a UCAC4 zone file")
def read_ucac4(path: Path, *, max_magnitude: float | None = None) -> ReadStars:
    """Read one zone file, ``z001`` to ``z900``; magnitudes are about Johnson V.

    A zone file consists of records of 78 bytes, little endian: right ascension and south pole distance in mas
    (ICRS, epoch J2000), magnitudes in mmag with 20000 for none, proper motions in 0.1 mas/yr, standard errors offset
    by 128. The magnitude is V from APASS where there is one, else the model or aperture magnitude of UCAC4, whose
    band is between V and R: red stars are then some tenths too bright. Errors of position, given at the mean epochs,
    are propagated to J2000. Proper motions of the about 30 fastest stars are in ``u4hpm.dat``, searched next to the
    zone file and in a folder ``u4i`` next to its folder. Identifiers are ``zone * 1,000,000 + record``, as in the name
    UCAC4-zzz-rrrrrr. Stars with a double star flag are double.

    References
    ----------
    .. [1] Zacharias et al., readme of UCAC4 (CDS I/322A): record format, as reproduced in public readers.
    .. [2] ``ucac4.h`` and ``ucac4.c`` of github.com/Bill-Gray/star_cats: types, offset by 128, coding of large errors.
    """
    match = re.fullmatch(r"z(\d{3})", path.name.lower().removesuffix(".dat"))
    if match is None or not 1 <= int(match[1]) <= 900:
        raise DataError(path, "is not a UCAC4 zone file: the name must be z001 to z900, the number of the zone")
    size = path.stat().st_size
    if size == 0 or size % RECORD.itemsize:
        raise ValueError(f"expected records of {RECORD.itemsize} bytes, got {size} bytes")
    records = np.fromfile(path, dtype=RECORD)
    pm = _proper_motions(path, records)
    sigma_pm = [0.1 * _LARGE_ERRORS[records[name].astype(np.int64) + 128] for name in ("sigpmr", "sigpmd")]
    years = [2000.0 - (1900.0 + 0.01 * records[name]) for name in ("cepra", "cepdc")]
    errors = [records[name].astype(np.float64) + 128.0 for name in ("sigra", "sigdc")]
    at_2000 = [np.hypot(e, s * y) for e, s, y in zip(errors, sigma_pm, years, strict=True)]
    b, v = (_magnitude(records["apasm"][:, k]) for k in (0, 1))
    model, aperture = _magnitude(records["magm"]), _magnitude(records["maga"])
    columns = {
        "ids": int(match[1]) * 1_000_000 + 1 + np.arange(len(records)),
        "ra_deg": records["ra"] / 3.6e6,
        "dec_deg": records["spd"] / 3.6e6 - 90.0,
        "pm_ra_mas_yr": pm[0],
        "pm_dec_mas_yr": pm[1],
        "magnitude": np.where(np.isfinite(v), v, np.where(np.isfinite(model), model, aperture)),
        "color_bv": b - v,
        "sigma_mas": rms(at_2000[0], at_2000[1]),
        "sigma_pm_mas_yr": rms(sigma_pm[0], sigma_pm[1]),
        "is_double": (records["cdf"] != 0).astype(np.float64),
    }
    return stars_of(columns, band="V", record=lambda row: f"record {row + 1}", max_magnitude=max_magnitude)


def zone_files(path: Path) -> list[Path]:
    """Zone files of a folder."""
    if not path.is_dir():
        return [path]
    return sorted(file for file in path.iterdir() if re.fullmatch(r"z\d{3}", file.name.lower()))


def _magnitude(millimagnitudes: NDArray[np.uint16]) -> Float:
    """Magnitudes (n,), NaN where there is none."""
    return np.where(millimagnitudes >= NO_MAGNITUDE, np.nan, millimagnitudes / 1000.0)


def _proper_motions(path: Path, records: NDArray[np.void]) -> Float:
    """Proper motions (2, n), mas/yr."""
    pm = np.stack([records["pmrac"], records["pmdc"]]).astype(np.float64)
    fast = np.flatnonzero((pm == FAST).any(axis=0))
    if fast.size:
        known = _fast_stars(path)
        for row in fast:
            number = int(records["rnm"][row])
            if number not in known:
                raise DataError(path, f"record {row + 1}: star {number} is fast, but u4hpm.dat does not have it")
            pm[:, row] = known[number]
    return 0.1 * pm


def _fast_stars(path: Path) -> dict[int, tuple[float, float]]:
    """Proper motions of the fast stars by their unique number: columns rnm, zn, rnz, pmrc, pmd, ..., 0.1 mas/yr."""
    places = [path.parent / "u4hpm.dat", path.parent / "u4i" / "u4hpm.dat", path.parent.parent / "u4i" / "u4hpm.dat"]
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise DataError(path, f"holds fast stars, whose proper motions are in u4hpm.dat: copy that file to {places[0]}")
    known = {}
    for number, line in enumerate(file.read_text(errors="replace").splitlines(), start=1):
        words = line.split()
        try:
            if words:
                known[int(words[0])] = (float(words[3]), float(words[4]))
        except (ValueError, IndexError) as error:
            raise DataError(file, f"line {number}: expected numbers rnm zn rnz pmrc pmd ..., got {line!r}") from error
    return known
