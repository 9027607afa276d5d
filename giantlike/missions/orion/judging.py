"""Rules by which a number of ours agrees with one of the paper."""

ROUNDING = 0.005
"""Relative: numbers that the paper gives with three digits."""
ANALYSIS = 0.10
"""Required relative agreement of linear covariance and flown runs."""
MODEL = 0.5
"""Relative: an error model fitted to other images of another renderer."""
