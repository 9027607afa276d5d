r"""Tracks: sources of several images that lie on one path, and how many such paths unrelated sources make.

Tracks grow from pairs of sources within the largest rate, image by image. Every source within the gate of a prediction
starts another hypothesis, and so does the image in which the object may have been missed; of hypotheses that share
their last sources the best goes on. Of all that are left the disjoint ones of the least chance are kept, by an integer
program.

The chance of a track follows from the density of unrelated sources, which is counted in each image around each place
of the track. That n sources of densities :math:`\rho_k` lie on any path with a sum of squares of :math:`c` or less has
the expectation

.. math::

    \prod_k \rho_k \sqrt{\det R\, \det H^T R^{-1} H}\; A\, \pi v^2\; V_{2n - 4}(\sqrt c),

the volume that such measurements fill: of the places and rates of a path, derivatives H, with area A and largest rate
v, and a ball of as many dimensions as there are measurements left. An acceleration is an error of the places that they
have in common, part of R. The products of densities are summed over all choices of n of the images with gaps that are
allowed, and multiplied by the number of lengths of tracks that were tried.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from scipy.special import gammaln, ndtr

from giantlike.core.arrays import Float, require, require_number
from giantlike.core.frames import rotate
from giantlike.core.values import Estimate
from giantlike.search.compare import FLOOR_PX, LEAST_COSINE, compare_residuals
from giantlike.search.plane import TangentPlane
from giantlike.search.residuals import GATE, Residuals

_MOST_HYPOTHESES = 100_000  # that grow at a time, the best: bounds the time in crowded images
_MOST_PAIRS = 100_000  # of sources within the largest rate: more are refused, they tell nothing
_REGION_SHARE = 1.0 / 16.0  # of the frame around a place in which sources are counted
_REJECTED = 1.0  # expected chance tracks beyond which one is not worth listing
_DETECTED = 0.98  # most probable detection: a blend or a flaw of the detector hides some


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkOptions:
    """Options of :func:`link`.

    Parameters
    ----------
    max_rate_px_s : float, px/s; largest motion on the sky
    max_acceleration_px_s2 : float, px/s^2; largest acceleration on the sky; 0 takes all paths as straight
    min_detections : int; fewest sources of a track, 3 or more
    max_missed : int; most images in a row in which an object in the frame may be missed
    max_expected_false : float; tracks of which unrelated sources make more are listed apart

    Raises
    ------
    InputError
        A value is out of range.
    """

    max_rate_px_s: float = 0.2
    max_acceleration_px_s2: float = 0.0
    min_detections: int = 4
    max_missed: int = 2
    max_expected_false: float = 0.01

    def __post_init__(self) -> None:
        for name in ("max_rate_px_s", "max_expected_false"):
            require_number(getattr(self, name), name, above=0.0)
        require_number(self.max_acceleration_px_s2, "max_acceleration_px_s2", least=0.0)
        require(self.min_detections >= 3, f"min_detections must be >= 3, got {self.min_detections}")
        require(self.max_missed >= 0, f"max_missed must be >= 0, got {self.max_missed}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Track(Estimate):
    """Sources of one object.

    Parameters
    ----------
    images, sources : (n,) int64; indices of the images, in order of time, and of the source in each
    residuals : tuple of n Residuals; the images
    missed : tuple of str
        Names of the images between the first and the last that have the place of the object and no source there.
    expected_false : float; number of tracks as good as this one that unrelated sources make in the sequence
    accepted : bool; True where that is not more than the options allow
    chi2 : float; weighted squares of the distances from the path
    freedom : int
    et : float, TDB seconds past J2000; middle of the track, to which the path refers
    direction_inertial : (3,) float64, unitless, ICRF axes; there
    rate_px_s, acceleration_px_s2 : (2,) float64
        On the plane that touches the sky, along the columns and rows of the first image of the sequence.
    plane : TangentPlane
    places_px : (n, 2) float64, px; on the plane
    covariance_places_px2 : (n, 2, 2) float64, px^2
    """

    images: NDArray[np.int64]
    sources: NDArray[np.int64]
    residuals: tuple[Residuals, ...]
    missed: tuple[str, ...]
    expected_false: float
    accepted: bool
    chi2: float
    freedom: int
    et: float
    direction_inertial: Float
    rate_px_s: Float
    acceleration_px_s2: Float
    plane: TangentPlane
    places_px: Float
    covariance_places_px2: Float

    def __len__(self) -> int:
        return len(self.images)

    @property
    def ets(self) -> Float:
        """Epochs (n,), TDB seconds past J2000."""
        return np.array([one.et for one in self.residuals])

    def values(self, name: str) -> Float:
        """A column (n, ...) of :class:`~giantlike.search.Residuals` along the track: ``snr``, ``points_px``."""
        return np.array([getattr(one, name)[i] for one, i in zip(self.residuals, self.sources, strict=True)])


def link(residuals: Sequence[Residuals], options: LinkOptions = LinkOptions()) -> tuple[Track, ...]:
    """Link the unknown sources of a sequence to tracks.

    Parameters
    ----------
    residuals : sequence of Residuals
        In order of time, of one camera. What stays on the sky or on the detector is left out first
        (:func:`compare_residuals`).
    options : LinkOptions

    Returns
    -------
    tuple of Track
        Those of the least ``expected_false`` first; no two share a source. Fewer images than ``min_detections`` make
        none.

    Raises
    ------
    InputError
        Times are equal or go back, cameras differ, or the largest rate links so many pairs that no track means
        anything.
    """
    ets = np.array([one.et for one in residuals])
    back = np.flatnonzero(np.diff(ets) <= 0.0)
    if back.size:
        first, second = residuals[back[0]].name, residuals[back[0] + 1].name
        require(False, f"images must be in order of time, at different epochs: {second} is not after {first}")
    if len(residuals) < options.min_detections:
        return ()
    search = _Search.from_residuals(compare_residuals(residuals), ets, options)
    candidates = [search.assess(path) for path in _drop_parts(search.grow())]
    likely = sorted((one for one in candidates if one.expected_false < _REJECTED), key=lambda one: one.expected_false)
    return tuple(likely[k] for k in _choose_disjoint(likely))


@dataclass(slots=True)
class _Paths:
    """Hypotheses: sources (n, images), -1 for none, and the normal equations of their paths by both axes.

    matrix: (n, 2 p, 2 p); right: (n, 2 p); score: (n,), log likelihood ratio to unrelated sources; missed: (n,), images
    since the last source.
    """

    sources: NDArray[np.int64]
    matrix: Float
    right: Float
    score: Float
    missed: NDArray[np.int64]

    def select(self, which: NDArray[np.integer]) -> _Paths:
        return _Paths(self.sources[which], self.matrix[which], self.right[which], self.score[which], self.missed[which])

    def join(self, other: _Paths) -> _Paths:
        pairs = zip(
            (self.sources, self.matrix, self.right, self.score, self.missed),
            (other.sources, other.matrix, other.right, other.score, other.missed),
            strict=True,
        )
        sources, matrix, right, score, missed = (np.concatenate(pair) for pair in pairs)
        return _Paths(sources, matrix, right, score, missed)


@dataclass(frozen=True, slots=True)
class _Search:
    """Places (n, 2), px, of the linkable sources of each image on the plane, with covariances (n, 2, 2) and density.

    numbers: of the sources in their image. densities: (n,), 1/px^2, of linkable sources around each, and their means
        by image. prior: (p,), weights of the parameters of a path.
    """

    residuals: Sequence[Residuals]
    ets: Float
    options: LinkOptions
    plane: TangentPlane
    numbers: list[NDArray[np.int64]]
    places: list[Float]
    covariances: list[Float]
    densities: list[Float]
    area_px2: float
    prior: Float
    means: Float

    @classmethod
    def from_residuals(cls, residuals: Sequence[Residuals], ets: Float, options: LinkOptions) -> _Search:
        plane = TangentPlane.from_residuals(residuals[len(residuals) // 2])
        numbers, places, covariances, densities = [], [], [], []
        for one in residuals:
            which = np.flatnonzero(one.linkable & (one.directions_inertial @ plane.axes[2] > LEAST_COSINE))
            spread, common = plane.covariances(one, FLOOR_PX)
            numbers.append(which)
            places.append(plane.project(one.directions_inertial)[which])
            covariances.append((spread + common)[which])
            densities.append(_find_densities(one.points_px[which], one.covered))
        area = float(residuals[0].camera.columns * residuals[0].camera.rows)
        prior = np.repeat([0.0, options.max_rate_px_s**-2.0], 2)
        if options.max_acceleration_px_s2 > 0.0:
            prior = np.append(prior, np.repeat(options.max_acceleration_px_s2**-2.0, 2))
        means = np.array([one.mean() if len(one) else 0.0 for one in densities])
        return cls(residuals, ets, options, plane, numbers, places, covariances, densities, area, prior, means)

    def rows(self, after_s: float) -> Float:
        """Derivative (2, p) of a place by a path: place, rate and, if any, acceleration."""
        parts = [1.0, after_s, 0.5 * after_s**2][: len(self.prior) // 2]
        return np.kron(np.array(parts), np.eye(2))

    def grow(self) -> NDArray[np.int64]:
        """Sources (n, images) of the paths that have enough of them, by score; -1 for none."""
        middle, images = float(np.mean(self.ets)), len(self.ets)
        active = self._empty(0)
        ended: list[_Paths] = []
        for k in range(images):
            rows = self.rows(self.ets[k] - middle)
            if len(active.score):
                active, old = self._extend(active, k, rows)
                ended.append(old)
            for j in range(max(0, k - 1 - self.options.max_missed), k):
                active = active.join(self._pair(j, k, middle))
            if len(active.score) > _MOST_HYPOTHESES:
                active = active.select(np.argsort(-active.score)[:_MOST_HYPOTHESES])
        ended.append(active)
        done = functools.reduce(_Paths.join, ended)
        done = done.select(np.argsort(-done.score, kind="stable"))
        return np.asarray(done.sources[np.count_nonzero(done.sources >= 0, axis=1) >= self.options.min_detections])

    def _empty(self, n: int) -> _Paths:
        p = len(self.prior)
        return _Paths(
            np.full((n, len(self.ets)), -1),
            np.tile(np.diag(self.prior), (n, 1, 1)),
            np.zeros((n, p)),
            np.zeros(n),
            np.zeros(n, dtype=np.int64),
        )

    def _pair(self, j: int, k: int, middle: float) -> _Paths:
        """Paths through a source of each of two images, within the largest rate."""
        if not len(self.places[j]) or not len(self.places[k]):
            return self._empty(0)
        reach = self.options.max_rate_px_s * (self.ets[k] - self.ets[j])
        near = cKDTree(self.places[j]).query_ball_tree(cKDTree(self.places[k]), reach)
        count = sum(map(len, near))
        require(
            count <= _MOST_PAIRS,
            f"{self.residuals[j].name}, {self.residuals[k].name}: {count} pairs of sources lie within the largest "
            "rate: lower max_rate_px_s, or raise the threshold",
        )
        pairs = np.array([(a, b) for a, some in enumerate(near) for b in some], dtype=np.int64).reshape(-1, 2)
        paths = self._empty(len(pairs))
        for image, sources in ((j, pairs[:, 0]), (k, pairs[:, 1])):
            paths = self._measure(paths, image, sources, self.rows(self.ets[image] - middle))
        return paths

    def _measure(self, paths: _Paths, image: int, sources: NDArray[np.int64], rows: Float) -> _Paths:
        """The paths with one more source (n,) each, of an image."""
        weight = np.linalg.inv(self.covariances[image][sources])
        taken = paths.sources.copy()
        taken[:, image] = sources
        matrix = paths.matrix + rows.T @ weight @ rows
        right = paths.right + np.einsum("ip,nij,nj->np", rows, weight, self.places[image][sources])
        return _Paths(taken, matrix, right, paths.score.copy(), np.zeros_like(paths.missed))

    def _extend(self, active: _Paths, k: int, rows: Float) -> tuple[_Paths, _Paths]:
        """Paths with a source of image k or without one, and those that have ended."""
        inverse = np.linalg.inv(active.matrix)
        place = np.einsum("ip,npq,nq->ni", rows, inverse, active.right)
        spread = rows @ inverse @ rows.T
        new = self._empty(0)
        if len(self.places[k]):
            tree = cKDTree(self.places[k])
            widest = float(np.linalg.eigvalsh(self.covariances[k])[:, -1].max())
            reach = np.sqrt(GATE * (np.linalg.eigvalsh(spread)[:, -1] + widest))
            near = tree.query_ball_point(place, reach)
            owner = np.repeat(np.arange(len(near)), [len(some) for some in near])
            sources = np.array(list(itertools.chain.from_iterable(near)), dtype=np.int64)
            total = spread[owner] + self.covariances[k][sources]
            off = self.places[k][sources] - place[owner]
            chi2 = np.einsum("ni,nij,nj->n", off, np.linalg.inv(total), off)
            inside = chi2 < GATE
            owner, sources, total, chi2 = owner[inside], sources[inside], total[inside], chi2[inside]
            new = self._measure(active.select(owner), k, sources, rows)
            chance = self.densities[k][sources] * 2.0 * math.pi * np.sqrt(np.linalg.det(total))
            new.score += math.log(_DETECTED) - 0.5 * chi2 - np.log(chance)
            new = _keep_best(new)
        visible = self.detectable(k, place, active)
        active.score += np.log1p(-visible)
        active.missed += visible > 0.0
        goes_on = active.missed <= self.options.max_missed
        old, active = active.select(np.flatnonzero(~goes_on)), active.select(np.flatnonzero(goes_on))
        return new.join(active), old

    def detectable(self, k: int, place: Float, paths: _Paths | None = None) -> Float:
        """Probability (n,) that objects at places (n, 2) on the plane are detected in an image.

        By how far the sources of a path exceed the threshold, if there is one; 0 outside of the frame and where
        something covers them.
        """
        one = self.residuals[k]
        points = one.camera.model.project(rotate(one.camera_from_inertial, self.plane.unproject(place)))
        seen = np.array(np.isfinite(points).all(axis=1))
        seen[seen] = one.camera.contains(points[seen])
        columns, rows = np.rint(np.where(seen[:, None], points, 0.0)).astype(np.int64).T
        seen &= ~one.covered[rows, columns]
        if paths is None:
            return np.where(seen, _DETECTED, 0.0)
        total, count = np.zeros(len(place)), np.zeros(len(place))
        for j, other in enumerate(self.residuals):
            some = paths.sources[:, j] >= 0
            total[some] += other.snr[self.numbers[j][paths.sources[some, j]]]
            count += some
        excess = total / np.maximum(count, 1.0) - one.threshold_sigma
        return np.where(seen, _DETECTED * ndtr(excess), 0.0)

    def assess(self, path: NDArray[np.int64]) -> Track:
        """The track of a path, with its chance."""
        images = np.flatnonzero(path >= 0)
        places = np.array([self.places[k][path[k]] for k in images])
        spread = np.array([self.covariances[k][path[k]] for k in images])
        et = float(np.mean(self.ets[images]))
        after = self.ets[images] - et
        n = len(images)
        rows = np.kron(np.stack([np.ones(n), after], axis=1), np.eye(2))
        bend = np.kron(0.5 * after[:, None] ** 2, np.eye(2))
        total = self.options.max_acceleration_px_s2**2 * bend @ bend.T
        total.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n), :] += spread
        weight = np.linalg.inv(total)
        matrix = rows.T @ weight @ rows
        solution = np.linalg.solve(matrix, rows.T @ weight @ places.ravel())
        off = places.ravel() - rows @ solution
        chi2, freedom = float(off @ weight @ off), 2 * n - 4
        acceleration = self.options.max_acceleration_px_s2**2 * bend.T @ weight @ off
        volume = math.log(self.area_px2 * math.pi) + 2.0 * math.log(self.options.max_rate_px_s)
        volume += 0.5 * float(np.linalg.slogdet(total)[1] + np.linalg.slogdet(matrix)[1])
        ball = 0.5 * freedom * math.log(math.pi * max(chi2, 1e-3)) - float(gammaln(0.5 * freedom + 1.0))
        farthest = max(self.options.max_missed + 1, int(np.diff(images).max()))
        local = np.array([self.densities[k][path[k]] for k in images])
        choices = float(np.sum(np.log(local / self.means[images]))) + _log_choices(self.means, n, farthest)
        lengths = math.log(len(self.ets) - self.options.min_detections + 1)
        expected = math.exp(min(volume + ball + choices + lengths, 700.0))
        between = np.setdiff1d(np.arange(images[0], images[-1] + 1), images)
        where = solution[:2] + (self.ets[between] - et)[:, None] * solution[2:]
        lost = [k for k, at in zip(between, where, strict=True) if self.detectable(int(k), at[None])[0] > 0.0]
        return Track(
            images=images,
            sources=np.array([self.numbers[k][path[k]] for k in images]),
            residuals=tuple(self.residuals[int(k)] for k in images),
            missed=tuple(self.residuals[int(k)].name for k in lost),
            expected_false=expected,
            accepted=expected <= self.options.max_expected_false,
            chi2=chi2,
            freedom=freedom,
            et=et,
            direction_inertial=self.plane.unproject(solution[:2]),
            rate_px_s=solution[2:4],
            acceleration_px_s2=acceleration,
            plane=self.plane,
            places_px=places,
            covariance_places_px2=spread,
        )


def _log_choices(density: Float, n: int, farthest: int) -> float:
    """Logarithm of the sum of the products of densities over choices of n images, each so near to the one before."""
    scale = float(density.max())
    sums = density / scale  # of choices that end in an image
    first = np.arange(len(density)) - farthest
    for _ in range(n - 1):
        up_to = np.concatenate([[0.0], np.cumsum(sums)])
        sums = density / scale * (up_to[:-1] - up_to[np.maximum(first, 0)])
    return math.log(float(sums.sum())) + n * math.log(scale)


def _find_densities(points_px: Float, covered: NDArray[np.bool_]) -> Float:
    """Linkable sources per uncovered pixel around each of them (n,), itself included: 1/px^2.

    The larger of the mean over the frame and of a region around the source: false ones come in groups.
    """
    if not len(points_px):
        return np.zeros(0)
    free = float(np.count_nonzero(~covered))
    reach = math.sqrt(_REGION_SHARE * covered.size / math.pi)
    count = cKDTree(points_px).query_ball_point(points_px, reach, return_length=True)
    steps = np.linspace(-1.0, 1.0, 15) * reach
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    grid = grid[np.hypot(*grid.T) <= reach]
    at = np.rint(points_px[:, None] + grid).astype(np.int64)
    inside = ((at >= 0) & (at < np.array(covered.shape[::-1]))).all(axis=2)
    columns, rows = np.where(inside[..., None], at, 0).transpose(2, 0, 1)
    share = np.mean(inside & ~covered[rows, columns], axis=1)
    local = count / np.maximum(share * math.pi * reach**2, 1.0)
    return np.asarray(np.maximum(local, len(points_px) / max(free, 1.0)))


def _keep_best(paths: _Paths) -> _Paths:
    """Of paths that share their last three sources the one of the highest score."""
    order = np.argsort(-paths.score, kind="stable")
    seen: set[bytes] = set()
    kept = []
    for k in order:
        row = paths.sources[k]
        last = np.flatnonzero(row >= 0)[-3:]
        key = last.tobytes() + row[last].tobytes()
        if key not in seen:
            seen.add(key)
            kept.append(k)
    return paths.select(np.array(kept, dtype=np.int64))


def _drop_parts(paths: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Paths (images,) of those (n, images) whose sources are not all in one that comes before."""
    owners: dict[tuple[int, int], set[int]] = {}
    kept: list[NDArray[np.int64]] = []
    for path in paths:
        sources = [(k, i) for k, i in enumerate(path.tolist()) if i >= 0]
        if not set.intersection(*(owners.get(source, set()) for source in sources)):
            for source in sources:
                owners.setdefault(source, set()).add(len(kept))
            kept.append(path)
    return kept


def _choose_disjoint(tracks: Sequence[Track]) -> NDArray[np.int64]:
    """Indices of the tracks without common sources whose product of chances is least."""
    if not tracks:
        return np.zeros(0, dtype=np.int64)
    names: dict[tuple[int, int], int] = {}
    rows, columns = [], []
    for k, track in enumerate(tracks):
        for source in zip(track.images.tolist(), track.sources.tolist(), strict=True):
            rows.append(names.setdefault(source, len(names)))
            columns.append(k)
    shared = csr_array((np.ones(len(rows)), (rows, columns)), shape=(len(names), len(tracks)))
    gain = np.array([-math.log(max(one.expected_false, 1e-300)) for one in tracks])
    answer = milp(
        -gain,
        constraints=LinearConstraint(shared, ub=1.0),
        integrality=np.ones(len(tracks), dtype=np.int64),
        bounds=Bounds(0.0, 1.0),
        options={"time_limit": 20.0},
    )
    if answer.x is None:  # out of time: one after the other
        taken: set[tuple[int, int]] = set()
        chosen = []
        for k in np.argsort(-gain):
            own = set(zip(tracks[k].images.tolist(), tracks[k].sources.tolist(), strict=True))
            if not own & taken:
                taken |= own
                chosen.append(k)
        return np.array(chosen, dtype=np.int64)
    return np.flatnonzero(answer.x > 0.5)
