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
LEAST_COSINE = 0.5  # of the angle from the middle of the plane: images of other skies do not link
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
    ets = np.array([one.et for one in sequence])
    planes = [TangentPlane.from_residuals(one) for one in sequence]
    chip = [_Places(one.points_px, one.covariance_px2 + FLOOR_PX**2 * np.eye(2), _find_unsure(one)) for one in sequence]
    sky = [[_place_on_sky(one, plane) for one in sequence] for plane in planes]  # a row as each image sees the others
    on_sky = [_find_staying(ets, k, places) for k, places in enumerate(sky)]
    on_chip = [_find_staying(ets, k, chip) for k in range(len(sequence))]
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
        elsewhere = [other.directions_inertial[on_sky[j]] for j, other in enumerate(sequence) if j != k]
        stars = rotate(one.camera_from_inertial, np.concatenate(elsewhere))
        places = one.camera.model.project(stars) if len(stars) else stars[:, :2]
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


def _find_unsure(one: Residuals) -> Mask:
    return np.isin(one.kinds, _UNSURE)


def _place_on_sky(one: Residuals, plane: TangentPlane) -> _Places:
    """Sources of an image on a plane: none of those far from where it touches the sky."""
    spread, common = plane.covariances(one, FLOOR_PX)
    near = one.directions_inertial @ plane.axes[2] > LEAST_COSINE
    return _Places(plane.project(one.directions_inertial)[near], (spread + common)[near], _find_unsure(one)[near])


def _find_staying(ets: Float, k: int, places: Sequence[_Places]) -> Mask:
    """Sources (n,) of image k that another image has at the same place, and that do not drift from it."""
    here = places[k]
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
    return np.asarray((seen > 0) & ~moving & here.unsure)
