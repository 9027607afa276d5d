"""A template against an image at all shifts of it: one transform of the image, two of each template."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.relative.verification.cell_loops import EXACT
from giantlike.relative.verification.cells import Cells


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShiftedMatches(Value):
    """Sums over the window of a template at each shift of it.

    number, total, variance: (shifts, shifts); good cells in the window, their sum and the sum of squares about their
        mean.
    """

    size: tuple[int, int]  # cells of the image in the transforms, padding included
    shifts: int  # number of shifts along each axis, of -n to n cells
    spectra: NDArray[np.complex128]  # (2, rows, columns // 2 + 1); transforms of the good cells and of their values
    number: Float
    total: Float
    variance: Float
    whole: bool  # True where all cells are good: no sum of a template alone depends on the shift then

    @classmethod
    def from_cells(cls, cells: Cells, room: int) -> ShiftedMatches:
        """Transform an image."""
        from scipy.fft import next_fast_len, rfft2

        first = cells.room - room
        within = slice(first, cells.box.width - first)
        pixels, good = cells.values[within, within], cells.good[within, within]
        counted = good.astype(np.float64)
        values = np.where(good, pixels, 0.0)
        values = values - values.sum() / max(counted.sum(), 1.0) * counted
        length = next_fast_len(len(counted), real=True)
        size, shifts = (length, length), 2 * room + 1
        spectra = rfft2(np.stack([counted, values, values**2]), size)
        window = np.ones((len(counted) - 2 * room,) * 2)
        number, total, squares = _products(spectra, window, size, shifts)
        number = np.maximum(np.rint(number), 1.0)
        variance = squares - total**2 / number
        return cls(
            size=size,
            shifts=shifts,
            spectra=spectra[:2],
            number=number,
            total=total,
            variance=variance,
            whole=bool(good.all()),
        )

    def find_unexplained_share(self, model: Float) -> Float:
        """Share of the variance of the image that a template leaves, with its gain and a level fitted.

        ``model`` (..., m, m); returns (..., shifts, shifts), by shift along rows and columns, 1 where only a negative
        gain would explain anything.
        """
        return 1.0 - self.correlate(model)[0]

    def correlate(self, model: Float) -> tuple[Float, Float]:
        """Share of the variance of the image that a template explains, and its gain, at each shift.

        ``model`` (..., m, m); returns ``share`` (..., shifts, shifts); ``gain`` (..., shifts, shifts) DN, zero where it
        would be negative or where nothing is to be seen.
        """
        model = model[..., None, :, :]
        if self.whole:
            product = _products(self.spectra[1:], model, self.size, self.shifts)[..., 0, :, :]
            light, light_squares = (one.sum(axis=(-2, -1))[..., None] for one in (model, model**2))
        else:
            light, product = np.moveaxis(_products(self.spectra, model, self.size, self.shifts), -3, 0)
            light_squares = _products(self.spectra[:1], model**2, self.size, self.shifts)[..., 0, :, :]
        light_variance = light_squares - light**2 / self.number
        covariance = np.maximum(product - self.total * light / self.number, 0.0)
        most = light_variance.max(axis=(-2, -1), keepdims=True)
        seen = (self.variance > EXACT * self.variance.max()) & (light_variance > EXACT * most)
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = np.where(seen, covariance / light_variance, 0.0)
            share = np.where(seen, np.minimum(gain * covariance / self.variance, 1.0), 0.0)
        return share, gain


def _products(spectra: NDArray[np.complex128], model: Float, size: tuple[int, int], shifts: int) -> Float:
    """Sums (..., shifts, shifts) of products of images and templates at all shifts that stay within them."""
    from scipy.fft import irfft2, rfft2

    products = irfft2(spectra * np.conj(rfft2(model, size)), size)
    return np.asarray(products[..., :shifts, :shifts], dtype=np.float64)
