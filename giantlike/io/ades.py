"""ADES files of the Minor Planet Center: optical astrometry from a spacecraft, in XML and PSV, version 2022.

Elements, their order and their widths follow the submission schema of ``iau-ades`` 0.1.3. Texts are as short as both
that schema and its newer form of November 2025 allow.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from giantlike._system.atomic import write_text_atomic
from giantlike.core.arrays import Float, as_floats, require, require_number
from giantlike.core.values import Value

STAR_CATALOGS = ("Gaia3E", "Gaia3", "Gaia2", "Gaia1", "Hip2", "Hip", "Tyc2", "UCAC4", "URAT1")
"""Names of star catalogs that the Minor Planet Center lists (November 2026) and that users of this package have."""
_OBJECT = {
    "permID": r"\d+([IPD](-[A-Z]{1,2})?)?|(Mars|Jupiter|Saturn|Uranus|Neptune) \d{1,3}|\(\d+\) \d{1,3}",
    "provID": (
        r"\d{4} [A-HJ-Y][A-HJ-Z]\d*|\d{4} (P-L|T-[123])|[ADCPX]/\d{4} [A-Z]{1,2}\d*(-[A-Z])?"
        r"|A[89]\d{2} [A-HJ-Y][A-HJ-Z]"
    ),
    "trkSub": r"[-A-Za-z0-9_]{1,8}",
}
_ORDER = (
    *_OBJECT,
    *("mode", "stn", "sys", "ctr", "pos1", "pos2", "pos3", "vel1", "vel2", "vel3"),
    *("posCov11", "posCov12", "posCov13", "posCov22", "posCov23", "posCov33", "obsTime", "rmsTime"),
    *("ra", "dec", "rmsRA", "rmsDec", "rmsCorr", "astCat", "exp", "nStars", "remarks"),
)
_UTC = re.compile(r"\d{4}-\d{2}-\d{2}T\d{2}:\d{2}:\d{2}(\.\d{1,6})?")


@dataclass(frozen=True, slots=True, kw_only=True)
class AdesContext:
    """Observatory, people and telescope of a submission."""

    station: str  # code of the observatory, three or four characters
    submitter: str  # name, as initials and family name
    measurers: tuple[str, ...]  # names
    design: str  # design, detector: of the telescope, such as ``Refractor`` and ``CCD``
    aperture_m: float  # its aperture
    detector: str = "CCD"
    star_catalog: str = "Gaia3"  # of the attitudes, one of :data:`STAR_CATALOGS`

    def __post_init__(self) -> None:
        _require_text(self.station, "station", least=3, most=4)
        _require_text(self.submitter, "submitter", most=100)
        object.__setattr__(self, "measurers", tuple(self.measurers))
        require(len(self.measurers) > 0, "measurers: ADES needs a name")
        for name in self.measurers:
            _require_text(name, "measurers", most=100)
        _require_text(self.design, "design", most=25)
        _require_text(self.detector, "detector", most=25)
        require_number(self.aperture_m, "aperture_m", above=0.0, most=99.0)
        known = ", ".join(STAR_CATALOGS)
        require(self.star_catalog in STAR_CATALOGS, f"star_catalog must be one of {known}, got {self.star_catalog!r}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AdesObservation(Value):
    """One observation, astrometric: light time in, aberration out, in ICRF."""

    identification: tuple[str, str]  # name of the element (``permID``, ``provID`` or ``trkSub``) and its text
    epoch_utc: str  # mid-exposure, ISO 8601, to microseconds
    ra_deg: float  # ra_deg, dec_deg: of the object
    dec_deg: float
    sigma_ra_arcsec: float  # of right ascension times the cosine of the declination
    sigma_dec_arcsec: float  # sigma_dec_arcsec, correlation: of the declination, and of both
    correlation: float
    position_km: Float  # position_km, velocity_km_s: (3,); spacecraft from geocenter, ICRF, geometric, at epoch
    velocity_km_s: Float
    position_covariance_km2: Float | None = None  # (3, 3), positive definite
    sigma_time_s: float | None = None  # of the epoch
    exposure_s: float | None = None  # exposure
    n_stars: int | None = None  # stars of the attitude
    remarks: str = "positions in ICRF"  # one line

    def __post_init__(self) -> None:
        kind, name = self.identification
        require(kind in _OBJECT, f"identification must be one of {', '.join(_OBJECT)}, got {kind!r}")
        require(is_designation(kind, name), f"{name!r} is no {kind} of the Minor Planet Center")
        require(_UTC.fullmatch(self.epoch_utc) is not None, f"{name}: epoch {self.epoch_utc!r} is not ISO 8601 UTC")
        require_number(self.ra_deg, f"{name}: ra_deg", least=0.0, most=360.0)
        require_number(self.dec_deg, f"{name}: dec_deg", least=-90.0, most=90.0)
        require_number(self.sigma_ra_arcsec, f"{name}: sigma_ra_arcsec", above=0.0, most=99_999.0)
        require_number(self.sigma_dec_arcsec, f"{name}: sigma_dec_arcsec", above=0.0, most=99_999.0)
        require_number(self.correlation, f"{name}: correlation", above=-1.0, most=0.9999995)
        for what in ("position_km", "velocity_km_s"):
            values = as_floats(getattr(self, what), (3,), f"{name}: {what}")
            require(bool(np.all(np.abs(values) < 1e11)), f"{name}: {what} is too large for ADES: {values}")
            object.__setattr__(self, what, values)
        if self.position_covariance_km2 is not None:
            covariance = as_floats(self.position_covariance_km2, (3, 3), f"{name}: position_covariance_km2")
            sound = np.allclose(covariance, covariance.T) and bool(np.all(np.linalg.eigvalsh(covariance) > 0.0))
            require(sound, f"{name}: position_covariance_km2 must be symmetric and positive definite")
            object.__setattr__(self, "position_covariance_km2", covariance)
        for what, most in (("sigma_time_s", 1e5), ("exposure_s", 99_999.0)):
            if getattr(self, what) is not None:
                require_number(getattr(self, what), f"{name}: {what}", above=0.0, most=most)
        if self.n_stars is not None:
            require(1 <= self.n_stars < 1_000_000, f"{name}: n_stars must be in [1, 1e6), got {self.n_stars}")
        _require_text(self.remarks, f"{name}: remarks", most=300)
        Value.__post_init__(self)

    def elements(self, context: AdesContext) -> Iterator[tuple[str, str]]:
        """Yield names and texts of the elements, in the order of the schema."""
        yield self.identification
        yield from (("mode", "CCD"), ("stn", context.station), ("sys", "ICRF_KM"), ("ctr", "399"))
        yield from ((f"pos{k + 1}", _decimal(value, 13, 6)) for k, value in enumerate(self.position_km))
        yield from ((f"vel{k + 1}", _decimal(value, 13, 9)) for k, value in enumerate(self.velocity_km_s))
        if self.position_covariance_km2 is not None:
            for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
                yield f"posCov{i + 1}{j + 1}", f"{self.position_covariance_km2[i, j]:.9e}"
        yield "obsTime", f"{self.epoch_utc}Z"
        if self.sigma_time_s is not None:
            yield "rmsTime", _positive(self.sigma_time_s, 8)
        yield "ra", f"{round(self.ra_deg, 9) % 360.0:.9f}"
        yield "dec", f"{self.dec_deg:.9f}"
        yield "rmsRA", _positive(self.sigma_ra_arcsec, 7)
        yield "rmsDec", _positive(self.sigma_dec_arcsec, 7)
        yield "rmsCorr", f"{self.correlation:.6f}"
        yield "astCat", context.star_catalog
        if self.exposure_s is not None:
            yield "exp", _positive(self.exposure_s, 6)
        if self.n_stars is not None:
            yield "nStars", str(self.n_stars)
        yield "remarks", self.remarks


def is_designation(kind: str, text: str) -> bool:
    """Return True if a text has the form of an element: ``permID``, ``provID`` or ``trkSub``."""
    return re.fullmatch(_OBJECT[kind], text) is not None


def write_ades(path: str | Path, context: AdesContext, observations: Sequence[AdesObservation]) -> None:
    """Write an ADES file: XML or PSV, by the end of its name."""
    path, writers = Path(path), {".xml": _xml, ".psv": _psv}
    require(path.suffix in writers, f"{path}: ADES files are written as .xml or .psv, got {path.suffix!r}")
    require(len(observations) > 0, f"{path}: an ADES file needs an observation")
    write: Callable[[AdesContext, Sequence[AdesObservation]], str] = writers[path.suffix]
    write_text_atomic(path, write(context, observations))


def _context_groups(context: AdesContext) -> tuple[tuple[str, tuple[tuple[str, str], ...]], ...]:
    """Groups of the header of a submission and their elements."""
    aperture = _positive(context.aperture_m, 6)
    return (
        ("observatory", (("mpcCode", context.station),)),
        ("submitter", (("name", context.submitter),)),
        ("measurers", tuple(("name", name) for name in context.measurers)),
        ("telescope", (("design", context.design), ("aperture", aperture), ("detector", context.detector))),
    )


def _xml(context: AdesContext, observations: Sequence[AdesObservation]) -> str:
    """Text of an XML file."""
    root = ElementTree.Element("ades", version="2022")
    block = ElementTree.SubElement(root, "obsBlock")
    head, data = ElementTree.SubElement(block, "obsContext"), ElementTree.SubElement(block, "obsData")
    for group, elements in _context_groups(context):
        parent = ElementTree.SubElement(head, group)
        for name, text in elements:
            ElementTree.SubElement(parent, name).text = text
    for observation in observations:
        optical = ElementTree.SubElement(data, "optical")
        for name, text in observation.elements(context):
            ElementTree.SubElement(optical, name).text = text
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _psv(context: AdesContext, observations: Sequence[AdesObservation]) -> str:
    """Text of a file of values separated by bars; an observation without an element has an empty one."""
    lines, rows = ["# version=2022"], [dict(observation.elements(context)) for observation in observations]
    for group, elements in _context_groups(context):
        lines += [f"# {group}", *(f"! {name} {text}" for name, text in elements)]
    names = [name for name in _ORDER if any(name in row for row in rows)]
    return "\n".join([*lines, "|".join(names), *("|".join(row.get(name, "") for name in names) for row in rows)]) + "\n"


def _require_text(text: str, name: str, *, most: int, least: int = 1) -> None:
    """Raise unless a text is one line of a length, without bars and characters beyond ASCII."""
    sound = text.isascii() and text.isprintable() and "|" not in text and text == text.strip()
    require(sound and least <= len(text) <= most, f"{name} must be {least} to {most} plain characters, got {text!r}")


def _decimal(value: float, width: int, digits: int) -> str:
    """Number without an exponent in at most so many characters and digits after the point."""
    return next(text for n in range(digits, -1, -1) if len(text := f"{value:.{n}f}") <= width)


def _positive(value: float, width: int) -> str:
    """Positive number without an exponent in at most so many characters, not rounded to zero."""
    text = _decimal(max(value, 10.0 ** (2 - width)), width, width - 2)
    return text.rstrip("0").rstrip(".") if "." in text else text
