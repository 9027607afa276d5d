"""Checks of a fix that no estimator makes of itself: the body rendered coarsely where it was found, against the image.

:func:`~giantlike.relative.verification.checks.verified` stands behind every ``estimate``. It averages the image around
the body in cells (``cells``), traces the body once into them, and asks whether its light explains that of the image and
where in it the body and its parts would rather be (``coarse_fit``), whether values are in proportion to light
(``proportion``), whether another Sun or another place would explain it as well (``light_side``, ``rival``), and whether
prediction and fix agree within the sigmas that were declared.
What follows from the numbers is decided in ``relative/quality.py``.
"""

from giantlike.relative.verification.checks import verified

__all__ = ["verified"]
