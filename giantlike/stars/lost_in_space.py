"""Star identification from the shapes of patterns: anywhere on the sky, or within the error of an a priori attitude.

Triads of detections, or quads where the focal length is not known, are looked up in an index of the catalog; attitudes
shared by many are verified by matching and fitting all stars. If quads find nothing, tetra3rs is tried.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.processes import one_thread
from giantlike.camera import Camera
from giantlike.core.arrays import Float, Mask
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.processing.geometry.wahba import davenport_quaternions
from giantlike.stars.field import Sky, StarField, half_diagonal_rad, line_of_sight
from giantlike.stars.matching import (
    attitudes_of_sky,
    attitudes_within_angle,
    false_match_probability,
    predicted_in_frame,
)
from giantlike.stars.options import StarOptions
from giantlike.stars.pattern_search import Hypothesis, PatternCandidates, Scope, find_candidates, hypotheses, searches
from giantlike.stars.refine import (
    SMALLEST_GATE_PX,
    RefinedAttitude,
    depth_for,
    refine_attitude,
    scaled_model,
    significant_matches,
)
from giantlike.stars.star_index import Pattern, StarIndex, build_index, caps, density_for, sky_index
from giantlike.stars.tetra import tetra_hypotheses

_OTHER_SCALE = 0.2  # error of the focal length up to which a failure names the right one, as ``scale_error``
_SCALES = (0.5, 0.7, 1.4, 2.0)  # focal lengths, over the stated one, around each of which others are tried
_SCALE_STEP = 0.015  # relative spacing of the focal lengths tried; only distortion and wide fields depend on it
_TRIAD_PX, _QUAD = 2.0, 0.006  # tolerance of the distance of two stars: px, and fraction of the image width
_TRIED, _TRIED_IN_ALL = 6, 30  # hypotheses verified, of each search and of an image: bounds the time of failures
_BRIGHTEST = 40  # detections whose noise sets the tolerance, and spare stars of an index in a cone
_NARROW_RAD = math.radians(0.75)  # half field of view below which the catalog may hold too few stars
_SAMPLED_RAD = 0.3  # spacing of the directions in which catalog stars are counted: 140 over the sky
_BRIEF = {Pattern.TRIAD: 1, Pattern.QUAD: 2}  # number of searches that solve most images
_GAINED = 3  # matches that a fit may add to the matches of a hypothesis
_FIRST_RADIUS = 0.008  # first match radius / image width: distortion left by a pinhole of the correct focal length


@one_thread()
def identify_lost_in_space(
    points_px: Float,
    covariance_px2: Float,
    camera: Camera,
    sky: Sky,
    *,
    options: StarOptions,
    until_s: float | None = None,
) -> RefinedAttitude | Failure:
    """Find the attitude of an image anywhere on the sky, from detections (m, 2), brightest first.

    ``until_s``: :func:`time.thread_time` at which the search ends. Source: the ODIN paper (004), Star Identification.
    """
    until_s = time.thread_time() + options.time_limit_s if until_s is None else until_s
    return _solved_or_explained(_IdentificationProblem(points_px, covariance_px2, camera, sky, options, until_s))


def identify_in_cone(
    points_px: Float,
    covariance_px2: Float,
    camera: Camera,
    sky: Sky,
    camera_from_inertial: Rotation,
    *,
    options: StarOptions,
    until_s: float | None = None,
) -> RefinedAttitude | Failure:
    """Find the attitude within ``options.attitude_error_deg`` of an a priori one, about any axis.

    The same search as on the whole sky, in an index of the stars that such an image can show.
    """
    until_s = time.thread_time() + options.time_limit_s if until_s is None else until_s
    problem = _IdentificationProblem(points_px, covariance_px2, camera, sky, options, until_s, camera_from_inertial)
    return _solved_or_explained(problem)


@dataclass(frozen=True, slots=True, eq=False)
class _IdentificationProblem(Value):
    """Search for the attitude of one image, on the whole sky or around an a priori attitude."""

    points_px: Float
    covariance_px2: Float
    camera: Camera
    sky: Sky
    options: StarOptions
    until_s: float = math.inf
    apriori: Rotation | None = None

    def solve(self, *, brief: bool = False) -> RefinedAttitude | Failure:
        """Verify hypotheses until one passes; ``brief`` stops after the searches that solve most images."""
        refuted = 0
        for hypothesis in self.hypotheses(brief):
            outcome = self.verify(hypothesis)
            if isinstance(outcome, RefinedAttitude):
                return outcome
            refuted += 1
            if self.is_late():
                break
        if self.is_late():
            return Failure(
                Reason.TIME_LIMIT,
                f"no pattern of the {len(self.points_px)} detections was found within the time limit of "
                f"{self.options.time_limit_s:g} s ({refuted} candidates were verified and refused): check focal length "
                "and the detections, or raise time_limit_s",
            )
        where = "on the sky" if self.apriori is None else f"within {self.options.attitude_error_deg:g} degrees"
        free = f" to {100 * self.options.scale_error:.3g} %" if self.options.estimate_scale else ""
        return Failure(
            Reason.NO_PATTERN_MATCH,
            f"no pattern of the {len(self.points_px)} detections was found {where} for a field of view of "
            f"{self.camera.fov_deg:.4g} degrees{free} ({refuted} candidates were verified and refused)",
        )

    def is_late(self) -> bool:
        """True once the time limit of the image is over."""
        return time.thread_time() >= self.until_s

    def verify(self, hypothesis: Hypothesis) -> RefinedAttitude | Failure:
        """Match all stars of the image with the attitude of a hypothesis, and refine it."""
        camera, options = self.camera, self.options
        if options.estimate_scale:
            camera = dataclasses.replace(camera, model=scaled_model(camera.model, hypothesis.scale))
        field = self.sky.field(camera, hypothesis.camera_from_inertial, count=depth_for(len(self.points_px)))
        rough = options.estimate_scale or not len(hypothesis.star_ids)
        radius = max(options.inlier_px, _FIRST_RADIUS * camera.columns) if rough else options.inlier_px
        rotation = self._with_apparent_places(hypothesis, field, camera)
        predicted = predicted_in_frame(field.directions_inertial, camera, rotation, margin_px=radius)
        hopeless = self._hopeless(predicted, radius)
        if hopeless is not None:
            return hopeless
        return refine_attitude(
            field,
            self.points_px,
            self.covariance_px2,
            camera,
            rotation,
            radius_px=radius,
            trials=self.trials,
            options=options,
        )

    def _hopeless(self, predicted_px: Float, radius_px: float) -> Failure | None:
        """Failure of an attitude that would be refused even if its matches came as close as they ever do."""
        count, area = len(self.points_px), float(self.camera.columns * self.camera.rows)
        found = len(significant_matches(predicted_px, self.points_px, radius_px, area)) + _GAINED
        chance = float(np.pi * SMALLEST_GATE_PX**2 * min(found, len(predicted_px)) / area)
        trials = self.trials(SMALLEST_GATE_PX)
        probability = false_match_probability(min(found, count), count, chance, trials)
        if probability <= self.options.max_false_match_probability:
            return None
        return Failure(
            Reason.AMBIGUOUS,
            f"{found - _GAINED} of {count} detections match a star within {radius_px:.3g} px, which could be by chance",
        )

    def _with_apparent_places(self, hypothesis: Hypothesis, field: StarField, camera: Camera) -> Rotation:
        """Attitude from apparent star positions of a hypothesis: an index has neither aberration nor epoch."""
        _, mine, theirs = np.intersect1d(hypothesis.star_ids, field.stars.ids, return_indices=True)
        seen = camera.model.unproject(self.points_px[hypothesis.detection_indices[mine]])
        good = np.isfinite(seen).all(axis=1)
        if int(good.sum()) < 3:
            return hypothesis.camera_from_inertial
        return Rotation.from_quat(davenport_quaternions(field.directions_inertial[theirs[good]], seen[good]))

    def hypotheses(self, brief: bool) -> Iterator[Hypothesis]:
        """Hypotheses from patterns and then from tetra3rs, lazily and without repetitions."""
        seen: set[bytes] = set()
        for hypothesis in itertools.islice(self._from_patterns(brief), _TRIED_IN_ALL):
            key = hypothesis.star_ids.tobytes() + hypothesis.detection_indices.tobytes()
            if key not in seen:
                seen.add(key)
                yield hypothesis
        if self.options.estimate_scale and self.apriori is None and not brief and not self.is_late():
            yield from tetra_hypotheses(self.points_px, self.camera, self.sky, options=self.options)

    def _from_patterns(self, brief: bool) -> Iterator[Hypothesis]:
        scope = self.scope()
        vectors = self.vectors(scope)
        pattern = Pattern.QUAD if self.options.estimate_scale else Pattern.TRIAD
        least = 2 if brief or pattern is Pattern.TRIAD else 1  # a triad alone has three stars
        gathered: PatternCandidates | None = None
        radius = -1.0
        for number, search in enumerate(searches(vectors[len(vectors) // 2], self.half_fov_rad(), pattern)):
            if (brief and number >= _BRIEF[pattern]) or self.is_late():
                return
            index = self.index(pattern, search.radius_rad)
            if len(index) == 0:
                continue
            if search.radius_rad != radius:
                gathered, radius = None, search.radius_rad
            for group in search.groups:
                if self.is_late():
                    return
                found = find_candidates(index, vectors, group, scope)
                found = found if self.apriori is None else found.select(self._near(found.matrices))
                gathered = found if gathered is None else gathered.union(found)
            if gathered is not None:
                shared = hypotheses(gathered, index, vectors, scope, least=least)
                yield from itertools.islice(shared, _TRIED)

    def scope(self) -> Scope:
        """Tolerances and focal lengths of the pattern search."""
        ifov = float(self.camera.ifov_rad())
        brightest = self.covariance_px2[:_BRIGHTEST]
        noise = 4.0 * float(np.sqrt(np.median(np.trace(brightest, axis1=1, axis2=2)) / 2.0))
        error = self.options.scale_error
        free = self.options.estimate_scale
        edge_px = max(_QUAD * self.camera.columns if free else _TRIAD_PX, min(noise, 2.0 * self.options.inlier_px))
        steps = 2 * math.ceil(error / _SCALE_STEP) + 1
        return Scope(
            tolerance_rad=edge_px * ifov,
            half_size_rad=0.7 * half_diagonal_rad(self.camera),
            scales=np.linspace(1.0 - error, 1.0 + error, steps) if free else np.ones(1),
        )

    def vectors(self, scope: Scope) -> Float:
        """Lines of sight (s, m, 3) of the detections for each focal length, camera axes."""
        model = self.camera.model
        if len(scope.scales) == 1:
            return model.unproject(self.points_px)[None]
        return np.stack([scaled_model(model, float(scale)).unproject(self.points_px) for scale in scope.scales])

    def half_fov_rad(self) -> float:
        """Half the smaller field of view, along x or y, rad."""
        middle, (right, bottom) = self.camera.center_px, (self.camera.columns - 0.5, self.camera.rows - 0.5)
        rays = self.camera.model.unproject([[right, middle[1]], [middle[0], bottom]])
        cosines = rays @ self.camera.model.unproject(middle)
        angles = np.arccos(np.clip(cosines[np.isfinite(cosines)], -1.0, 1.0))
        return float(angles.min(initial=half_diagonal_rad(self.camera)))

    def index(self, pattern: Pattern, radius_rad: float) -> StarIndex:
        """Index of the whole sky, or of the cone that the a priori attitude leaves."""
        catalog, limit = self.sky.catalog, self.sky.max_magnitude
        if self.apriori is None:
            return sky_index(catalog, pattern, radius_rad, max_magnitude=limit)
        axis, reach = line_of_sight(self.camera, self.apriori), self.reach_rad()
        share = (1.0 - math.cos(reach)) / 2.0
        count = math.ceil(2.0 * share * density_for(radius_rad).stars_wanted(radius_rad)) + _BRIGHTEST
        field = self.sky.cone(axis, reach, count=count)
        return build_index(pattern, field.stars.ids, field.directions_inertial, radius_rad, axis=axis, reach_rad=reach)

    def stars_expected(self) -> float:
        """Mean number of catalog stars in a field of view, over the sky or near the a priori attitude."""
        half = self.half_fov_rad()
        if half > _NARROW_RAD:
            return math.inf
        axes, reach = caps(_SAMPLED_RAD), _SAMPLED_RAD / 4.0
        if self.apriori is not None:
            axes, reach = line_of_sight(self.camera, self.apriori)[None], self.reach_rad()
        limit = self.sky.max_magnitude
        found = [len(self.sky.catalog.cone(axis, reach, max_magnitude=limit)) for axis in axes]
        return float(np.mean(found)) * 4.0 * half**2 / (2.0 * math.pi * (1.0 - math.cos(reach)))

    def reach_rad(self) -> float:
        """Largest angle between the a priori boresight and a star of the image, rad."""
        return min(half_diagonal_rad(self.camera) + math.radians(self.options.attitude_error_deg), np.pi)

    def _near(self, matrices: Float) -> Mask:
        """True (k,) for attitudes (k, 3, 3) within the error of the a priori one."""
        assert self.apriori is not None
        traces = np.einsum("kij,ij->k", matrices, self.apriori.as_matrix())
        allowed: Mask = traces >= 1.0 + 2.0 * math.cos(math.radians(self.options.attitude_error_deg))
        return allowed

    def trials(self, radius_px: float) -> float:
        """Number of distinguishable attitudes (and cameras) in the search, for a match radius."""
        error = self.options.scale_error if self.options.estimate_scale else 0.0
        if self.apriori is None:
            return attitudes_of_sky(radius_px, self.camera, scale_error=error)
        angle = math.radians(self.options.attitude_error_deg)
        return attitudes_within_angle(radius_px, self.camera, angle, scale_error=error)


def _solved_or_explained(problem: _IdentificationProblem) -> RefinedAttitude | Failure:
    """Attitude of the image, or a failure with its cause where that can be diagnosed."""
    count, needed = len(problem.points_px), max(problem.options.min_matches, 4)
    if count < needed:
        return Failure(
            Reason.TOO_FEW_DETECTIONS,
            f"{count} detections, {needed} are needed: use a longer exposure or a lower detection threshold",
        )
    expected = problem.stars_expected()
    if expected < problem.options.min_matches:
        limit = problem.sky.max_magnitude
        return Failure(
            Reason.NO_CATALOG_STARS,
            f"the catalog {problem.sky.catalog.name!r}{'' if limit is None else f' to magnitude {limit:g}'} has "
            f"{expected:.2g} stars in a field of view of {problem.camera.fov_deg:.3g} degrees, "
            f"{problem.options.min_matches} are needed: use a deeper catalog",
        )
    outcome = problem.solve()
    if isinstance(outcome, RefinedAttitude) or problem.is_late():
        return outcome
    cause = _diagnosis(problem)
    return outcome if cause is None else cause


def _diagnosis(problem: _IdentificationProblem) -> Failure | None:
    """Diagnosis of a failed search: a mirrored image or another focal length; None for neither."""
    if problem.apriori is None:
        flip = np.array([-1.0, 1.0])
        outcome = dataclasses.replace(
            problem,
            points_px=problem.points_px * flip + np.array([2.0 * problem.camera.center_px[0], 0.0]),
            covariance_px2=problem.covariance_px2 * np.outer(flip, flip),
        ).solve(brief=True)
        if isinstance(outcome, RefinedAttitude):
            return Failure(
                Reason.MIRRORED_IMAGE,
                f"{len(outcome.matches)} stars match the image with its columns reversed: "
                "check how it was read or which way its axes go",
            )
    return None if problem.options.estimate_scale else _other_camera(problem)


def find_other_scale(
    points_px: Float,
    covariance_px2: Float,
    camera: Camera,
    sky: Sky,
    camera_from_inertial: Rotation,
    *,
    options: StarOptions,
) -> Failure | None:
    """Failure that names the focal length, 0.4 to 2.4 of the camera's, that fits near the a priori attitude."""
    until_s = time.thread_time() + options.time_limit_s
    problem = _IdentificationProblem(points_px, covariance_px2, camera, sky, options, until_s, camera_from_inertial)
    return next((found for scale in _SCALES if (found := _other_camera(problem, scale)) is not None), None)


def _other_camera(problem: _IdentificationProblem, scale: float = 1.0) -> Failure | None:
    """Failure of an image whose stars fit another focal length or distortion; None if they do not."""
    camera = problem.camera
    free = dataclasses.replace(problem.options, estimate_scale=True, scale_error=_OTHER_SCALE)
    other = dataclasses.replace(camera, model=scaled_model(camera.model, scale))
    outcome = dataclasses.replace(problem, camera=other, options=free).solve(brief=True)
    if isinstance(outcome, Failure):
        return None
    fov = math.degrees(2.0 * math.atan(camera.columns / 2.0 / outcome.solution.model.focal_length_px))
    return Failure(
        Reason.FOV_MISMATCH,
        f"{len(outcome.matches)} stars fit a field of view of {fov:.5g} degrees, {fov / camera.fov_deg:.3g} of the "
        f"{camera.fov_deg:.5g} of the camera model: correct it, or let focal length and distortion be estimated",
    )
