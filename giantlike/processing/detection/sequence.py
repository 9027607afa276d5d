"""Comparison of the images of a sequence: fixed pattern, hot pixels and cosmic rays.

Stars move over the detector from image to image; its fixed pattern and hot pixels stay; a particle hits once.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from giantlike.core.arrays import Float, Mask, frozen, require
from giantlike.core.detector import Detector
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.statistics import quartile_sigma
from giantlike.core.values import Value
from giantlike.processing.detection.detect import detect_sources
from giantlike.processing.detection.detections import DetectionFlag, Detections
from giantlike.processing.detection.frame import saturation_of
from giantlike.processing.detection.options import DetectionOptions

_MOST_IMAGES = 25  # in a pattern: its noise is a quarter of the noise of an image
_STRIP_PX = 1 << 22  # pixels of all images in memory for a median: 16 MB
_SEARCHED = 3  # images searched for sources that stay at their pixels
_BRIGHTEST = 30  # sources of an image compared
_STAY_PX = 1.0  # distance within which a source has stayed
_STAY_SHARE = 0.5  # fraction of sources above which the images have one pointing
_HOT_SIGMAS = 8.0  # of the pattern, and DN at least: of a million normal pixels none exceeds it

_VOTERS = 80  # brightest stars of an image that vote for its shift: 6,400 pairs
_VOTE_BIN_PX = 3.0  # distance within which displacements agree: roll and distortion spread them
_LEAST_VOTES, _LEAST_VOTE_SHARE = 5, 0.3  # number and fraction of the stars that must agree on a shift; not yet studied
_SAME_STAR_PX = 2.0  # maximum distance of a star from its shifted position: a roll moves it too
_SAME_PIXEL_PX = 0.75  # distance within which two detections are in the same pixel
_COMPARED = 8  # images closest in time that an image is compared with
_SEEN_AGAIN_SNR = 8.0  # signal to noise ratio of sources that are detected again: the limit of 5 and three sigma
_HOT_SHARE = 0.5  # fraction of the shifted images in which a hot pixel is found
_CHANCES = 2  # images that must show the position of a source for it to be a cosmic ray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FixedPattern(Value):
    """Fixed pattern of a detector, the same in all images of a sequence."""

    level_dn: NDArray[np.float32]  # (rows, columns); relative to the median over the detector
    hot: Mask  # (rows, columns); pixels far brighter than those around, in all images
    n_images: int  # number of images in the median

    def removed_from(self, pixels: ArrayLike, *, saturation_dn: float = np.inf) -> NDArray[np.float32]:
        """Subtract the pattern from an image."""
        array = np.asarray(pixels)
        require(
            array.shape == self.level_dn.shape,
            f"the fixed pattern has {self.level_dn.shape} pixels, the image {array.shape}",
        )
        saturated = array >= saturation_of(array.dtype, saturation_dn)
        return np.where(saturated, array, array - self.level_dn).astype(np.float32)


def fixed_pattern(images: Sequence[ArrayLike], *, detector: Detector | None = None) -> FixedPattern | Failure:
    """Estimate the fixed pattern of a detector by the median of each pixel over a sequence of images (rows, columns).

    Of an even number of images the lower of the two middle values is used, because stars only raise pixels.

    >>> random = np.random.default_rng(1)
    >>> pattern = random.normal(100.0, 20.0, (40, 40))
    >>> found = fixed_pattern([pattern + random.normal(0.0, 1.0, (40, 40)) for _ in range(5)])
    >>> bool(np.std(found.removed_from(pattern)) < 1.0)
    True
    """
    arrays = [np.asarray(image) for image in images]
    require(len(arrays) >= 2, f"a sequence needs at least two images, got {len(arrays)}")
    shapes = {array.shape for array in arrays}
    require(len(shapes) == 1 and arrays[0].ndim == 2, f"images of a sequence must have one size, got {sorted(shapes)}")
    finite = all(array.dtype.kind != "f" or bool(np.isfinite(array).all()) for array in arrays)
    require(finite, "a sequence needs finite pixels: read images with Image.open, which masks the others")
    share = _staying_share(arrays, Detector() if detector is None else detector)
    if share > _STAY_SHARE:
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"{share:.0%} of the brightest sources stay at their pixels: images of one pointing cannot separate stars "
            "from a fixed pattern, use images of different stars",
        )
    chosen = [arrays[k] for k in enough_images(len(arrays))]
    rows, columns = arrays[0].shape[:2]
    pattern = np.empty((rows, columns), dtype=np.float32)
    strip = max(1, _STRIP_PX // (len(chosen) * columns))
    middle = (len(chosen) - 1) // 2
    for first in range(0, rows, strip):
        stack = np.stack([array[first : first + strip] for array in chosen]).astype(np.float32)
        pattern[first : first + strip] = np.partition(stack, middle, axis=0)[middle]
    pattern -= np.median(pattern)
    hot = pattern > _HOT_SIGMAS * max(quartile_sigma(pattern), 1.0)
    return FixedPattern(level_dn=frozen(pattern), hot=frozen(hot), n_images=len(chosen))


def enough_images(count: int) -> list[int]:
    """Indices of the images of a sequence used for the pattern: all, or 25 evenly spaced."""
    return _spread_over(count, _MOST_IMAGES)


def _spread_over(count: int, most: int) -> list[int]:
    """Evenly spaced indices of ``count`` images, ``most`` at most."""
    chosen: list[int] = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
    return chosen


def _staying_share(arrays: Sequence[NDArray[Any]], detector: Detector) -> float:
    """Share of the brightest star-like sources of an image that the others have at the same pixels; the median."""
    points = []
    for k in _spread_over(len(arrays), _SEARCHED):
        found = detect_sources(arrays[k], detector=detector, options=DetectionOptions(max_sources=4 * _BRIGHTEST))
        if isinstance(found, Detections) and found.clean.any():
            points.append(found.points_px[found.clean][:_BRIGHTEST])
    shares = [np.mean(cKDTree(b).query(a)[0] < _STAY_PX) for a, b in itertools.permutations(points, 2)]
    return float(np.median(shares)) if shares else 0.0


def compare_sequence(detections: Sequence[Detections]) -> list[Detections]:
    """Flag hot pixels and cosmic rays by comparison with the other images of the sequence.

    The shift of the stars between two images is the one common to most pairs of bright detections; if there is none
    (another field, too few stars), sources that look like stars are not compared.

    - ``HOT_PIXEL``: found at the same pixel in at least half of the images that the stars have moved in, or sharper
      than a star and found there in any other image.
    - ``COSMIC_RAY``: sharper than a star and never found there again; or bright enough to be found again, and not
      found, neither with the stars nor at its pixel, in all of at least two images that show the position. A body that
      moves among the stars by more than 2 px per image is flagged too.
    """
    if len(detections) < 2:
        return list(detections)
    return [_flag_by_others(k, detections) for k in range(len(detections))]


def _flag_by_others(k: int, detections: Sequence[Detections]) -> Detections:
    here = detections[k]
    others = sorted((j for j in range(len(detections)) if j != k), key=lambda j: abs(j - k))[:_COMPARED]
    others = [j for j in others if len(detections[j])]
    if not others or not len(here):
        return here
    stays, moved = np.zeros(len(here), dtype=int), 0
    fixed, again, chances = (np.zeros(len(here), dtype=int) for _ in range(3))
    for j in others:
        there = detections[j]
        tree = cKDTree(there.points_px)
        same_pixel = tree.query(here.points_px)[0] < _SAME_PIXEL_PX
        stays += same_pixel
        shift = _star_shift_px(here, there)
        if shift is None:
            continue
        expected = here.points_px + shift
        same_star = tree.query(expected)[0] < _SAME_STAR_PX
        low, high = there.points_px.min(axis=0), there.points_px.max(axis=0)
        chances += ((expected >= low) & (expected <= high)).all(axis=1)
        again += same_star
        if np.hypot(*shift) > 2.0 * _SAME_STAR_PX:
            moved += 1
            fixed += same_pixel & ~same_star
    sharp = (here.flags & np.uint16(DetectionFlag.SHARP)) > 0
    hot = (sharp & (stays > 0)) | ((moved > 0) & (fixed >= max(1.0, _HOT_SHARE * moved)))
    bright = (here.snr >= _SEEN_AGAIN_SNR) & ((here.flags & np.uint16(DetectionFlag.SATURATED)) == 0)
    once = ~hot & (stays == 0) & (sharp | (bright & (again == 0) & (chances >= _CHANCES)))
    flags = here.flags.copy()
    flags[hot] |= np.uint16(DetectionFlag.HOT_PIXEL)
    flags[once] |= np.uint16(DetectionFlag.COSMIC_RAY)
    return replace(here, flags=flags)


def _star_shift_px(here: Detections, there: Detections) -> Float | None:
    """Shift (2,), px, of the stars from one image to another; None if no shift is significant."""
    a, b = (d.points_px[d.clean][:_VOTERS] for d in (here, there))
    if min(len(a), len(b)) < _LEAST_VOTES:
        return None
    differences = (b[None, :, :] - a[:, None, :]).reshape(-1, 2)
    votes = np.asarray(cKDTree(differences).query_ball_point(differences, _VOTE_BIN_PX / 2, return_length=True))
    best = int(votes.argmax())
    near = differences[np.hypot(*(differences - differences[best]).T) < _VOTE_BIN_PX]
    rivals = votes[np.hypot(*(differences - differences[best]).T) > 2 * _VOTE_BIN_PX]
    enough = max(_LEAST_VOTES, _LEAST_VOTE_SHARE * min(len(a), len(b)))
    if votes[best] < enough or votes[best] < 2 * int(rivals.max(initial=0)):
        return None
    shift: Float = np.median(near, axis=0)
    return shift
