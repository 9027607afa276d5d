"""Deviation of the reflectance law of a body from the assumed one, estimated from the brightness of its parts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from giantlike.core.arrays import Float, Mask
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.ray_tracing import Template
from giantlike.relative.light.light_sums import mix_laws
from giantlike.relative.light.separation import SeparatedLight, kept_center_of, seen_from

LAW_SHARE_SIGMA = 1.0 / math.sqrt(6.0)
"""A priori standard deviation of each share: the difference of the true law and the assumed one.

Both are uniform between Lommel-Seeliger and Lambert. The phase slope of their brightness, 1/rad, is uniform between 0
(those two) and 1 (Hapke's law of dark ground from 10 to 90 degrees), and so is the rate of their transition from one
law to the other (McEwen's: 0.74 at 15 degrees).
"""
_SHARES = 3  # number of terms by which a law may differ: see :class:`LawMixture`
_BLOCK = 0.25  # side of a block relative to the radius of the body: larger markings are few
_LEAST_BLOCKS = 8
"""Minimum number of blocks, and of pairs of neighbors, to estimate markings: their scatter is then known to 25 %."""
_LARGEST_SHARE = 0.5
"""Largest marking relative to the body. A larger one is the brightness as a whole, which moves no center."""
_LIMB, _LIMB_PX, _COVERED = 0.02, 2, 0.999
"""Margin within the outline that blocks leave out, in radii and px, for errors of range and PSF; and minimum fraction
of a pixel that the body covers there."""
_FITTED = 4  # fitted parameters that absorb markings: brightness, position (two) and law
_MOST_FITTED = 0.75  # maximum fraction of the variance of markings that these absorb, so that residuals still show them
_ROUNDS, _SETTLED, _STEP = 5, 0.02, 0.1
"""Maximum number of outer (new images) and inner (new errors) iterations of the nearly linear fit; change relative to
its standard deviation at convergence; and step of the numerical derivatives, as a fraction between laws."""
_LINEAR = 0.1  # change of a share above which derivatives are recomputed; with those at 0 distant laws do not converge
_GROWN = 0.003  # relative step of the size for numerical derivatives: some tenths of a pixel
_MOST = 1.0  # largest share: one of the laws instead of the other


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LawMixture(Value):
    """A body under the assumed law, and the changes by other laws, from a flat one to one dark at the terminator.

    changes: (3, h, w); brightness under Lambert's law minus that under the law of Lommel and Seeliger, each normalized
        to sum 1; and, rad, the normalized brightness under the assumed law, and the first change, both times the phase
        angle of each pixel minus that at the center.

    The phase angle differs from limb to limb by the angular diameter of the body. On one of 300 px and 3.4 degrees, at
    a phase of 15 degrees, McEwen's law moves the center of light by 0.45 px by that alone; the laws of Lambert and of
    Lommel and Seeliger do not.
    """

    own: Template  # under the law that is assumed
    changes: Float

    @classmethod
    def from_template(cls, own: Template, *, flat: Float, dark: Float, phase_per_px: Float) -> LawMixture:
        """Return the mixture of brightness (h, w) under a flat law and under one dark towards the terminator.

        ``phase_per_px`` (2,), rad, is the change of the phase angle from pixel to pixel.
        """
        rows, columns = own.brightness.shape
        x, y = own.corner_px - own.center_px
        beyond = phase_per_px[0] * (np.arange(columns) + x) + phase_per_px[1] * (np.arange(rows) + y)[:, None]
        change = dark / float(dark.sum()) - flat / float(flat.sum())
        share = own.brightness / float(own.brightness.sum())
        return cls(own=own, changes=np.stack([change, beyond * share, beyond * change]))

    def map_images(self, of_image: Callable[[Float], Float]) -> LawMixture:
        """Return the mixture after a linear map of images (h, w)."""
        own = replace(self.own, brightness=np.maximum(of_image(self.own.brightness), 0.0))
        return LawMixture(own=own, changes=np.stack([of_image(each) for each in self.changes]))

    def resize(self, scale: float) -> LawMixture:
        """Return the body larger by a factor about its center."""
        return self if scale == 1.0 else self.map_images(_make_resizer(self.own, scale))

    def seen_from(self, corner_px: NDArray[np.int64]) -> LawMixture:
        """Return the mixture in coordinates that start at a pixel (2,)."""
        return replace(self, own=seen_from(self.own, corner_px))

    def at(self, shares: Float) -> Template:
        """Return the body under the assumed law plus a share of each change.

        ``shares`` (3,); the first, toward the dark law, keeps the total light. The others are per rad.
        """
        own, changes = np.ascontiguousarray(self.own.brightness), np.ascontiguousarray(self.changes)
        return replace(self.own, brightness=mix_laws(own, changes, shares * float(own.sum())))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LawFit(Value):
    """Reflectance law estimated from the light of a body.

    by_size_px: (2,); derivative of the correction by the relative size, including the law estimated for that size.
    unexplained_px2: (2, 2); covariance of the center of light by residuals of the law: markings, or another kind of
        law.
    """

    shares: Float  # (3,); of the mixture
    sigma: float  # standard deviation of the first share
    covariance_px2: Float  # of the correction, by the errors of the shares
    by_size_px: Float
    template: Template  # the body under the law found
    unexplained_px2: Float
    markings: float  # relative standard deviation of the brightness of blocks about the template, without photon noise
    unexplained: float  # norm of image minus template divided by the norm of the light of the body, without noise
    residuals: Float  # (n,); image minus template in the bright pixels, divided by the brightest pixel of the template


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _LawBlocks(Value):
    """Pixels (n,) of the body in row-major order, the block of each, and the positions (blocks, 2) of the blocks.

    ``places`` are flat indices of the pixels.
    """

    places: NDArray[np.int64]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    number: NDArray[np.int64]
    cells: NDArray[np.int64]

    def count_clustered(self, marks: Float) -> float:
        """Number of blocks that share a marking, from the correlation of the marks (blocks,) of neighbors.

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
        return np.bincount(self.number, values.ravel().take(self.places)).astype(np.float64)

    def photon(self, light: SeparatedLight) -> Float:
        """Variance (blocks,), DN^2, of the light of the blocks by the noise of the pixels."""
        signal = light.signal_dn[self.rows, self.columns]
        return np.bincount(self.number, light.variance_dn2(signal)).astype(np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Weighing(Value):
    """Light (blocks,) of the image, and its photon variance."""

    blocks: _LawBlocks
    light_dn: Float
    photon_dn2: Float

    def solve(self, expected_dn: Float, changes_dn: Float, at: Float, *, first: bool) -> tuple[Float, Float, Float]:
        """Shares (3,), their covariance, and their derivatives by errors of the light (3, blocks).

        From the light (blocks,) expected at some shares and its changes (3, blocks) by them. The first time
        without the prior of the first share: residuals of a wrong law look like markings, which lower its weight.
        """
        photon, gains = self.photon_dn2, np.zeros_like(changes_dn)
        found: Float = at
        covariance: Float = np.eye(_SHARES)
        for number in range(_ROUNDS):
            expected = expected_dn + (found - at) @ changes_dn
            left, level = self.light_dn - expected, np.maximum(expected, np.sqrt(photon))
            # The range, and with it the brightness, is not exact.
            left = left - float(left.sum()) / float(level.sum()) * level
            slopes = changes_dn - np.outer(changes_dn.sum(axis=1) / float(level.sum()), level)
            marked = max(float(np.sum(left**2 - photon)), 0.0) / float(np.sum(level**2))
            errors = photon + marked * self.blocks.count_clustered(left / level) * level**2
            prior = np.full(_SHARES, 1.0 / LAW_SHARE_SIGMA**2)
            if first and number == 0:
                prior[0] = 1e-12
            covariance = np.asarray(np.linalg.inv((slopes / errors) @ slopes.T + np.diag(prior)), dtype=np.float64)
            gains = covariance @ (slopes / errors)
            change = gains @ left - covariance @ (found * prior)
            before, found = found, np.clip(found + change, -_MOST, _MOST)
            if number > 0 and _has_converged(found - before, covariance):
                break
        return found, covariance, gains - (gains @ level)[:, None] / float(level.sum())


def resize_template(template: Template, scale: float) -> Template:
    """Return a template of a body that is larger by a factor about its center."""
    return replace(template, brightness=np.maximum(_make_resizer(template, scale)(template.brightness), 0.0))


def _make_resizer(template: Template, scale: float) -> Callable[[Float], Float]:
    """Map of images (h, w) on the pixels of a template that makes them larger about its center."""
    along, down = (
        _interpolation(at + (np.arange(count) - at) / scale, count)
        for at, count in zip(template.center_px - template.corner_px, template.brightness.shape[::-1], strict=True)
    )
    return lambda image: np.ascontiguousarray((along @ np.ascontiguousarray((down @ image).T)).T)


def _has_converged(change: Float, covariance: Float) -> bool:
    return bool((np.abs(change) < _SETTLED * np.sqrt(np.diag(covariance))).all())


def fit_law(light: SeparatedLight, laws: LawMixture, *, radius_px: float) -> LawFit:
    """Fit the shares of a mixture of laws to the brightness of blocks of the body.

    Each block has photon noise and its own albedo, whose scatter is estimated from the residuals. The body is placed by
    its center of light under each law, so that no limb is needed.
    """
    threshold_dn = light.threshold_dn
    center, steps = light.center_px(threshold_dn), _STEP * np.eye(_SHARES)
    blocks = _blocks_of(light, laws.own, center, radius_px)
    problem = _Weighing(blocks=blocks, light_dn=blocks.sums(light.signal_dn), photon_dn2=blocks.photon(light))
    shares, template, changes_at = np.zeros(_SHARES), laws.own, np.full(_SHARES, np.inf)
    changes_dn, slopes_px = np.zeros((_SHARES, len(blocks.cells))), np.zeros((_SHARES, 2))
    expected, place_px = _place_template(light, template, center)
    for number in range(_ROUNDS):
        expected_dn = blocks.sums(expected)
        if np.abs(shares - changes_at).max() > _LINEAR:
            moved = [_place_template(light, laws.at(shares + step), center) for step in steps]
            changes_dn = (np.array([blocks.sums(image) for image, _ in moved]) - expected_dn) / _STEP
            changes_at, slopes_px = shares, (place_px - np.array([place for _, place in moved])) / _STEP
        found, covariance, gains = problem.solve(expected_dn, changes_dn, shares, first=number == 0)
        if _has_converged(found - shares, covariance):
            break
        shares, template = found, laws.at(found)
        expected, place_px = _place_template(light, template, center)
    larger, larger_px = _place_template(light, resize_template(template, 1.0 + _GROWN), center)
    by_size = gains @ (blocks.sums(larger) - blocks.sums(expected)) / _GROWN
    by_size_px = (place_px - larger_px) / _GROWN - slopes_px.T @ by_size
    residuals = light.signal_dn - expected
    unexplained_px2, markings = _estimate_scatter(light, expected, center, blocks)
    seen = light.signal_dn[light.region]
    excess = float((residuals[light.region] ** 2 - light.variance_dn2(np.maximum(seen, 0.0))).sum())
    return LawFit(
        shares=shares,
        sigma=math.sqrt(float(covariance[0, 0])),
        covariance_px2=slopes_px.T @ covariance @ slopes_px,
        by_size_px=by_size_px,
        template=template,
        unexplained_px2=unexplained_px2,
        markings=markings,
        unexplained=math.sqrt(max(excess, 0.0) / float((seen**2).sum())),
        residuals=residuals[light.bright] / float(expected.max()),
    )


def _blocks_of(light: SeparatedLight, template: Template, center_px: Float, radius_px: float) -> _LawBlocks:
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


def _in_blocks(pixels: Mask, center_px: Float, side_px: float) -> _LawBlocks:
    """Blocks of some pixels (rows, columns) of an image."""
    places = np.flatnonzero(pixels)
    rows, columns = np.divmod(places, pixels.shape[1])
    along, down = (
        np.floor((each - middle) / side_px).astype(np.int64)
        for each, middle in zip((columns, rows), center_px.tolist(), strict=True)
    )
    low = np.array([along.min(), down.min()])
    along, down = along - low[0], down - low[1]
    height = int(down.max()) + 1
    key = along * height + down
    count = np.bincount(key)
    present = np.flatnonzero(count)
    ranks = np.cumsum(count > 0) - 1
    cells, number = low + np.stack(np.divmod(present, height), axis=1), ranks[key]
    return _LawBlocks(places=places, rows=rows, columns=columns, number=number, cells=cells)


def _place_template(light: SeparatedLight, template: Template, center_px: Float) -> tuple[Float, Float]:
    """Signal (rows, columns), DN, of a template laid on the center of light of the image, and its own center (2,)."""
    expected = light.expected_dn(template.brightness)
    place_px = kept_center_of(expected, light.threshold_dn)
    shift = center_px - place_px
    whole = np.floor(shift)
    along, down = (_taps(float(each)) for each in shift - whole)
    filtered = cv2.sepFilter2D(expected, cv2.CV_64F, along, down, borderType=cv2.BORDER_CONSTANT)
    moved = filtered.astype(np.float64, copy=False)
    rows, columns = light.region.shape
    box = PixelBox(x=0, y=0, width=columns, height=rows)
    return box.cut(moved, (int(whole[0]), int(whole[1]))), place_px


def _taps(share: float) -> Float:
    """Weights (7,) of the pixels around one in an image moved by a ``share`` of a pixel: a polynomial through six."""
    return np.append(_through_six(np.array([-share]), first=-3)[0], 0.0)


def _interpolation(places: Float, count: int) -> csr_matrix[np.float64]:
    """Matrix (n, count) that gives values at ``places`` (n,) along a line of ``count`` pixels, dark beyond its ends."""
    whole = np.floor(places).astype(np.int64)
    columns = whole[:, None] + np.arange(-2, 4)
    weights = np.where((columns >= 0) & (columns < count), _through_six(places - whole, first=-2), 0.0)
    starts = np.arange(0, columns.size + 1, columns.shape[1])
    return csr_matrix((weights.ravel(), np.clip(columns, 0, count - 1).ravel(), starts), shape=(len(places), count))


def _through_six(places: Float, *, first: int) -> Float:
    """Weights (n, 6) at ``places`` (n,) of the polynomial through six values from pixel ``first`` on."""
    nodes = np.arange(first, first + 6)
    others = np.tile(nodes, (6, 1))[~np.eye(6, dtype=bool)].reshape(6, 5)
    return np.asarray(((places[:, None, None] - others) / (nodes[:, None] - others)).prod(axis=-1))


def _estimate_scatter(
    light: SeparatedLight, expected_dn: Float, center_px: Float, blocks: _LawBlocks
) -> tuple[Float, float]:
    """Covariance (2, 2) of the center by the residuals of the blocks, each as one sigma, and their scatter.

    The brightness of the body is free. Blocks that share a marking count as one; with few of them the fitted parameters
    absorb a good part. Markings of the limb, which no block holds, are assumed to be as in the rest.
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
    shared = blocks.count_clustered(marks)
    fitted = min(_FITTED * shared / len(marks), _MOST_FITTED)
    photon = blocks.photon(light) / whole**2
    scatter = math.sqrt(max(float(np.mean(marks**2 - photon)), 0.0))
    return np.asarray(shared * outside**2 / (1.0 - fitted) * pulls.T @ pulls), scatter
