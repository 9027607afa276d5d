"""The reflectance law of a body by the brightness of its parts: how far it is from the one assumed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.ray_tracing import Template
from giantlike.relative.light.separation import BodyLight, seen_from

_WEIGHT_SIGMA = 1.0 / math.sqrt(6.0)
"""A priori standard deviation of the weight.

That of the difference of two laws, the true one and the one assumed, which lie anywhere between that of Lommel and
Seeliger and that of Lambert with equal probability.
"""
_BLOCK = 0.25
"""Side of a block over the radius of the body: markings larger than that are few."""
_LEAST_BLOCKS = 8
"""Blocks, and pairs of neighbors, that say something of markings: their scatter is then known to a quarter."""
_LARGEST_SHARE = 0.5
"""Largest marking over the body: what is larger is brightness as a whole, which moves no center."""
_LIMB, _LIMB_PX, _COVERED = 0.02, 2, 0.999
"""Margin within the outline that blocks leave out, of the radius and px, for errors of range and PSF; and the share of
a pixel that the body covers there."""
_FITTED = 4
"""Parameters that take markings out of the residuals: brightness, place (two) and law."""
_MOST_FITTED = 0.75
"""Part of the variance of markings that these take, at most, so that what is left says something of them."""
_ROUNDS, _SETTLED, _STEP = 5, 0.02, 0.1
"""Rounds of the fit, which is nearly linear, with new images and within each with new errors; change, over its standard
deviation, that ends them; and step of its numerical derivative, a tenth of the way between laws."""
_MOST = 1.0
"""Largest weight: from one of the laws to the other."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LawMixture(Value):
    """A body under one law, and under two that those of bodies lie between: flat, and dark towards the terminator.

    Parameters
    ----------
    own : Template
        Under the law that is assumed.
    change : (h, w) float64
        Brightness of the same pixels under the law of Lambert less that under the law of Lommel and Seeliger, each over
        its sum.
    """

    own: Template
    change: Float

    @classmethod
    def of(cls, own: Template, *, flat: Float, dark: Float) -> LawMixture:
        """Return the mixture of brightness (h, w) under a flat law and under one dark towards the terminator."""
        return cls(own=own, change=dark / float(dark.sum()) - flat / float(flat.sum()))

    def seen_from(self, corner_px: NDArray[np.int64]) -> LawMixture:
        """Return the same in coordinates that start at a pixel (2,)."""
        return replace(self, own=seen_from(self.own, corner_px))

    def at(self, weight: float) -> Template:
        """Return the body under the law assumed plus a share of the difference from the flat law to the dark one.

        Parameters
        ----------
        weight : float
            Towards the dark law; all laws give the same light in total.

        Returns
        -------
        Template
        """
        brightness = self.own.brightness + weight * float(self.own.brightness.sum()) * self.change
        return replace(self.own, brightness=np.maximum(brightness, 0.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LawFit(Value):
    """The law that the light of a body shows.

    Parameters
    ----------
    weight, sigma : float
        Of the mixture, and its standard deviation.
    slope_px : (2,) float64, px
        Change of the correction by the weight.
    template : Template
        The body under the law found.
    unexplained_px2 : (2, 2) float64, px^2
        Covariance of the center of light by what the law does not explain: markings, or another kind of law.
    markings : float
        Standard deviation of the brightness of blocks about that of the template, over it, without photon noise.
    unexplained : float
        Norm of image minus template over that of the light of the body, without that of the noise.
    residuals : (n,) float64
        Image minus template in the bright pixels, over the brightest pixel of the template.
    """

    weight: float
    sigma: float
    slope_px: Float
    template: Template
    unexplained_px2: Float
    markings: float
    unexplained: float
    residuals: Float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Blocks(Value):
    """Pixels (n,) of the body, the block that each belongs to, and the places (blocks, 2) of the blocks."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    number: NDArray[np.int64]
    cells: NDArray[np.int64]

    def clustering(self, marks: Float) -> float:
        """Blocks that share a marking, by the correlation of the marks (blocks,) of neighbors.

        A correlation ``exp(-d^2 / 2 l^2)`` of blocks at a distance d has the sum ``2 pi l^2``, and for neighbors
        (d = 1) it is ``exp(-1 / 2 l^2)``.
        """
        at = dict(zip(map(tuple, self.cells.tolist()), marks.tolist(), strict=True))
        pairs = np.array([(at[x, y], at[near]) for x, y in at for near in ((x + 1, y), (x, y + 1)) if near in at])
        power = float(np.mean(marks**2))
        if len(pairs) < _LEAST_BLOCKS or power == 0.0:
            return 1.0
        correlation = float(np.mean(pairs[:, 0] * pairs[:, 1])) / power
        if correlation <= math.exp(-math.pi):
            return 1.0
        return min(math.pi / -math.log(min(correlation, 0.999)), _LARGEST_SHARE * len(marks))

    def sums(self, values: Float) -> Float:
        """Sums (blocks,) of the values (rows, columns) of an image."""
        return np.bincount(self.number, values[self.rows, self.columns]).astype(np.float64)

    def photon(self, light: BodyLight) -> Float:
        """Variance (blocks,), DN^2, of the light of the blocks by the noise of the pixels."""
        signal = light.signal_dn[self.rows, self.columns]
        return np.bincount(self.number, light.variance_dn2(signal)).astype(np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Weighing(Value):
    """Linear problem of the weight: light (blocks,) of the image, its photon variance, and what a weight changes."""

    blocks: _Blocks
    light_dn: Float
    photon_dn2: Float
    by_weight_dn: Float

    def solved(self, expected_dn: Float, at: float, *, first: bool) -> tuple[float, float]:
        """Weight and its variance, from the light (blocks,) expected at a weight.

        The first time without the prior: what a wrong law leaves over looks like markings, with which the law counts
        little.
        """
        weight, variance, photon = at, _WEIGHT_SIGMA**2, self.photon_dn2
        for number in range(_ROUNDS):
            expected = expected_dn + (weight - at) * self.by_weight_dn
            left, level = self.light_dn - expected, np.maximum(expected, np.sqrt(photon))
            # The range, and with it the brightness, is not exact.
            left, slope = (each - float(each.sum()) / float(level.sum()) * level for each in (left, self.by_weight_dn))
            marked = max(float(np.sum(left**2 - photon)), 0.0) / float(np.sum(level**2))
            errors = photon + marked * self.blocks.clustering(left / level) * level**2
            prior = 0.0 if first and number == 0 else 1.0 / _WEIGHT_SIGMA**2
            information = max(float(np.sum(slope**2 / errors)) + prior, 1e-12)
            change = (float(np.sum(slope * left / errors)) - weight * prior) / information
            before, weight, variance = weight, float(np.clip(weight + change, -_MOST, _MOST)), 1.0 / information
            if number > 0 and abs(weight - before) < _SETTLED * math.sqrt(variance):
                break
        return weight, variance


def fit_law(light: BodyLight, laws: LawMixture, *, radius_px: float) -> LawFit:
    """Fit the weight of a mixture of laws to the brightness of blocks of the body.

    Parameters
    ----------
    light : BodyLight
    laws : LawMixture
    radius_px : float, px
        Apparent radius of the body.

    Returns
    -------
    LawFit

    Notes
    -----
    Each block has its photon noise and an albedo of its own, whose scatter is that of the residuals. The body is
    placed by its center of light under each law, so that no limb is needed.
    """
    center = light.center_px(light.threshold_dn)
    blocks = _blocks_of(light, laws.own, center, radius_px)
    template = laws.own
    expected, other = (_placed(light, each, center) for each in (template, laws.at(_STEP)))
    problem = _Weighing(
        blocks=blocks,
        light_dn=blocks.sums(light.signal_dn),
        photon_dn2=blocks.photon(light),
        by_weight_dn=blocks.sums(other - expected) / _STEP,
    )
    weight, variance = problem.solved(blocks.sums(expected), 0.0, first=True)
    placed_at = 0.0
    for _ in range(_ROUNDS):
        if abs(weight - placed_at) < _SETTLED * math.sqrt(variance):
            break
        placed_at, template = weight, laws.at(weight)
        expected = _placed(light, template, center)
        weight, variance = problem.solved(blocks.sums(expected), placed_at, first=False)
    weight = placed_at
    moved = light.offset_px(laws.at(weight + _STEP), light.threshold_dn) - light.offset_px(template, light.threshold_dn)
    residuals = light.signal_dn - expected
    unexplained_px2, markings = _unexplained(light, expected, center, blocks)
    seen = light.signal_dn[light.region]
    excess = float((residuals[light.region] ** 2 - light.variance_dn2(np.maximum(seen, 0.0))).sum())
    return LawFit(
        weight=weight,
        sigma=math.sqrt(variance),
        slope_px=moved / _STEP,
        template=template,
        unexplained_px2=unexplained_px2,
        markings=markings,
        unexplained=math.sqrt(max(excess, 0.0) / float((seen**2).sum())),
        residuals=residuals[light.bright] / float(expected.max()),
    )


def _blocks_of(light: BodyLight, template: Template, center_px: Float, radius_px: float) -> _Blocks:
    """Blocks of the bright pixels away from the limb, counted from the center of light; of all where those are few."""
    margin = _LIMB_PX + math.ceil(_LIMB * radius_px)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    inside = cv2.erode((template.coverage > _COVERED).astype(np.uint8), disk) > 0
    x, y = (template.corner_px + light.shift_px).tolist()
    rows, columns = light.region.shape
    core = light.bright & PixelBox(x=0, y=0, width=columns, height=rows).cut(inside, (x, y))
    side_px = max(_BLOCK * radius_px, 1.0)
    if core.any():
        found = _in_blocks(core, center_px, side_px)
        if len(found.cells) >= _LEAST_BLOCKS:
            return found
    return _in_blocks(light.bright, center_px, side_px)


def _in_blocks(pixels: Mask, center_px: Float, side_px: float) -> _Blocks:
    """Blocks of some pixels (rows, columns) of an image."""
    rows, columns = np.nonzero(pixels)
    places = np.stack([columns, rows], axis=1)
    places = np.floor((places - center_px) / side_px).astype(np.int64)
    low = places.min(axis=0)
    along, down = (places - low).T
    height = int(down.max()) + 1
    key = along * height + down
    count = np.bincount(key)
    present = np.flatnonzero(count)
    ranks = np.cumsum(count > 0) - 1
    cells, number = low + np.stack(np.divmod(present, height), axis=1), ranks[key]
    return _Blocks(rows=rows, columns=columns, number=number, cells=cells)


def _placed(light: BodyLight, template: Template, center_px: Float) -> Float:
    """Signal (rows, columns) of a template whose center of light is laid on that of the image, DN."""
    expected = light.expected_dn(template.brightness)
    kept = np.where(expected > light.threshold_dn, expected, 0.0)
    kept = kept if kept.any() else expected
    own = np.array([kept.sum(axis=0) @ np.arange(kept.shape[1]), kept.sum(axis=1) @ np.arange(kept.shape[0])])
    shift = center_px - own / float(kept.sum())
    whole = np.floor(shift)
    along, down = (_taps(float(each)) for each in shift - whole)
    filtered = cv2.sepFilter2D(expected, cv2.CV_64F, along, down, borderType=cv2.BORDER_CONSTANT)
    moved = filtered.astype(np.float64, copy=False)
    rows, columns = light.region.shape
    return PixelBox(x=0, y=0, width=columns, height=rows).cut(moved, (int(whole[0]), int(whole[1])))


def _taps(share: float) -> Float:
    """Weights (7,) of the pixels around one in an image moved by a ``share`` of a pixel: a polynomial through six."""
    nodes = np.arange(-3, 3)
    others = np.tile(nodes, (6, 1))[~np.eye(6, dtype=bool)].reshape(6, 5)
    weights = ((-share - others) / (nodes[:, None] - others)).prod(axis=1)
    return np.append(weights, 0.0)


def _unexplained(light: BodyLight, expected_dn: Float, center_px: Float, blocks: _Blocks) -> tuple[Float, float]:
    """Covariance (2, 2) of the center by the residuals of the blocks, each as one sigma, and the scatter of these.

    The brightness of the body is free. Blocks that share a marking count as one; of so few, what was fitted takes out a
    good part. Markings of the limb, which no block holds, are taken to be those of the rest.
    """
    values = light.signal_dn[light.bright]
    whole, level = blocks.sums(light.signal_dn), float(blocks.sums(expected_dn).sum())  # bright pixels: above 0
    gain = float(whole.sum()) / level if level > 0.0 else 0.0
    residuals = (light.signal_dn - gain * expected_dn)[blocks.rows, blocks.columns]
    marks = np.bincount(blocks.number, residuals) / whole
    arms = np.stack([blocks.columns, blocks.rows], axis=-1) - center_px
    pulls = np.stack([np.bincount(blocks.number, residuals * arm) for arm in arms.T], axis=-1) / float(values.sum())
    rows, columns = np.nonzero(light.bright)
    lever = values[:, None] * (np.stack([columns, rows], axis=-1) - center_px)
    held = light.signal_dn[blocks.rows, blocks.columns][:, None] * arms
    outside = math.sqrt(float((lever**2).sum()) / max(float((held**2).sum()), 1e-300))
    shared = blocks.clustering(marks)
    fitted = min(_FITTED * shared / len(marks), _MOST_FITTED)
    photon = blocks.photon(light) / whole**2
    scatter = math.sqrt(max(float(np.mean(marks**2 - photon)), 0.0))
    return np.asarray(shared * outside**2 / (1.0 - fitted) * pulls.T @ pulls), scatter
