"""What stays in a sequence: stars that no catalog has, and pixels of the detector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.frames import rotate
from giantlike.search.plane import TangentPlane
from giantlike.search.residuals import GATE, Residuals, SourceClass, near

FLOOR_PX = 0.1
"""Error of a place beyond the stated one, per axis: pixels are not Gaussian, and distortion changes over the field."""
_MOVED_PX = 2.0  # of the sky over the detector: a star has then left the pixels that it lit
_UNSURE = [SourceClass.UNKNOWN, SourceClass.BLEND, SourceClass.HOT_PIXEL, SourceClass.COSMIC_RAY]
_FARTHEST_PX = 3.0  # from a place, where a source is the same: attitudes that are worse link anything


def compare_residuals(sequence: Sequence[Residuals]) -> list[Residuals]:
    """Find what stays in a sequence: stars that no catalog has, at one place of the sky, and pixels of the detector.

    Parameters
    ----------
    sequence : sequence of Residuals
        In any order, of one camera.

    Returns
    -------
    list of Residuals
        Unknown sources that are seen again where they were are ``uncataloged_star``, or ``hot_pixel`` where the sky
        has moved over the detector. Those that move significantly, if only over the whole sequence, remain unknown.
        Sources beside a star seen in other images are ``blend``.

    Raises
    ------
    InputError
        The images are of several cameras.
    """
    if len(sequence) < 2:
        return list(sequence)
    one_size = len({(one.camera.columns, one.camera.rows, one.camera.name) for one in sequence}) == 1
    require(one_size, "a sequence needs images of one camera: search those of each camera on their own")
    plane = TangentPlane.from_residuals(sequence[0])
    ets = np.array([one.et for one in sequence])
    sky, chip = [], []
    for one in sequence:
        spread, common = plane.covariances(one, FLOOR_PX)
        unsure = np.isin(one.kinds, _UNSURE)
        sky.append(_Places(plane.project(one.directions_inertial), spread + common, unsure))
        chip.append(_Places(one.points_px, one.covariance_px2 + FLOOR_PX**2 * np.eye(2), unsure))
    on_sky, on_chip = (_find_staying(ets, places) for places in (sky, chip))
    result = []
    for k, one in enumerate(sequence):
        kinds, covered = one.kinds.copy(), one.covered
        looks = [
            rotate(one.camera_from_inertial * other.camera_from_inertial.inv(), [0.0, 0.0, 1.0]) for other in sequence
        ]
        moved = np.linalg.norm(
            one.camera.model.project(np.array(looks)) - one.camera.model.project([0.0, 0.0, 1.0]), axis=1
        )
        kinds[on_sky[k]] = SourceClass.UNCATALOGED_STAR
        kinds[on_chip[k] & ~on_sky[k] & bool(np.nanmax(moved) > _MOVED_PX)] = SourceClass.HOT_PIXEL
        elsewhere = [sky[j].points_px[on_sky[j]] for j in range(len(sequence)) if j != k]
        stars = plane.unproject(np.concatenate(elsewhere))
        places = one.camera.model.project(rotate(one.camera_from_inertial, stars)) if len(stars) else stars[:, :2]
        places = places[np.isfinite(places).all(axis=1)]
        if len(places):
            beside = cKDTree(places).query(one.points_px)[0] < one.reach_px
            kinds[beside & (kinds == SourceClass.UNKNOWN)] = SourceClass.BLEND
            covered = covered | near(covered.shape, places, one.reach_px)
        linkable = one.linkable & (kinds == SourceClass.UNKNOWN)
        result.append(replace(one, kinds=kinds, linkable=linkable, covered=covered))
    return result


@dataclass(frozen=True, slots=True)
class _Places:
    """Places (n, 2) of the sources of an image with covariances (n, 2, 2), and those (n,) that may be found to stay."""

    points_px: Float
    covariance_px2: Float
    unsure: Mask


def _find_staying(ets: Float, places: Sequence[_Places]) -> list[Mask]:
    """Sources (n,) of each image that another image has at the same place, and that do not drift from it."""
    result = []
    for k, here in enumerate(places):
        n = len(here.points_px)
        sums = np.zeros((n, 2, 4))  # by axis: weights, their times, squared times, and products of time and shift
        shifted = np.zeros((n, 2))
        seen = np.zeros(n, dtype=int)
        for j, there in enumerate(places):
            if j == k or not n or not len(there.points_px):
                continue
            distance, nearest = cKDTree(there.points_px).query(here.points_px)
            apart = there.points_px[nearest] - here.points_px
            spread = here.covariance_px2 + there.covariance_px2[nearest]
            chi2 = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(spread), apart)
            same = (chi2 < GATE) & (distance < _FARTHEST_PX)
            weight = same[:, None] / np.einsum("nii->ni", there.covariance_px2[nearest])
            after = ets[j] - ets[k]
            sums += np.stack([weight, weight * after, weight * after**2, weight * after * apart], axis=2)
            shifted += weight * apart
            seen += same
        own = 1.0 / np.einsum("nii->ni", here.covariance_px2) if n else np.zeros((0, 2))
        weight, first, second, product = np.moveaxis(sums, 2, 0)
        weight = weight + own  # the source itself, at no distance in time and place
        scale = np.maximum(second - first**2 / weight, 1e-300)
        drift = (product - first * shifted / weight) ** 2 / scale
        moving = (seen >= 2) & (drift.sum(axis=1) > GATE)
        result.append((seen > 0) & ~moving & here.unsure)
    return result
