"""The light of one resolved body, separated from the sky background and from other bodies."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.pixel_box import BoxPixels, PixelBox
from giantlike.core.values import Value
from giantlike.processing.limb.segmentation import Blobs, ExpectedBlob, connected_blobs, identify_blobs, otsu_threshold
from giantlike.ray_tracing import Template
from giantlike.relative.light.light_sums import kept_center
from giantlike.relative.light.sky import SKY_SAMPLE, SkyPlane

LIGHT_SIGMAS = 5.0  # standard deviations of the sky above which a pixel is light: noise exceeds it once in 3.5 million
MIN_AREA_PX = 4  # minimum area of a blob of light, px: hits and hot pixels are smaller
TRACE = 0.002  # fraction of the brightest pixel of a template above which light of the body counts
_MIN_BACKGROUND_PX = 100  # px: their median is then known to an eighth of the noise
_VISIBLE, _MOST_VISIBLE = 0.02, 0.5  # of the brightest pixel of a template: its expected blob, by the noise of the sky
_MOST_AREA = 2.0  # of the expected area: larger light that touches the frame is not a body cut by the frame
_REGION_MARGIN, _REGION_MARGIN_PX = 0.05, 3  # of the radius and px, for errors of range and law
_OTSU_MARGIN = 0.25  # of the radius, for enough dark pixels
_MAX_SATURATED = 0.95
"""Maximum fraction of saturated bright pixels; above, the rim that is left does not show the brightness of the body."""
_WINDOW_MARGIN_PX = 16  # around the searched region: the point spread function, and sky
_SETTLING, _SETTLED_PX = 4, 2
"""Maximum number of iterations in which the region follows its light, and motion, px, at convergence: less than the
margin of the region."""
_FILL_SIDES_PX, _FILL_SHARE = (65, 17, 5), 0.1
"""Sides, px, of the squares whose good pixels fill bad ones, and minimum fraction of good pixels in a square; the
smallest square that reaches it is used."""
_CUT = 1.0
"""Width of the threshold relative to it. Errors perpendicular to the direction of the Sun, for exact ellipsoids of 120
px at 90 and 125 degrees of phase, are 0.060 and 0.140 px with a sharp threshold, 0.021 and 0.052 with 1, and 0.021 and
0.042 with 1.6."""
_ROUNDING = 1e-3  # px, of distances
_GAIN_ROUNDS = 30  # halvings in which the gain of a clipped body is found: to a billionth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prediction(Value):
    """The body as predicted: center, mean and largest radius, px, its light and the light of the other targets."""

    center_px: Float
    radius_px: float
    reach_px: float
    search_px: float
    template: Template
    others: list[ExpectedBlob]

    def seen_from(self, corner_px: NDArray[np.int64]) -> Prediction:
        """Return the prediction in coordinates that start at a pixel (2,)."""
        others = [
            replace(one, center_px=(one.center_px[0] - int(corner_px[0]), one.center_px[1] - int(corner_px[1])))
            for one in self.others
        ]
        return replace(
            self, center_px=self.center_px - corner_px, template=seen_from(self.template, corner_px), others=others
        )

    def window(self, columns: int, rows: int) -> PixelBox:
        """Part of a frame within which the light of all targets is searched, with sky around the body."""
        margin = (1.0 + _REGION_MARGIN + _OTSU_MARGIN) * self.reach_px + self.search_px + _WINDOW_MARGIN_PX
        low, high = self.center_px - margin, self.center_px + margin
        for one in self.others:
            reach = math.sqrt(one.area_px) + self.search_px + _WINDOW_MARGIN_PX
            center = np.array(one.center_px)
            low, high = np.minimum(low, center - reach), np.maximum(high, center + reach)
        return PixelBox.spanning(low, high).clip(columns, rows)


def seen_from(template: Template, corner_px: NDArray[np.int64]) -> Template:
    """Return a template in coordinates that start at a pixel."""
    return replace(
        template,
        corner_px=template.corner_px - corner_px,
        center_px=template.center_px - corner_px,
        photocenter_px=template.photocenter_px - corner_px,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeparatedLight(Value):
    """The light of one body in a window of the image; positions are relative to the first pixel of the window."""

    corner_px: NDArray[np.int64]  # first pixel of the window in the image
    signal_dn: Float  # (rows, columns); sky subtracted, bad pixels filled
    region: Mask  # (rows, columns); pixels whose light is attributed to the body
    total_dn: float  # sum of their signal
    expected: Mask  # (rows, columns); pixels where light of the body is expected, with a margin
    threshold_dn: float  # otsu's, above background
    ceiling_dn: float  # minimum signal of a saturated pixel; infinite without one
    sky: SkyPlane
    noise_variance_dn2: Callable[[Float], Float]  # variance, DN^2, of the noise of pixels of a given signal
    shift_px: NDArray[np.int64]  # from a template at the predicted position to the light
    bad: Mask  # pixels that were filled

    @property
    def bright(self) -> Mask:
        """Pixels of the body above threshold."""
        return np.asarray(self.region & (self.signal_dn > self.threshold_dn))

    def trim(self) -> SeparatedLight:
        """Return the light in the smallest window that holds the region and some sky around it."""
        columns, rows = (np.flatnonzero(self.region.any(axis=axis)) for axis in (0, 1))
        low = np.array([columns[0], rows[0]], dtype=np.float64)
        high = np.array([columns[-1], rows[-1]], dtype=np.float64) + 1.0
        box = PixelBox.spanning(low, high, _WINDOW_MARGIN_PX).clip(*self.region.shape[::-1])
        corner = np.array(box.corner_px)
        return replace(
            self,
            corner_px=self.corner_px + corner,
            signal_dn=self.signal_dn[box.slices],
            region=self.region[box.slices],
            expected=self.expected[box.slices],
            bad=self.bad[box.slices],
            sky=self.sky.seen_from(corner),
        )

    def center_px(self, threshold_dn: float) -> Float:
        """Center (2,), px, of the light above a threshold, DN."""
        return center_of(self.region * kept_light(self.signal_dn, threshold_dn))

    def variance_dn2(self, signal_dn: Float) -> Float:
        """Variance of the noise of pixels (n,), DN^2: shot noise, and the measured noise of the sky."""
        shot = self.noise_variance_dn2(signal_dn) - float(self.noise_variance_dn2(np.zeros(1))[0])
        return np.asarray(shot + self.sky.sigma_dn**2)

    def centroid(self, threshold_dn: float) -> tuple[Float, Float, Float]:
        """Center of the light above a threshold.

        Returns ``center_px``; ``noise_px2`` (2, 2), covariance by the noise of the pixels; ``background_px2`` (2, 2),
        covariance by the errors of the background plane, and by the curvature of the sky, as one sigma.
        """
        rows, columns = np.nonzero(self.region & (self.signal_dn > (1.0 - 0.5 * _CUT) * threshold_dn))
        signal = self.signal_dn[rows, columns]
        values = kept_light(signal, threshold_dn)
        pixels = np.stack([columns, rows], axis=1).astype(np.float64)
        center = values @ pixels / values.sum()
        share = values / signal
        slope = share + np.where(share < 1.0, signal / (_CUT * threshold_dn), 0.0)
        arms = (pixels - center) * slope[:, None] / values.sum()
        noise = (arms * self.variance_dn2(signal)[:, None]).T @ arms
        lever = arms.T @ self.sky.basis(pixels[:, 0], pixels[:, 1])
        bend = lever @ self.sky.bend_dn
        return center, noise, lever[:, :3] @ self.sky.covariance_dn2 @ lever[:, :3].T + np.outer(bend, bend)

    def expected_dn(self, brightness: Float, *, brighter: float = 1.0) -> Float:
        """Signal of a template, scaled to all of the light and clipped where the image is.

        ``brightness`` (h, w); ``brighter``: factor on it before it is clipped; returns (h, w).
        """
        total = self.total_dn
        gain = total / float(brightness.sum())
        if math.isinf(self.ceiling_dn):
            return gain * brighter * brightness
        low, high = gain, 100.0 * gain
        for _ in range(_GAIN_ROUNDS):
            gain = math.sqrt(low * high)
            below = float(np.minimum(gain * brightness, self.ceiling_dn).sum()) < total
            low, high = (gain, high) if below else (low, gain)
        return np.minimum(gain * brighter * brightness, self.ceiling_dn)

    def offset_px(
        self, template: Template, threshold_dn: float, *, brighter: float = 1.0, filled: bool = True
    ) -> Float:
        """From the center of a template's light, cut and filled like the image, to the center of its body.

        ``brighter`` as for :meth:`expected_dn`; returns (2,).
        """
        expected = self.expected_dn(template.brightness, brighter=brighter)
        if filled and self.bad.any():
            x, y = (template.corner_px + self.shift_px).tolist()
            box = PixelBox(x=x, y=y, width=expected.shape[1], height=expected.shape[0])
            expected = _fill_bad_pixels(expected, box.cut(self.bad))
        return np.asarray(template.center_px - kept_center_of(expected, threshold_dn) - template.corner_px)


def kept_light(signal_dn: Float, threshold_dn: float) -> Float:
    """Light weighted by a soft threshold: 0 below half of it, 1 from one and a half on, and a ramp between.

    ``signal_dn`` (...); returns (...) DN.

    With a sharp threshold the center of a crescent of 120 px moves by 0.1 px with the subpixel position of the body.
    See :data:`_CUT`.
    """
    share = (signal_dn - (1.0 - 0.5 * _CUT) * threshold_dn) / (_CUT * threshold_dn)
    np.clip(share, 0.0, 1.0, out=share)
    share *= signal_dn
    return share


def center_of(light: Float) -> Float:
    """Return the center (2,), px, of an image (h, w)."""
    by_column, by_row = light.sum(axis=0), light.sum(axis=1)
    along = np.array([by_column @ np.arange(by_column.size), by_row @ np.arange(by_row.size)])
    return np.asarray(along / float(by_column.sum()))


def kept_center_of(light: Float, threshold_dn: float) -> Float:
    """Return the center (2,), px, of the light (h, w) above a soft threshold; of all light if none is above."""
    x, y, total = kept_center(np.ascontiguousarray(light), threshold_dn, _CUT)
    return np.array([x, y]) if total > 0.0 else center_of(light)


def separate_light(image: BoxPixels, bad: Mask, saturated: Mask, prediction: Prediction) -> SeparatedLight | Failure:
    """Find the light of the body and separate it from the sky background and from other bodies."""
    sky = _sky(image, prediction)
    if isinstance(sky, Failure):
        return sky
    rows, columns = image.usable.shape
    frame = PixelBox(x=0, y=0, width=columns, height=rows)
    for box in (prediction.window(columns, rows), frame):
        window = _Window(
            image=image.cut(box),
            bad=box.cut(bad),
            saturated=box.cut(saturated),
            frame=replace(frame, x=-box.x, y=-box.y),
        )
        corner = np.array(box.corner_px)
        light = _light_in(window, sky.seen_from(corner), prediction.seen_from(corner))
        if light is not None:
            return light
    return Failure(Reason.NO_SIGNAL, "the light that was taken for the body leads out of the image")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Window(Value):
    """Part of an image; ``frame`` is the whole of it in coordinates of the part."""

    image: BoxPixels
    bad: Mask
    saturated: Mask
    frame: PixelBox

    def meets_frame(self, pixels: Mask) -> bool:
        """Return True if a pixel on the edge of the image is set."""
        return self._meets(pixels, self.frame)

    def touch_frame(self, blobs: Blobs) -> Mask:
        """Find the blobs (n,) that lie on an edge of the image."""
        frame, low, size = self.frame, blobs.boxes_px[:, :2], blobs.boxes_px[:, 2:]
        first = np.array(frame.corner_px)
        touch = (low <= first) | (low + size >= first + np.array([frame.width, frame.height]))
        return np.asarray(touch.any(axis=1))

    def cuts(self, pixels: Mask) -> bool:
        """Return True if a pixel on the edge of the part is set which is not on the edge of the image."""
        return self._meets(pixels, None)

    def _meets(self, pixels: Mask, frame: PixelBox | None) -> bool:
        rows, columns = pixels.shape
        of_frame = (
            self.frame.x == 0,
            self.frame.y == 0,
            self.frame.x + self.frame.width == columns,
            self.frame.y + self.frame.height == rows,
        )
        edges = (pixels[:, 0], pixels[0], pixels[:, -1], pixels[-1])
        return any(bool(edge.any()) for edge, its in zip(edges, of_frame, strict=True) if its == (frame is not None))


def _light_in(window: _Window, sky: SkyPlane, prediction: Prediction) -> SeparatedLight | Failure | None:
    """Light of the body in a window, all in its coordinates; None where it reaches beyond it."""
    template, bad, saturated = prediction.template, window.bad, window.saturated
    signal = _fill_bad_pixels(window.image.values_dn, bad) - sky.levels_dn(bad.shape)
    chosen = _blob_of(signal, sky, prediction, window)
    if chosen is None or isinstance(chosen, Failure):
        return chosen
    blob, foreign, place_px = chosen
    ceiling = float(signal[saturated].min()) if saturated.any() else math.inf
    shift = np.rint(place_px - template.photocenter_px).astype(np.int64)
    for _ in range(_SETTLING):
        region, expected, around = _regions(template, shift, blob, prediction.radius_px)
        if window.cuts(region) or not region.any():
            return None
        region = region & ~foreign
        light = SeparatedLight(
            corner_px=np.array(window.image.corner_px),
            signal_dn=signal,
            region=region,
            total_dn=float(signal.sum(where=region)),
            expected=expected,
            threshold_dn=max(otsu_threshold(signal[around][~foreign[around]]), sky.sigma_dn),
            ceiling_dn=ceiling,
            sky=sky,
            noise_variance_dn2=window.image.noise_variance_dn2,
            shift_px=shift,
            bad=bad,
        )
        bright = light.bright
        if not bright.any():
            return Failure(Reason.NO_SIGNAL, f"no pixel is above {light.threshold_dn:.4g} DN over background")
        if light.total_dn <= 0.0:
            return Failure(
                Reason.NO_SIGNAL,
                f"the {np.count_nonzero(region)} pixels of the body are {light.total_dn:.4g} DN over background in "
                "total: more of it is dark than lit, as where blocks of the image are missing; mask these",
            )
        center = light.center_px(light.threshold_dn) + light.offset_px(template, light.threshold_dn)
        before, shift = shift, np.rint(center - template.center_px).astype(np.int64)
        if np.abs(shift - before).max() <= _SETTLED_PX:
            break
    if not blob.any() and _may_be_cut(template, window.frame, 0.0, shift):
        return _cut_by_frame()
    clipped = float(saturated[bright].mean())
    if clipped > _MAX_SATURATED:
        return Failure(
            Reason.SATURATED, f"{clipped:.0%} of the bright pixels are saturated, allowed {_MAX_SATURATED:.0%}"
        )
    return light.trim()


def _blob_of(
    signal: Float, sky: SkyPlane, prediction: Prediction, window: _Window
) -> tuple[Mask, Mask, Float] | Failure | None:
    """Pixels of the blob of the body, those of other bodies, and the center of its light (2,), px.

    None where the blob reaches beyond the window.
    """
    template, others, search_px = prediction.template, prediction.others, prediction.search_px
    light = signal > LIGHT_SIGMAS * sky.sigma_dn
    blobs = connected_blobs(signal, light, min_area_px=MIN_AREA_PX)
    rows, columns = np.ogrid[: signal.shape[0], : signal.shape[1]]
    reach_px = prediction.reach_px + search_px
    near = (columns - prediction.center_px[0]) ** 2 + (rows - prediction.center_px[1]) ** 2 < reach_px**2
    peak_dn = float(signal[near & light].max(initial=0.0))
    least = LIGHT_SIGMAS * sky.sigma_dn / peak_dn if peak_dn > 0.0 else 0.0
    visible = template.brightness > min(max(least, _VISIBLE), _MOST_VISIBLE) * float(template.brightness.max())
    own = ExpectedBlob(
        center_px=(float(template.photocenter_px[0]), float(template.photocenter_px[1])),
        area_px=float(np.count_nonzero(visible)),
    )
    chosen = identify_blobs(blobs, [own, *others], search_px=search_px)
    if isinstance(chosen, Failure) and chosen.reason is Reason.NO_SIGNAL and others:
        chosen = identify_blobs(blobs, [own], search_px=search_px)  # another body may be too faint, or hidden
    if isinstance(chosen, Failure):
        if window.cuts(light):
            return None
        part = window.touch_frame(blobs) & (blobs.areas_px <= _MOST_AREA * own.area_px)
        cut = chosen.reason is Reason.NO_SIGNAL and bool(part.any())
        return _cut_by_frame() if cut and _may_be_cut(template, window.frame, search_px) else chosen
    blob = int(chosen[0])
    pixels, foreign = blobs.labels == blob + 1, np.isin(blobs.labels, chosen[1:] + 1)
    if window.cuts(pixels) or window.cuts(foreign):
        return None
    if not window.meets_frame(pixels):
        return pixels, foreign, blobs.centroids_px[blob]
    thick = cv2.morphologyEx(pixels.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    if window.meets_frame(np.asarray(thick, dtype=bool)):
        return _cut_by_frame() if _may_be_cut(template, window.frame, 0.0) else _joined_to_frame()
    # Light that reaches the frame is thin, as a hot column: only the expected region counts.
    y, x = np.nonzero(pixels & near)
    place = np.array([np.median(x), np.median(y)]) if x.size else template.photocenter_px
    return np.zeros_like(pixels), foreign, place


def _cut_by_frame() -> Failure:
    return Failure(
        Reason.OUT_OF_FRAME,
        "the light of the body reaches the edge of the image; use an estimator that matches limb or template",
    )


def _joined_to_frame() -> Failure:
    return Failure(
        Reason.AMBIGUOUS,
        "light at the edge of the image is joined to that of the body, predicted inside: other light, or a body "
        "that the edge cuts; use an estimator that matches limb or template",
    )


def _may_be_cut(
    template: Template, frame: PixelBox, search_px: float, shift_px: NDArray[np.int64] | None = None
) -> bool:
    """True if the predicted light, moved as far as the search allows, would reach over the edge of the image."""
    rows, columns = np.nonzero(template.brightness > _VISIBLE * float(template.brightness.max()))
    corner = template.corner_px if shift_px is None else template.corner_px + shift_px
    first = np.array(frame.corner_px)
    low, high = np.array([columns.min(), rows.min()]) + corner, np.array([columns.max(), rows.max()]) + corner
    last = first + np.array([frame.width, frame.height]) - 1
    return bool((low < first + search_px).any() or (high > last - search_px).any())


def _sky(image: BoxPixels, prediction: Prediction) -> SkyPlane | Failure:
    """Plane through evenly spaced pixels that the body cannot reach; through all such pixels where they are few."""
    (x, y), reach_px = prediction.center_px, prediction.reach_px + prediction.search_px
    for step in (max(math.isqrt(image.usable.size // SKY_SAMPLE), 1), 1):
        usable, values = image.usable[::step, ::step], image.values_dn[::step, ::step]
        rows, columns = (step * part for part in np.ogrid[: usable.shape[0], : usable.shape[1]])
        dark = ((columns - x) ** 2 + (rows - y) ** 2 > reach_px**2) & usable
        if 4 * np.count_nonzero(dark) > SKY_SAMPLE:
            break
    count = int(np.count_nonzero(dark))
    if count < _MIN_BACKGROUND_PX:
        return Failure(
            Reason.OUT_OF_FRAME,
            f"{count} pixels lie more than {prediction.search_px:g} px from the body, needed {_MIN_BACKGROUND_PX} for "
            "a background; it fills the image",
        )
    floor = math.sqrt(float(image.noise_variance_dn2(np.zeros(1))[0]))
    return SkyPlane.through(values, dark, step_px=step, least_sigma_dn=max(0.1 * floor, 1e-9))


def _fill_bad_pixels(values_dn: Float, bad: Mask) -> Float:
    """Pixels with bad ones replaced by the mean of good neighbors."""
    if not bad.any():
        return values_dn
    result = np.where(bad, 0.0, values_dn)
    good, light = (~bad).astype(np.float64), result
    for side in _FILL_SIDES_PX:
        share = cv2.blur(good, (side, side))
        near = cv2.blur(light, (side, side)) / np.maximum(share, 1e-6)
        result = np.where(bad & (share > _FILL_SHARE), near, result)
    return np.asarray(result)


def _regions(template: Template, shift_px: NDArray[np.int64], blob: Mask, radius_px: float) -> tuple[Mask, Mask, Mask]:
    """Pixels of the body's light, pixels where it is expected, and a box with enough sky for a threshold."""
    rows, columns = blob.shape
    x, y = (template.corner_px + shift_px).tolist()
    trace = template.brightness > TRACE * float(template.brightness.max())
    expected = PixelBox(x=0, y=0, width=columns, height=rows).cut(trace, (x, y))
    margin = _REGION_MARGIN_PX + math.ceil(_REGION_MARGIN * radius_px)
    region, expected = _dilate(expected | blob, margin), _dilate(expected, margin)
    around = np.zeros(region.shape, dtype=bool)
    if region.any():
        more = math.ceil(_OTSU_MARGIN * radius_px)
        y, x = (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
        around[max(y[0] - more, 0) : y[-1] + more + 1, max(x[0] - more, 0) : x[-1] + more + 1] = True
    return region, expected, around


def _dilate(pixels: Mask, margin_px: int) -> Mask:
    """Pixels not farther than a margin from some."""
    result = np.zeros(pixels.shape, dtype=bool)
    rows, columns = (np.flatnonzero(pixels.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return result
    part = tuple(slice(max(int(each[0]) - margin_px, 0), int(each[-1]) + margin_px + 1) for each in (rows, columns))
    away = cv2.distanceTransform((~pixels[part]).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    result[part] = away <= margin_px + _ROUNDING
    return result
