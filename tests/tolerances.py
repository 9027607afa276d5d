"""Tolerances that many tests share, each with its reason; one that a single test needs stands there with its own.

Rounding first: float64 has 2.2e-16 and float32 6e-8 of the number at hand, and what a computation makes of that
decides. All are absolute for numbers of order one, or relative.
"""

from __future__ import annotations

FLOAT64_DIGIT = 1e-15
"""One or two operations: a normalization, a number written and read with all its digits."""

FLOAT64 = 1e-12
"""A closed form, a rotation or a sum of thousands of terms: 1e3 to 1e4 times the rounding of one operation."""

FLOAT64_CHAIN = 1e-10
"""A projection and its inverse, interpolation weights, a sum that cancels two digits."""

FLOAT64_SUM = 1e-9
"""The same for numbers of order 1e3 (px of a frame, km of a range, DN), or iterations that stop there."""

FLOAT64_ROOT = 1e-7
"""Where half of the digits are lost: arc cosines near 1, squares of coordinates, central differences, eigenvectors."""

FLOAT32 = 1e-6
"""Single precision inside (Embree, OpenCV, STL, texture maps), or what is cut off a Gaussian at five sigma (6e-7)."""

FLOAT32_SUM = 1e-5
"""Sums of many numbers in single precision, and quadratures with a few hundred nodes."""

FIVE_DIGITS = 1e-4
"""Numbers that are published or written with four or five digits, and relations to first order in 1e-2."""

SAMPLED = 2e-3
"""Relative: sums over rays or facets that sample a smooth body some hundred times across."""

SAME_PLACE_PX = 0.02
"""Brightness centers of two images that should show the same: twice the navigator's gate for one image."""

SETTLED = 1e-6
"""Where iterations, quadratures, differences and inverses of ill-conditioned matrices in float64 stop."""

PLACE_PX = 1e-6
"""Two ways to the same place in an image: a thousandth of the best centroid, and far above rounding at 3,000 px."""

ROUND_TRIP_PX = 1e-9
"""To the sky and back at 3,000 px in float64, with room for Newton's last step."""

EPOCH_S = 1e-6
"""Headers and tables hold microseconds; float64 seconds over a century hold 1e-7."""

RARE = 1e-6
"""Chance that one statistical gate fails although the statistics hold."""

FALSE_ALARM = 1e-5
"""The same for gates with a seed that hypothesis or a loop varies: a suite of hundreds of gates stays quiet."""
