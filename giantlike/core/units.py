"""Physical constants and unit factors, each with its source."""

from __future__ import annotations

import math

SPEED_OF_LIGHT_KM_S = 299792.458  # exact by the definition of the meter

AU_KM = 149597870.7  # IAU 2012 resolution B2, exact

SECONDS_PER_DAY = 86400.0  # TDB or TAI seconds
SECONDS_PER_JULIAN_YEAR = 365.25 * SECONDS_PER_DAY  # by definition of the Julian year

RAD_PER_DEG = math.pi / 180.0  # exact, as the following
RAD_PER_ARCSEC = RAD_PER_DEG / 3600.0  # 3,600 arcsec to the degree
ARCSEC_PER_RAD = 1.0 / RAD_PER_ARCSEC  # about 206,265
RAD_PER_MAS = RAD_PER_ARCSEC / 1000.0  # milliarcseconds
J2000_JD = 2_451_545.0  # Julian date of J2000, 2000-01-01 12:00 TDB
