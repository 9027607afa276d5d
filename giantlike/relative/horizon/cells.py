"""Cells along the lit horizon of an ellipsoid, whose pixels are fitted by the profile across its piece of horizon.

A cell has its own brightness: gain, growth along the horizon and inward, and background. What it tells about the
horizon's place, about the width of the blur and about how the law is wrong is kept as information, so that it can be
used cell by cell (the Christian-Robinson algorithm) or added up over all of them (the sigmoid fit).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.detector import Detector
from giantlike.core.values import Value
from giantlike.relative.horizon.cell_sums import fit_profiles
from giantlike.relative.horizon.pixels import LimbPixels
from giantlike.relative.horizon.profile import ProfileTable


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CellFits(Value):
    """Information of each cell on the horizon's place and on what all cells share, its brightness left free.

    The parameters are the outward shift of the horizon, px; the variance that the blur has besides, px^2; the
    coefficient of the next power of the cosine of emission, over the gain; and the share of each of the profiles that
    may be mixed in, where it is as bright as the law of the body.

    unexplained: (c,); root mean square of the residuals with all parameters free, relative to the brightness inside.
    """

    information: Float  # (c, 1 + s, 1 + s)
    pull: Float  # (c, 1 + s); information times estimate
    chi2: Float  # (c,); per degree of freedom, all free, by pixel noise
    gain_dn: Float  # (c,); ratio of brightness to the law
    contrast: Float  # (c,); ratio of the brightness inside to the noise of the sky
    unexplained: Float
    used: Float  # (c,); share of the usable pixels that were not left out for being too far from the fit

    @property
    def sigma_px(self) -> Float:
        """Standard deviation (c,) of the shift with blur and law known."""
        result: Float = 1.0 / np.sqrt(self.information[:, 0, 0])
        return result

    @property
    def shared_shifts(self) -> Float:
        """Shift (c, s) taken for a unit of each of the shared errors."""
        result: Float = self.information[:, 0, 1:] / self.information[:, 0, :1]
        return result

    @property
    def raw_shift_px(self) -> Float:
        """Shift (c,) with all that is shared as assumed."""
        result: Float = self.pull[:, 0] / self.information[:, 0, 0]
        return result

    def with_ovality(self, ovality: Float) -> CellFits:
        """Add two shared errors (2, c), by which the variance of the blur differs from cell to cell."""
        count = self.information.shape[1]
        by_shared = np.zeros((ovality.shape[1], count, count + 2))
        by_shared[:, np.arange(count), np.arange(count)] = 1.0
        by_shared[:, 1, count:] = ovality.T
        across = by_shared.transpose(0, 2, 1)
        pull = (across @ self.pull[:, :, None])[:, :, 0]
        return replace(self, information=across @ self.information @ by_shared, pull=pull)

    def about_shared(self, keep: Mask) -> tuple[Float, Float]:
        """Sum the information of cells on the shared errors, every shift left free.

        ``keep`` (c,); returns ``information`` (s, s) and ``pull`` (s,).
        """
        crossed = self.information[keep, 1:, 0]
        gained = self.information[keep, 1:, 1:] - crossed[:, :, None] * self.shared_shifts[keep, None, :]
        pull = self.pull[keep, 1:] - crossed * self.raw_shift_px[keep, None]
        return gained.sum(axis=0), pull.sum(axis=0)


def fit_cells(
    pixels: LimbPixels,
    data_dn: Float,
    table: ProfileTable,
    detector: Detector,
    *,
    largest_left: float = math.inf,
) -> CellFits:
    """Fit the profiles of a table to the pixels of each cell.

    Least squares weighted by the noise of the fitted brightness, linear in everything but the shift, for which the
    profile is linearized; blur enters through half the second derivative of the profile.
    """
    information, pull, rest = fit_profiles(
        pixels.first,
        data_dn[pixels.rows, pixels.columns],
        pixels.along,
        *table.at(pixels.along_px, pixels.outward_px),
        largest_left,
        float(detector.variance_dn2(np.zeros(1))[0]),
        detector.gain_e_per_dn,
        detector.relative_noise,
    )
    chi2, gain_dn, contrast, unexplained, used = rest
    return CellFits(
        information=information,
        pull=pull,
        chi2=chi2,
        gain_dn=gain_dn,
        contrast=contrast,
        unexplained=unexplained,
        used=used,
    )
