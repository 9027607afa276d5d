"""Values that do not grow in proportion to light: tables of square roots, gamma, detectors near their full well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.values import Value

RESPONSE = "response"
"""Key of the provenance of fixes that were made of values bent into proportion to light."""
LEAST_BEND = 0.25
"""Bend that residuals ask for from which on it is tried. Of the gauntlet tables of square roots ask for 0.34 and more,
images with nothing but another law for 0.03 at most, markings for 0.3."""
_MOST_BEND = 0.98
_BENDINGS, _SETTLED_BEND = 6, 0.02
"""Trials of a response, at most, and the change of its bend, if not its standard deviation, below which it is found:
what remains is estimated."""

Trial = TypeVar("Trial")


@dataclass(frozen=True, slots=True, kw_only=True)
class Response(Value):
    """Light as a parabola of the values of an image: exact for tables of square roots, near for other tables.

    Parameters
    ----------
    bend : float
        Share of the square: 0 where values are proportional to light, 1 where they are square roots of it.
    dark_dn, bright_dn : float, DN
        Values that remain as they are: of the sky, and of the brightest light; ``bend`` goes from one to the other.

    Examples
    --------
    >>> table = Response(bend=1.0, dark_dn=0.0, bright_dn=100.0)
    >>> [float(light) for light in table.light_dn(np.array([0.0, 10.0, 50.0, 100.0]))]
    [0.0, 1.0, 25.0, 100.0]
    """

    bend: float
    dark_dn: float
    bright_dn: float

    @classmethod
    def from_text(cls, text: str) -> Response:
        """Read what ``str`` writes, as the provenance of a fix holds it.

        Parameters
        ----------
        text : str

        Returns
        -------
        Response
        """
        bend, dark_dn, bright_dn = (float(part.partition("=")[2]) for part in text.split())
        return cls(bend=bend, dark_dn=dark_dn, bright_dn=bright_dn)

    def __str__(self) -> str:
        return f"bend={self.bend:.4g} dark_dn={self.dark_dn:.6g} bright_dn={self.bright_dn:.6g}"

    def light_dn(self, values_dn: Float) -> Float:
        """Return the light of values.

        Parameters
        ----------
        values_dn : (...) float64, DN
            Bias subtracted.

        Returns
        -------
        (...) float64, DN
            Below the lowest point of the parabola, which lies below the sky, as there.
        """
        span_dn = self.bright_dn - self.dark_dn
        lowest_dn = -0.5 * (1.0 - self.bend) / max(self.bend, 1e-9) * span_dn
        above = np.maximum(values_dn - self.dark_dn, lowest_dn)
        return np.asarray(self.dark_dn + above + self.bend * above * (above / span_dn - 1.0))

    def changes_dn(self, light_dn: Float) -> Float:
        """Return the derivatives of :meth:`light_dn` by the bend, and by the share of a cube that vanishes half way.

        Parameters
        ----------
        light_dn : (...) float64, DN

        Returns
        -------
        (2, ...) float64, DN
            Of the values that stand for this light.
        """
        span_dn, straight = self.bright_dn - self.dark_dn, 1.0 - self.bend
        light = light_dn - self.dark_dn
        root = np.sqrt(np.maximum(straight**2 + 4.0 * self.bend * light / span_dn, 0.0))
        above = 2.0 * light / np.maximum(straight + root, 1e-9)
        square = above * (above / span_dn - 1.0)
        return np.stack([square, square * (2.0 * above / span_dn - 1.0)])


def settled(
    first: Response, tried: Callable[[Response], Trial | None], asked: Callable[[Trial], tuple[Response, float]]
) -> Trial | None:
    """Straighten values by the bend that residuals ask for, until they ask for no other.

    Parameters
    ----------
    first : Response
        What residuals ask for where values are taken to be light.
    tried : callable
        What comes of values that were straightened by a response; None where nothing does.
    asked : callable
        The response that the residuals of such a trial ask for, and the standard deviation of its bend.

    Returns
    -------
    object or None
        The last trial; None where the bend does not settle, or settles where there is next to none.
    """
    response = first
    for _ in range(_BENDINGS):
        response = replace(response, bend=min(max(response.bend, 0.0), _MOST_BEND))
        trial = tried(response)
        if trial is None:
            return None
        found, sigma = asked(trial)
        if abs(found.bend - response.bend) < max(_SETTLED_BEND, sigma):
            return trial if found.bend > LEAST_BEND else None
        response = found
    return None
