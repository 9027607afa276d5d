"""Whether a calibration is good enough to be used, and if not, why."""

from __future__ import annotations

import numpy as np

from giantlike.calibration.fix import CalibrationFix
from giantlike.calibration.options import CalibrationCriteria

_PARTS = 3  # of the field along each axis


def missed_criteria(fix: CalibrationFix, criteria: CalibrationCriteria) -> tuple[str, ...]:
    """Say which criteria a calibration misses: what is needed and what came, one line each; empty if none."""
    missed = []
    if fix.rms_px > criteria.max_residual_px:
        missed.append(f"residual rms is {fix.rms_px:.3g} px, at most {criteria.max_residual_px:g} is accepted")
    for image in fix.images:
        if image.rms_px > criteria.max_image_residual_px:
            limit = criteria.max_image_residual_px
            missed.append(f"residual rms of {image.name} is {image.rms_px:.3g} px, at most {limit:g} is accepted")
    share = fix.n_rejected / len(fix.used)
    if share > criteria.max_rejected:
        missed.append(
            f"{fix.n_rejected} of {len(fix.used)} observations were rejected ({100 * share:.3g} %), "
            f"at most {100 * criteria.max_rejected:g} % are accepted"
        )
    worst = float(np.max(fix.map_sigma_px, initial=0.0))
    if worst > criteria.max_map_sigma_px:
        missed.append(
            f"the camera map is uncertain by {worst:.3g} px at the worst place of the field, "
            f"at most {criteria.max_map_sigma_px:g} is accepted"
        )
    needed = criteria.min_observations_per_parameter * len(fix.estimated)
    if fix.n_used < needed:
        missed.append(f"{fix.n_used} observations for {len(fix.estimated)} parameters, {needed:g} are needed")
    covered = _covered(fix)
    if covered < criteria.min_covered:
        missed.append(
            f"observations cover {100 * covered:.3g} % of the field, {100 * criteria.min_covered:g} % are needed"
        )
    return tuple(missed)


def _covered(fix: CalibrationFix) -> float:
    """Share of the equal parts of the field in which something was observed."""
    points = fix.observed_px[fix.used]
    edges = [np.linspace(-0.5, size - 0.5, _PARTS + 1) for size in (fix.columns, fix.rows)]
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=edges)
    return float(np.count_nonzero(counts)) / _PARTS**2
