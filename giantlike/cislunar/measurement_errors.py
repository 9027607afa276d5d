"""Errors of a body's center and radius in an image as functions of its range: noise, relief and bias in pixels.

Errors of the center are along and across the direction to the Sun in the image, because light comes from there.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from giantlike.cislunar.body_measurements import disk_diameter, range_sigma
from giantlike.core.arrays import Float, as_finite, as_floats, require
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyErrorModel(Value):
    """Standard deviations and biases of the center along and across the Sun, and of the radius.

    Each is a triple in this order. A sigma is ``hypot(noise, relief / range)``, a bias
    ``bias + bias_at_body / range``: relief is a length at the body times the focal length in pixels.

    Parameters
    ----------
    noise_px : (3,) float64, px; sigmas of a smooth body, or of a distant body
    relief_px_km : (3,) float64, px km; sigma of relief, times the focal length
    bias_px : (3,) float64, px; bias of a distant body
    bias_px_km : (3,) float64, px km; bias that shrinks with the range, times the focal length

    References
    ----------
    .. [1] Holt, D'Souza and Saley (2018), Orion Optical Navigation Progress Toward Exploration Mission 1, eqs. 27-38.
    """

    noise_px: Float
    relief_px_km: Float = field(default_factory=lambda: np.zeros(3))
    bias_px: Float = field(default_factory=lambda: np.zeros(3))
    bias_px_km: Float = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        for name in ("noise_px", "relief_px_km", "bias_px", "bias_px_km"):
            object.__setattr__(self, name, as_finite(getattr(self, name), (3,), name))
        positive = bool((self.noise_px >= 0.0).all() and (self.relief_px_km >= 0.0).all())
        require(positive, "noise_px and relief_px_km must be >= 0")
        Value.__post_init__(self)

    def sigmas_px(self, range_km: ArrayLike) -> Float:
        """Standard deviations (..., 3), px, at ranges (...), km: center along the Sun, across it, radius."""
        return np.hypot(self.noise_px, self.relief_px_km / _ranges(range_km))

    def biases_px(self, range_km: ArrayLike) -> Float:
        """Biases (..., 3), px, at ranges (...), km: center along the Sun, across it, radius."""
        return self.bias_px + self.bias_px_km / _ranges(range_km)

    def covariance_px2(self, range_km: float, sun_direction_image: ArrayLike) -> Float:
        """Covariance (3, 3), px^2, of x and y of the center and of the radius at a range.

        ``sun_direction_image`` (2,): direction to the Sun in the image, of any length.
        """
        axes = _axes(sun_direction_image)
        covariance: Float = axes @ np.diag(self.sigmas_px(range_km) ** 2) @ axes.T
        return (covariance + covariance.T) / 2.0

    def bias_in_image_px(self, range_km: float, sun_direction_image: ArrayLike) -> Float:
        """Biases (3,), px, of x and y of the center and of the radius at a range.

        ``sun_direction_image`` (2,): direction to the Sun in the image, of any length.
        """
        return _axes(sun_direction_image) @ self.biases_px(range_km)

    def measurement_sigmas(self, range_km: ArrayLike, radius_km: float, focal_px: float) -> Float:
        """Standard deviations of the measurements of a filter, in a camera whose x axis is along the Sun.

        Returns (..., 3) for ranges (...), km: of the two tangents, and of the range in km.

        References
        ----------
        .. [1] Holt, D'Souza and Saley (2018), Orion Optical Navigation Progress Toward Exploration Mission 1,
           eqs. 19, 20 and 25; the sigma of a diameter is twice the sigma of the radius.
        """
        return self._errors_of_measurement(self.sigmas_px(range_km), range_km, radius_km, focal_px, sign=1.0)

    def measurement_biases(self, range_km: ArrayLike, radius_km: float, focal_px: float) -> Float:
        """Biases of the measurements of a filter, in a camera whose x axis is along the Sun.

        Returns (..., 3) for ranges (...), km: of the two tangents, and of the range in km; a radius that is too large
        gives a range too short.
        """
        return self._errors_of_measurement(self.biases_px(range_km), range_km, radius_km, focal_px, sign=-1.0)

    def _errors_of_measurement(
        self, errors_px: Float, range_km: ArrayLike, radius_km: float, focal_px: float, sign: float
    ) -> Float:
        """Errors of tangents and range from errors of center and radius."""
        ranges = as_floats(range_km, (), "range_km")
        diameter_px = focal_px * disk_diameter(ranges, radius_km)
        of_range = sign * range_sigma(ranges, radius_km, diameter_px, 2.0 * errors_px[..., 2])
        return np.concatenate([errors_px[..., :2] / focal_px, of_range[..., None]], axis=-1)


def _ranges(range_km: ArrayLike) -> Float:
    """Ranges (..., 1), all of them positive."""
    ranges = as_floats(range_km, (), "range_km")
    require(bool((ranges > 0.0).all()), "range_km must be positive")
    return ranges[..., None]


def _axes(sun_direction_image: ArrayLike) -> Float:
    """Columns along the Sun, across it (a quarter turn from x to y), and the radius, in the axes of the image."""
    sun = as_finite(sun_direction_image, (2,), "sun_direction_image")
    length = float(np.linalg.norm(sun))
    require(length > 0.0, "sun_direction_image has no direction: the Sun is behind the camera or the body")
    x, y = sun / length
    return np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])
