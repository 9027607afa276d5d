"""Checks common to all fixes: the body rendered coarsely at its estimated position and compared with the image.

:func:`~giantlike.relative.verification.checks.verify` follows every ``estimate``. It averages the image around the
body in cells (``cells``), traces the body once into them, and fits its light to the image with corrections of position
and strain (``coarse_fit``). It tests the linearity of the values (``proportion``) and the odds of other models of the
image (``alternatives``, ``light_side``), of another position (``rival``) and of the prediction within its declared
errors. :mod:`giantlike.relative.judge` turns the numbers into flags.
"""

from giantlike.relative.verification.checks import verify

__all__ = ["verify"]
