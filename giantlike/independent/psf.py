"""Point spread functions: a Gaussian core, wider wings, and motion, applied on a fine grid or in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.special import erf

from giantlike.independent.laws import Float

WIDTHS = 6.0  # widths of a Gaussian beyond which its light (2e-9) is left out

SMEAR_STEP_PX = 0.25  # distance of the points that stand for a smeared star, px


@dataclass(frozen=True)
class Psf:
    """Optical point spread function; the pixel is not part of it."""

    sigma_px: float = 0.7  # width of the Gaussian core
    wing_share: float = 0.0  # share of the light in the wings, a second, wider Gaussian
    wing_sigma_px: float = 3.0  # width of the wings
    motion_px: tuple[float, float] = (0.0, 0.0)  # path of the image on the detector during the exposure, centered

    @property
    def reach_px(self) -> int:
        """Distance in pixels beyond which no light arrives."""
        widest = self.wing_sigma_px if self.wing_share else self.sigma_px
        return math.ceil(WIDTHS * widest + 0.5 * math.hypot(*self.motion_px)) + 1

    def blurred(self, image: Float, cells_per_px: int) -> Float:
        """Convolve an image (n, m) on a grid of several cells a pixel, black outside; same shape."""
        shape = [next_fast_len(size, real=True) for size in image.shape]
        rows = np.fft.fftfreq(shape[0])[:, None] * cells_per_px  # cycles a pixel
        columns = np.fft.rfftfreq(shape[1])[None, :] * cells_per_px
        squared = 2.0 * np.pi**2 * (rows**2 + columns**2)
        transfer = (1.0 - self.wing_share) * np.exp(-squared * self.sigma_px**2)
        if self.wing_share:
            transfer = transfer + self.wing_share * np.exp(-squared * self.wing_sigma_px**2)
        if any(self.motion_px):
            transfer = transfer * np.sinc(columns * self.motion_px[0] + rows * self.motion_px[1])
        result = irfft2(rfft2(image, s=shape) * transfer, s=shape)
        return np.asarray(result[: image.shape[0], : image.shape[1]], dtype=float)

    def star(self, center_px: Float, columns: Float, rows: Float) -> Float:
        """Share (rows, columns) of a star's light on pixels, integrated over each, in closed form.

        ``columns`` (n,), ``rows`` (m,), columns and rows of pixels; returns (m, n), 1 in all over a frame without end.
        """
        length = math.hypot(*self.motion_px)
        count = max(1, math.ceil(length / SMEAR_STEP_PX))
        total = np.zeros((len(rows), len(columns)))
        for step in (np.arange(count) + 0.5) / count - 0.5:
            place = np.asarray(center_px, dtype=float) + step * np.asarray(self.motion_px)
            for share, sigma in ((1.0 - self.wing_share, self.sigma_px), (self.wing_share, self.wing_sigma_px)):
                if share:
                    total += (
                        share
                        / count
                        * np.outer(_over_pixels(rows, place[1], sigma), _over_pixels(columns, place[0], sigma))
                    )
        return total


def _over_pixels(pixels: Float, center: float, sigma: float) -> Float:
    """Integral of a Gaussian over each pixel of a row."""
    upper, lower = (pixels + 0.5 - center), (pixels - 0.5 - center)
    scale = 1.0 / (sigma * math.sqrt(2.0))
    return np.asarray(0.5 * (erf(upper * scale) - erf(lower * scale)), dtype=float)
