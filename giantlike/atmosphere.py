"""Atmospheres as limbs show them: the altitude at which the edge of a body is seen, by scale height and wavelength.

Light that grazes a body crosses ``tau sqrt(2 pi R / H)`` of haze where the vertical optical depth above is tau, some
70 times as much on Earth: so the limb is where the slant optical depth falls from much to little, scale heights above
the ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import exp1

from giantlike.core.arrays import Float, as_floats, require, require_number

_EULER = float(np.euler_gamma)
_GUMBEL_SIGMA = math.pi / math.sqrt(6.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Atmosphere:
    """Haze or air whose density falls exponentially, around a body.

    Parameters
    ----------
    scale_height_km : float, km; 0 for a limb that is sharp at ``base_km``
    optical_depth : float; vertical, above ``base_km``, at ``reference_nm``
    sigma_km : float, km; standard deviation of the altitude of the limb: multiple scattering, clouds, phase angle
    base_km : float, km; altitude above the shape of the body
    reference_nm : float, nm
    exponent : float; the optical depth goes as the wavelength to the power of minus this: 4 for air, about 0 for dust
    wavelength_nm : float, nm; at which the body is seen: the mean of a camera's filter

    Raises
    ------
    InputError
        A value is negative, or no wavelength.

    Examples
    --------
    >>> earth = Atmosphere.of("EARTH")
    >>> [round(earth.seen_at(nm).limb_altitude_km(6371.0), 1) for nm in (450.0, 550.0, 700.0)]
    [23.8, 18.1, 11.3]

    References
    ----------
    .. [1] Inman et al., Artemis I optical navigation system performance, section IV.C.3 (the altitude of the Earth's
       limb in a camera: 25 km).
    """

    scale_height_km: float
    optical_depth: float
    sigma_km: float
    base_km: float = 0.0
    reference_nm: float = 550.0
    exponent: float = 0.0
    wavelength_nm: float = 550.0

    def __post_init__(self) -> None:
        require_number(self.scale_height_km, "scale_height_km", least=0.0)
        require_number(self.optical_depth, "optical_depth", above=0.0)
        require_number(self.sigma_km, "sigma_km", least=0.0)
        require_number(self.base_km, "base_km")
        require_number(self.exponent, "exponent", least=0.0, most=6.0)
        for name in ("reference_nm", "wavelength_nm"):
            require_number(getattr(self, name), name, least=100.0, most=20_000.0)

    @classmethod
    def of(cls, body: str) -> Atmosphere:
        """Atmosphere of a body from :data:`ATMOSPHERES`, by its NAIF name; InputError where none is known."""
        known = ", ".join(ATMOSPHERES)
        require(body.upper() in ATMOSPHERES, f"no atmosphere of {body!r} is known, only of {known}: give its numbers")
        return ATMOSPHERES[body.upper()]

    @classmethod
    def at(cls, altitude_km: float, *, sigma_km: float) -> Atmosphere:
        """Atmosphere of which just the altitude of the limb is known, in km with its standard deviation."""
        return cls(scale_height_km=0.0, optical_depth=1.0, sigma_km=sigma_km, base_km=altitude_km)

    def seen_at(self, wavelength_nm: float) -> Atmosphere:
        """Return the same atmosphere as it is seen at another wavelength, nm."""
        return replace(self, wavelength_nm=wavelength_nm)

    @property
    def vertical_depth(self) -> float:
        """Vertical optical depth at the wavelength at which the body is seen."""
        return float(self.optical_depth * (self.reference_nm / self.wavelength_nm) ** self.exponent)

    def slant_depth(self, radius_km: float) -> float:
        """Optical depth along a ray that grazes the base, for a body of a radius in km."""
        curve_km = radius_km + self.base_km
        return self.vertical_depth * math.sqrt(2.0 * math.pi * curve_km / max(self.scale_height_km, 1e-9 * curve_km))

    def brightness(self, altitude_km: ArrayLike, radius_km: float) -> Float:
        """Brightness (...) of the limb relative to infinitely deep haze, by single scattering.

        It is ``1 - exp(-slant optical depth)`` at altitudes (...), km, of the lowest points of rays; 1 below the base.
        """
        above = as_floats(altitude_km, (), "altitude_km") - self.base_km
        if self.scale_height_km == 0.0:
            return (above < 0.0).astype(np.float64)
        with np.errstate(over="ignore"):
            depth = self.slant_depth(radius_km) * np.exp(-above / self.scale_height_km)
        return np.where(above < 0.0, 1.0, -np.expm1(-depth))

    def limb_altitude_km(self, radius_km: float) -> float:
        """Altitude at which a sharp edge has as much light above it as the limb has; ``radius_km`` of the body.

        Notes
        -----
        The integral of ``1 - exp(-t exp(-h / H))`` over heights h from 0 is ``H (ln t + gamma + E1(t))``, with Euler's
        constant. It is where an edge is measured whose pixels are coarser than H, and within a tenth of H where they
        are as fine.
        """
        if self.scale_height_km == 0.0:
            return self.base_km
        depth = self.slant_depth(radius_km)
        return self.base_km + self.scale_height_km * (math.log(depth) + _EULER + float(exp1(depth)))

    @property
    def limb_width_km(self) -> float:
        """Standard deviation of the fall of the brightness, km, by which the limb is blurred where no ground shows."""
        return _GUMBEL_SIGMA * self.scale_height_km


ATMOSPHERES = MappingProxyType(
    {
        "EARTH": Atmosphere(scale_height_km=7.0, optical_depth=0.098, sigma_km=7.0, exponent=4.06),
        "MARS": Atmosphere(scale_height_km=11.6, optical_depth=0.6, sigma_km=12.0),
        "VENUS": Atmosphere(scale_height_km=2.2, optical_depth=0.01, sigma_km=4.0, base_km=82.5),
        "JUPITER": Atmosphere.at(80.0, sigma_km=30.0),
        "SATURN": Atmosphere.at(100.0, sigma_km=40.0),
        "URANUS": Atmosphere.at(85.0, sigma_km=35.0),
        "NEPTUNE": Atmosphere.at(60.0, sigma_km=25.0),
        "TITAN": Atmosphere(scale_height_km=65.0, optical_depth=0.57, sigma_km=65.0, base_km=80.0, exponent=2.3),
        "TRITON": Atmosphere.at(3.0, sigma_km=3.0),
        "PLUTO": Atmosphere.at(5.0, sigma_km=5.0),
    }
)
"""Atmospheres by NAIF name, with conservative sigmas: a limb measured in the same filter is better.

Earth: scattering by air with the cross-section of Nicolet (1984, abstract: 0.2 to 0.55 um) and 2.15e25 molecules over a
square centimeter; the scale height is about the mean below 30 km. Clouds and multiple scattering raise the limb: paper
000 measured 25 km, which is 1 sigma above. Mars: dust with a scale height of 11.56 km and a depth of 0.9 that fell by
0.6 % a day (Lemmon et al. 2004, abstract); seasons go below and far beyond. Venus: a vertical depth of 0.01 at 80 to
85 km with a scale height of 1 to 3 km (Lane and Opstbaum 1983, abstract), above the solid surface.

Titan: scale height and exponent belong to the main haze above 80 km by the Huygens probe at 10 degrees south
(Tomasko et al. 2008), by the numbers that the code SRTC++ (``atmosphere::DISR08``) states from there. The depth is the
one whose limb is at the median of 49 published fits of circles to the limb in images of Cassini from 2004 to 2017 (SETI
Institute, rms-spindoctor, ``util/titan_cohort/final_run_summary.csv``, rows ``committed``): 146 to 376 km above 2574.7
km, median 242, by filter 307 (violet, 420 nm), 238 (clear) and 248 (red, 650 nm). They scatter by 40 km about it with
their own errors. The depth that Huygens measured, 3.9 at 550 nm, has it 125 km higher: where light is scattered many
times, a limb is steepest deeper than a grazing ray is dark. The sigma is one scale height, for other seasons and
phases; the detached haze in the ultraviolet is not in it, at 500 +- 8 km from 2005 to 2007 (Seignovert et al. 2017,
abstract, doi:10.1016/j.icarus.2017.03.026), gone from 2012 to 2015 (Seignovert et al. 2021, abstract,
arXiv:2102.05384).

Triton: its principal haze lies 3 to 6 km above the surface, fainter haze up to 14 km (caption of images of Voyager 2,
1989); clouds and haze have a depth of 0.03 in green (Hillier and Veverka 1994, abstract), which hides no ground. Pluto:
haze up to 200 km (Cheng et al. 2017, abstract, arXiv:1702.07771), through which its ground is seen too. Both sigmas
reach from the ground to the haze.

The radii of giant planets are for a pressure of 1 bar, and the limb is haze above the clouds, with sigmas that
cover the range between. Jupiter: clouds end near 0.2 bar, with haze of a vertical depth of 0.3 to 0.6 above (Kuehn and
Beebe, Vertical structure of Jupiter's atmosphere at the Galileo probe entry latitude, abstract): with 19 km of scale
height at 130 K rays that graze are dark from 31 km, and up to 120 km if haze is mixed with the gas. Saturn: hazes
between 0.5 and 0.01 bar over 130 km (Sanchez-Lavega et al. 2020, abstract), which starts 34 km up. Scattering by
hydrogen alone, a slant depth of 10 to 20 at 1 bar and 550 nm, has the limb at 3 to 3.6 scale heights, among these.
Uranus: haze from 0.1 bar up to a few millibars (Pollack et al. 1987, abstract), 50 to 130 km up with 22 to 25 km of
scale height; scattering by hydrogen alone has the limb at 85 km. Neptune: 0.1 bar is 40 km up (Voyager 2 radio
occultation, abstract: 72 K at 1 bar and 52 K there), haze reaches from 1 to 2 bar into the stratosphere, with methane
ice near 0.2 bar (Irwin et al. 2022, abstract, doi:10.1029/2022JE007189); scattering by hydrogen alone has the limb at
60 km.
"""

_AIRLESS_NAMES = """
MERCURY MOON PHOBOS DEIMOS
IO EUROPA GANYMEDE CALLISTO AMALTHEA THEBE ADRASTEA METIS HIMALIA
MIMAS ENCELADUS TETHYS DIONE RHEA HYPERION IAPETUS PHOEBE JANUS EPIMETHEUS HELENE TELESTO CALYPSO ATLAS PROMETHEUS
PANDORA PAN DAPHNIS METHONE PALLENE POLYDEUCES
MIRANDA ARIEL UMBRIEL TITANIA OBERON PUCK PROTEUS NEREID LARISSA CHARON NIX HYDRA
CERES VESTA PALLAS LUTETIA MATHILDE IDA DACTYL GASPRA EROS STEINS ITOKAWA BENNU RYUGU DIDYMOS DIMORPHOS TOUTATIS
ANNEFRANK BRAILLE APOPHIS DINKINESH DONALDJOHANSSON ARROKOTH
"""
AIRLESS = frozenset(_AIRLESS_NAMES.split())
"""Bodies without haze, by NAIF name: gas around them meets their surface more often than itself.

The Moon, Mercury, moons of the outer planets and larger asteroids have such exospheres (conference session "Surface
boundary exospheres", American Geophysical Union, fall meeting 2014, announcement); smaller ones can hold less. Plumes
of Io and Enceladus are local. Comets are not among them.
"""


def is_airless(body: str) -> bool:
    """Return True for a body in :data:`AIRLESS`, known to have no haze around it.

    Parameters
    ----------
    body : str; NAIF name, with or without the number of an asteroid before it (``"4 Vesta"``, ``"101955 BENNU"``)

    Examples
    --------
    >>> is_airless("Moon"), is_airless("101955 Bennu"), is_airless("TITAN"), is_airless("ROCK")
    (True, True, False, False)
    """
    return body.upper().lstrip("0123456789 _") in AIRLESS
