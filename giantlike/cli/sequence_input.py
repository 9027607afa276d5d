"""``--sequence``: images of one camera, whose fixed pattern is removed first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from giantlike.cli.outcome import say
from giantlike.core.arrays import require
from giantlike.core.detector import Detector
from giantlike.core.errors import OpNavError
from giantlike.core.outcomes import Failure
from giantlike.image import Image
from giantlike.processing.detection.frame import saturation_of
from giantlike.processing.detection.sequence import FixedPattern, enough_images, fixed_pattern

BOTH_PATTERNS = "--frames takes the fixed pattern of the detector off; give it or --sequence, not both"


def sequence_pattern(
    paths: Sequence[Path], *, hdu: int | str | None, detector: Detector, bottom_up: bool = False
) -> FixedPattern | Failure:
    """Fixed pattern of the readable images among ``paths``; a failure is also said on stderr."""
    arrays = []
    for k in enough_images(len(paths)):
        try:
            arrays.append(Image.open(paths[k], hdu=hdu, bottom_up=bottom_up).pixels)
        except OpNavError:
            continue  # it is named where the image itself is processed
    require(len(arrays) >= 2, f"--sequence needs at least two readable images, got {len(arrays)}")
    pattern = fixed_pattern(arrays, detector=detector)
    if isinstance(pattern, Failure):
        say(f"giantlike: no fixed pattern is removed: {pattern.detail}")
    return pattern


def without_pattern(image: Image, detector: Detector, pattern: FixedPattern | Failure | None) -> tuple[Image, Detector]:
    """Return an image without the pattern and its hot pixels, and a detector with the saturation of its pixels."""
    if not isinstance(pattern, FixedPattern):
        return image, detector
    limit = saturation_of(image.pixels.dtype, detector.saturation_dn)
    pixels = pattern.removed_from(image.pixels, saturation_dn=detector.saturation_dn)
    return replace(image, pixels=pixels, mask=image.mask | pattern.hot), replace(detector, saturation_dn=limit)
