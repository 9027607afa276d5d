"""Checks of a fix that no estimator makes of itself: the body rendered coarsely where it was found, against the image.

:func:`~giantlike.relative.verification.checks.verified` stands behind every ``estimate``. It averages the image around
the body in cells (``cells``), traces the body once into them, and fits its light to that of the image with corrections
of place and strain (``coarse_fit``). It tests the linearity of the values (``proportion``) and the odds of other models
of the image (``alternatives``, ``light_side``), of another place (``rival``) and of the prediction within its declared
errors. :mod:`giantlike.relative.judge` turns the numbers into flags.
"""

from giantlike.relative.verification.checks import verified

__all__ = ["verified"]
