"""Acceptance criteria of a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.calibration.result import CalibrationResult
from giantlike.core.arrays import require

_PARTS = 3  # parts of the field along each axis: center, edges and corners


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationCriteria:
    """Acceptance criteria of a calibration; the defaults are for stars with centroids of about 0.1 px."""

    # largest radial residual rms of the observations kept, with their weights in the fit. Default 0.5: real frames have
    # 0.16 to 0.26
    max_residual_px: float = 0.5
    max_image_residual_px: float = 1.0  # largest residual rms of a single image. Default 1: twice the limit for all.
    max_rejected: float = 0.25  # largest fraction of observations rejected. Default a quarter; no study yet.
    max_map_sigma_px: float = 0.5  # largest uncertainty over the field, modulo a rotation. Default as residuals
    min_observations_per_parameter: float = 3.0  # of the camera, kept. Default 3, six equations
    min_covered: float = 0.6  # smallest fraction of nine parts of the field. Default 0.6: six of nine

    def __post_init__(self) -> None:
        for name in self.__slots__:
            require(getattr(self, name) > 0, f"{name} must be > 0, got {getattr(self, name)}")

    def missed_by(self, result: CalibrationResult) -> tuple[str, ...]:
        """Criteria that a calibration misses, one sentence each; empty if it meets all."""
        missed = []
        weighted_px = result.weighted_rms_px()
        if weighted_px > self.max_residual_px:
            missed.append(f"residual rms is {weighted_px:.3g} px, at most {self.max_residual_px:g} is accepted")
        for number, image in enumerate(result.images):
            weighted_px, limit = result.weighted_rms_px(number), self.max_image_residual_px
            if weighted_px > limit:
                missed.append(f"residual rms of {image.name} is {weighted_px:.3g} px, at most {limit:g} is accepted")
        share = result.n_rejected / len(result.used)
        if share > self.max_rejected:
            missed.append(
                f"{result.n_rejected} of {len(result.used)} observations were rejected ({100 * share:.3g} %), "
                f"at most {100 * self.max_rejected:g} % are accepted"
            )
        worst = float(np.max(result.map_sigma_px, initial=0.0))
        if worst > self.max_map_sigma_px:
            missed.append(
                f"the camera map is uncertain by {worst:.3g} px at the worst place of the field, "
                f"at most {self.max_map_sigma_px:g} is accepted"
            )
        needed = self.min_observations_per_parameter * len(result.estimated)
        if result.n_used < needed:
            missed.append(f"{result.n_used} observations for {len(result.estimated)} parameters, {needed:g} are needed")
        points = result.observed_px[result.used]
        edges = [np.linspace(-0.5, size - 0.5, _PARTS + 1) for size in (result.columns, result.rows)]
        counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=edges)
        covered = float(np.count_nonzero(counts)) / _PARTS**2
        if covered < self.min_covered:
            missed.append(
                f"observations cover {100 * covered:.3g} % of the field, {100 * self.min_covered:g} % are needed"
            )
        return tuple(missed)
