"""Surface features: position, and attitude if asked, from landmarks that are rendered and found one by one."""

from __future__ import annotations

import math
from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, require
from giantlike.core.outcomes import Failure, PositionFix, Quality, Reason
from giantlike.core.units import RAD_PER_DEG
from giantlike.core.values import Value
from giantlike.processing.geometry.pnp import PnpFix, PnpOptions, solve_pnp
from giantlike.ray_tracing import Body
from giantlike.relative.estimator import BodyEstimator
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.judge import Facts
from giantlike.relative.landmarks.cells import in_cells
from giantlike.relative.landmarks.matching import LandmarkMatch, common_shift, correlation_surface, fit_patch, peak_near
from giantlike.relative.landmarks.rendering import LandmarkRenderer, Patch, TracedGround, rays_for
from giantlike.relative.landmarks.selection import landmarks_of
from giantlike.relative.landmarks.visibility import SeenLandmarks, VisibilityOptions, viewer_for
from giantlike.relative.place import center_of_position
from giantlike.shapes import TriangleMesh
from giantlike.shapes.detail import LevelsOfDetail
from giantlike.shapes.landmarks import LandmarkCatalog, load_landmarks

_NEAR_PX = 3  # px, search once a pose is known
_FREE_TURN_RAD = 0.03  # rad, error of a free attitude that the first search allows for, at most
_SETTLED_SIGMA = 0.3  # of the standard deviation of the position: a last step so small adds 5 % to it
_DAMPED_AFTER = 3  # renders, after which steps are halved: they come from the sampling of the renders
_LOOSE = 3.0  # factor of the limit of agreement, while templates are rendered for an inaccurate pose
_CELLS_ACROSS = 10
"""Cells across a landmark in the first search; pixels where landmarks are narrower than two cells. Errors of 24 rocks
of 300 px are 0.027 px with it, and 0.027, 0.028 and 0.028 px with half of it, 0.7 of it and no cells."""
_RADIUS_PX = 1.5  # px, distance from the common shift by noise of the correlation peaks


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceFeaturesOptions:
    """Options of :class:`SurfaceFeatures`.

    Parameters
    ----------
    landmarks : Path, optional
        Landmarks: a catalog (.npz), a maplet (.MAP), or a folder of maplets. Without one they are chosen on
        the shape of the target, if it is a mesh.
    search_px : int, px; largest error of the predicted center, along each axis
    search_range : float; largest relative error of the predicted range
    attitude_sigma_deg : float, deg
        Standard deviation of the predicted attitude of the body in the camera, about each axis: 0 holds it, infinity
        leaves it free. Unless it is 0 the fix has its own attitude.
    min_landmarks : int; minimum number of landmarks that are found and agree
    min_score : float; minimum correlation of a landmark that counts as found
    inlier_px : float, px; largest distance of a found landmark from its projection by the pose
    free_reflectance : bool; mix another reflectance law into the law of the target
    max_iterations : int; maximum number of renders
    tolerance_px : float, px
        The pose has converged when no landmark moves by more. With 0.1 px most fixes take one iteration fewer, and
        errors of one scene of 20 landmarks grew from 0.0044 to 0.0070 px.
    visibility : VisibilityOptions

    Raises
    ------
    InputError
        A value is out of its range.

    Notes
    -----
    Half and double of the defaults move no result of ``benchmarks/sensitivity.md`` by more than 0.8 of its sigma.
    """

    landmarks: Path | None = None
    search_px: int = 40
    search_range: float = 0.03
    attitude_sigma_deg: float = 0.0
    min_landmarks: int = 6
    min_score: float = 0.5
    inlier_px: float = 1.0
    free_reflectance: bool = True
    max_iterations: int = 8
    tolerance_px: float = 0.02
    visibility: VisibilityOptions = field(default_factory=VisibilityOptions)

    def __post_init__(self) -> None:
        whole = isinstance(self.search_px, int) and 1 <= self.search_px <= 1000
        require(whole, f"search_px must be a whole number in [1, 1000], got {self.search_px}")
        if self.landmarks is not None:
            object.__setattr__(self, "landmarks", Path(self.landmarks))
        require(0.0 < self.search_range < 0.5, f"search_range must be in (0, 0.5), got {self.search_range}")
        require(self.attitude_sigma_deg >= 0.0, f"attitude_sigma_deg must be >= 0, got {self.attitude_sigma_deg}")
        require(self.min_landmarks >= 4, f"min_landmarks must be >= 4, got {self.min_landmarks}")
        require(0.0 < self.min_score < 1.0, f"min_score must be in (0, 1), got {self.min_score}")
        require(self.inlier_px > 0.0, f"inlier_px must be > 0, got {self.inlier_px}")
        whole = isinstance(self.max_iterations, int) and self.max_iterations >= 2
        require(whole, f"max_iterations must be a whole number >= 2, got {self.max_iterations}")
        require(self.tolerance_px > 0.0, f"tolerance_px must be > 0, got {self.tolerance_px}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class LandmarkFix(PositionFix):
    """A :class:`~giantlike.core.outcomes.PositionFix` from landmarks, with the attitude of the body in the camera.

    Parameters
    ----------
    camera_from_body : Rotation; estimated attitude; the predicted one where that is held
    pose_covariance : (6, 6) float64, km and rad
        Of the position and of the small rotation ``e`` about the camera axes with
        ``camera_from_body_true = Rotation.from_rotvec(e) * camera_from_body``; zero where it is held.
    attitude_change_rad : (3,) float64, rad
        Rotation from the predicted to the estimated attitude, as a rotation vector about the camera axes.
    landmark_names : tuple of str; of the landmarks used
    landmark_px, landmark_predicted_px : (n, 2) float64, px; measured, and projected by the pose
    covariance_landmarks_px2 : (n, 2, 2) float64, px^2
        Of each measured landmark alone: the noise, and the excess of the residuals over it.
    landmark_body_km : (n, 3) float64, km, body-fixed axes
    rejected_names : tuple of str; of the landmarks that were searched and not used
    rejected_predicted_px : (k, 2) float64, px; projected by the pose
    rejected_because : tuple of str; reason for each: not found, or its distance from the pose
    """

    camera_from_body: Rotation
    pose_covariance: Float
    attitude_change_rad: Float
    landmark_names: tuple[str, ...]
    landmark_px: Float
    landmark_predicted_px: Float
    covariance_landmarks_px2: Float
    landmark_body_km: Float
    rejected_names: tuple[str, ...] = ()
    rejected_predicted_px: Float = field(default_factory=lambda: np.zeros((0, 2)))
    rejected_because: tuple[str, ...] = ()

    def unwrap(self) -> LandmarkFix:
        """Return the fix itself (a :class:`~giantlike.core.outcomes.Failure` raises instead)."""
        return self


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found(Value):
    """Landmarks matched, in the order of the catalog, and the pose that they agree on."""

    matches: tuple[LandmarkMatch, ...]
    observed_px: Float
    pose: PnpFix
    tried: tuple[int, ...]

    @property
    def off_px(self) -> dict[int, float]:
        """Distance from the pose of every landmark matched, by its number."""
        lengths = np.linalg.norm(self.pose.residuals_px, axis=1)
        return {match.number: float(length) for match, length in zip(self.matches, lengths, strict=True)}


class SurfaceFeatures(BodyEstimator[SurfaceFeaturesOptions, LandmarkFix]):
    """Full position of a body, and its attitude if asked, from landmarks on its surface.

    The landmarks that can be seen at the predicted pose are rendered and correlated with the image. The shift that most
    of them share is found first, then each near it; a pose that most agree with (RANSAC) rejects wrong ones. Rendered
    anew there, each is fitted to the pixels, and the pose improved by least squares, until it converges.

    ``score`` of the fix is the mean correlation of the landmarks used; ``residuals`` are measured minus projected, px,
    x and y in turn; ``limb_px`` are the measured points. Outliers relative to the scatter of the other landmarks are
    rejected. The covariance holds the noise of the pixels and the excess of the residuals over it, the same for all
    landmarks: errors of the maps, the shape, the sampling and the law.

    Failures are ``WRONG_SHAPE`` without landmarks; ``OUT_OF_FRAME``, ``NOT_LIT`` or ``TOO_FEW_MATCHES`` when too few
    can be used or are found, ``LOW_CORRELATION`` when they are not like the image, ``PEAK_AT_EDGE`` when the body may
    lie beyond the search range, ``DEGENERATE_GEOMETRY`` and ``NOT_CONVERGED``.

    Parameters
    ----------
    options : SurfaceFeaturesOptions

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Surface Feature
       Navigation" and "Template Matching".
    """

    name: ClassVar[str] = "surface_features"
    options_type = SurfaceFeaturesOptions

    _excluded: frozenset[str] = frozenset()

    def exclude(self, names: Iterable[str]) -> SurfaceFeatures:
        """Return the estimator without some landmarks, given by name."""
        made = copy(self)
        made._excluded = self._excluded | frozenset(names)
        return made

    def _estimate(self, inputs: EstimatorInputs) -> LandmarkFix | Failure:
        """Find the body of gathered inputs."""
        catalog = self._landmarks(inputs)
        return catalog if isinstance(catalog, Failure) else _Search(inputs, catalog, self.options).solve()

    def _landmarks(self, inputs: EstimatorInputs) -> LandmarkCatalog | Failure:
        """The landmarks of the file, read once, or those of the target's mesh."""
        if self.options.landmarks is not None:
            return self._without_excluded(_read_once(self.options.landmarks.resolve()))
        shape = inputs.geometry.target.shape
        mesh = shape.finest if isinstance(shape, LevelsOfDetail) else shape
        if not isinstance(mesh, TriangleMesh):
            detail = f"landmarks need a mesh or a file of landmarks, the target is a {type(shape).__name__}"
            return Failure(Reason.WRONG_SHAPE, detail, not_applicable=True)
        return self._without_excluded(landmarks_of(mesh))

    def _without_excluded(self, catalog: LandmarkCatalog) -> LandmarkCatalog | Failure:
        left = [landmark for landmark in catalog.landmarks if landmark.name not in self._excluded]
        if not left:
            return Failure(Reason.TOO_FEW_MATCHES, f"all {len(catalog)} landmarks are excluded")
        return catalog if len(left) == len(catalog) else replace(catalog, landmarks=tuple(left))


def _move_body(body: Body, pose: PnpFix, share: float) -> Body:
    """Body moved by a fraction of the way to a pose."""
    turn = (pose.camera_from_body * body.camera_from_body.inv()).as_rotvec()
    return replace(
        body,
        position_camera_km=body.position_camera_km + share * (pose.position_camera_km - body.position_camera_km),
        camera_from_body=Rotation.from_rotvec(share * turn) * body.camera_from_body,
    )


def _within_noise(before: Body, pose: PnpFix) -> bool:
    """Return True if the last step is small against the standard deviation of the position, in every direction."""
    step = pose.position_camera_km - before.position_camera_km
    return float(step @ np.linalg.solve(pose.covariance[:3, :3], step)) < _SETTLED_SIGMA**2


_read_once = lru_cache(maxsize=4)(load_landmarks)


class _Search:
    """Search for a body in one image, with the state shared by all renders."""

    def __init__(self, inputs: EstimatorInputs, catalog: LandmarkCatalog, options: SurfaceFeaturesOptions) -> None:
        self.inputs, self.catalog, self.options = inputs, catalog, options
        self.start = inputs.geometry.body()
        self.viewer = viewer_for(catalog, self.start.shape)
        plane = inputs.focal_plane()
        self.renderer = LandmarkRenderer(
            catalog,
            plane,
            sun_direction_camera=inputs.geometry.sun_direction_camera,
            max_size_px=options.visibility.max_size_px,
            rays_per_pixel_side=rays_for(plane.psf_sigma_px),
            other_law=options.free_reflectance,
        )

    def solve(self) -> LandmarkFix | Failure:
        """Match, solve and render until the pose converges."""
        body, change_px = self.start, math.inf
        seen, traced = self._find_visible(body), None
        near, rough = (None, None) if isinstance(seen, Failure) else self._in_cells(seen)
        if near is not None:
            body, seen = near, self._find_visible(near)
        fine: _Found | None = None
        for iteration in range(int(near is not None), self.options.max_iterations):
            if isinstance(seen, Failure):
                return seen
            if iteration == 0:
                patches, rough = self.renderer.roughly().patches(body, seen)
            else:
                patches, traced = self.renderer.patches(body, seen, traced, rough)
            found = self._find_pose(body, patches, first=iteration == 0, before=fine)
            if isinstance(found, Failure):
                return found
            fine = found if iteration > 0 else None
            before, moved = body, _move_body(body, found.pose, 1.0 if iteration < _DAMPED_AFTER else 0.5)
            change_px = float(np.abs((self._project(moved) - self._project(body))[seen.numbers]).max())
            body = moved
            if iteration > 0 and (change_px < self.options.tolerance_px or _within_noise(before, found.pose)):
                return self._fix(body, found)
            again = replace(seen, predicted_px=self._project(body)[seen.numbers])
            seen = self._find_visible(body) if iteration == 0 else again
        detail = f"the pose still moves by {change_px:.3f} px after {self.options.max_iterations} renders"
        return Failure(Reason.NOT_CONVERGED, detail)

    def _in_cells(self, seen: SeenLandmarks) -> tuple[Body | None, TracedGround | None]:
        """Body located in coarse cells, and its ground; none where landmarks are small or not found."""
        size = min(int(np.median(seen.size_px) / _CELLS_ACROSS), *self.inputs.usable.shape)
        if size < 2:
            return None, None
        visibility = replace(self.options.visibility, max_size_px=max(self.options.visibility.max_size_px / size, 10.0))
        options = replace(self.options, search_px=math.ceil(self.options.search_px / size), visibility=visibility)
        rough = _Search(in_cells(self.inputs, size), self.catalog, options)
        predicted_px = rough._project(self.start)[seen.numbers]
        patches, ground = rough.renderer.roughly().patches(self.start, replace(seen, predicted_px=predicted_px))
        found = rough._find_pose(self.start, patches, first=True)
        return (None, None) if isinstance(found, Failure) else (_move_body(self.start, found.pose, 1.0), ground)

    def _find_visible(self, body: Body) -> SeenLandmarks | Failure:
        options = self.options
        seen = self.viewer.find_visible(
            body,
            self.renderer.plane,
            sun_direction_camera=self.inputs.geometry.sun_direction_camera,
            options=options.visibility,
        )
        if seen.numbers.size >= options.min_landmarks:
            return seen
        reason = Reason.TOO_FEW_MATCHES
        if seen.numbers.size == 0 and seen.dark > 0 and seen.small == 0:
            reason = Reason.NOT_LIT
        elif seen.numbers.size == 0 and seen.outside > 0:
            reason = Reason.OUT_OF_FRAME
        return Failure(reason, f"{seen}; needed {options.min_landmarks}")

    def _project(self, body: Body) -> Float:
        points = body.to_camera(self.viewer.points_body_km) + body.position_camera_km
        return self.inputs.camera.model.project(points)

    def _find_pose(
        self, body: Body, patches: tuple[Patch, ...], *, first: bool, before: _Found | None = None
    ) -> _Found | Failure:
        """Find the landmarks of some patches, and the pose that they agree on; near their places before, if known."""
        matches = (
            self._matches(body, patches, first=first) if before is None else self._refit_matches(body, patches, before)
        )
        if isinstance(matches, Failure):
            return matches
        numbers = np.array([match.number for match in matches], dtype=np.int64)
        observed = self._project(body)[numbers] + np.array([match.offset_px for match in matches]).reshape(-1, 2)
        options = self.options
        pose = solve_pnp(
            self.viewer.points_body_km[numbers],
            observed,
            np.array([match.covariance_px2 for match in matches]).reshape(-1, 2, 2),
            self.inputs.camera.model,
            self.inputs.geometry.camera_from_body,
            options=PnpOptions(
                inlier_px=options.inlier_px * (_LOOSE if first else 1.0),
                attitude_sigma_rad=options.attitude_sigma_deg * RAD_PER_DEG,
                min_inliers=options.min_landmarks,
            ),
        )
        if isinstance(pose, Failure):
            return pose
        return _Found(matches=matches, observed_px=observed, pose=pose, tried=tuple(patch.number for patch in patches))

    def _matches(self, body: Body, patches: tuple[Patch, ...], *, first: bool) -> tuple[LandmarkMatch, ...] | Failure:
        """Landmarks found, each near the common shift."""
        inputs, options = self.inputs, self.options
        search_px = options.search_px if first else _NEAR_PX
        surfaces = [correlation_surface(inputs.pixels_dn, ~inputs.masked, patch, search_px) for patch in patches]
        shift, radii = np.zeros(2, np.int64), np.full(len(patches), float(search_px))
        if first and patches:
            radii = self._radii(body, patches)
            shift = common_shift(surfaces, radii)
            if int(np.abs(shift).max()) >= search_px:
                detail = f"best match at the edge of the search region, {shift.tolist()} px from the prediction"
                return Failure(Reason.PEAK_AT_EDGE, f"{detail}; increase search_px")
        matches, scores, pixels = [], [], inputs.pixels
        for patch, surface, radius in zip(patches, surfaces, radii, strict=True):
            peak = peak_near(surface, shift, float(radius))
            if peak is None:
                continue
            scores.append(peak[1])
            if peak[1] < options.min_score:
                continue
            match = fit_patch(pixels, patch, np.rint(peak[0]).astype(np.int64), peak[1])
            if match is not None:
                matches.append(match)
        if len(matches) >= options.min_landmarks:
            return tuple(matches)
        detail = f"{len(matches)} of {len(patches)} landmarks found, needed {options.min_landmarks}"
        if scores and float(np.median(scores)) < options.min_score:
            detail += f"; their correlations have a median of {np.median(scores):.2f}, needed {options.min_score:g}"
            return Failure(Reason.LOW_CORRELATION, detail)
        return Failure(Reason.TOO_FEW_MATCHES, detail)

    def _refit_matches(
        self, body: Body, patches: tuple[Patch, ...], before: _Found
    ) -> tuple[LandmarkMatch, ...] | Failure:
        """Landmarks of the last iteration, fitted where they were found."""
        pixels, predicted_px = self.inputs.pixels, self._project(body)
        known = {match.number: (match, px) for match, px in zip(before.matches, before.observed_px, strict=True)}
        matches = []
        for patch in patches:
            if patch.number in known:
                match, observed_px = known[patch.number]
                shift = np.rint(observed_px - predicted_px[patch.number]).astype(np.int64)
                again = fit_patch(pixels, patch, shift, match.score)
                matches += [] if again is None else [again]
        if len(matches) >= self.options.min_landmarks:
            return tuple(matches)
        detail = f"{len(matches)} of {len(patches)} landmarks found, needed {self.options.min_landmarks}"
        return Failure(Reason.TOO_FEW_MATCHES, detail)

    def _radii(self, body: Body, patches: tuple[Patch, ...]) -> Float:
        """Largest distances (n,), px, of landmarks from the common shift, by errors of range and attitude."""
        numbers = [patch.number for patch in patches]
        model = self.inputs.camera.model
        arms = np.linalg.norm(self._project(body)[numbers] - self.inputs.predicted_px, axis=1)
        turn = 3.0 * self.options.attitude_sigma_deg * RAD_PER_DEG
        levers = np.linalg.norm(self.viewer.points_body_km[numbers], axis=1) * model.focal_length_px
        levers = levers / float(np.linalg.norm(body.position_camera_km))
        arms = np.minimum(arms, levers)
        result: Float = _RADIUS_PX + self.options.search_range * arms + min(turn, _FREE_TURN_RAD) * levers
        return np.minimum(result, self.options.search_px)

    def _fix(self, body: Body, found: _Found) -> LandmarkFix:
        """Return the fix of a pose that has converged."""
        inputs, pose = self.inputs, found.pose
        used = [match for match, inlier in zip(found.matches, pose.inliers, strict=True) if inlier]
        numbers = np.array([match.number for match in used])
        rejected, off_px = np.setdiff1d(found.tried, numbers), found.off_px
        covariance = pose.covariance[:3, :3]
        center, covariance_px2 = center_of_position(inputs.camera.model, pose.position_camera_km, covariance)
        score = float(np.mean([match.score for match in used]))
        observed, projected = found.observed_px[pose.inliers], self._project(body)
        known, identity = inputs.geometry.camera_from_body, inputs.identity
        identity["provenance"] = {**inputs.provenance, "landmarks_sha256": self.catalog.sha256}
        return LandmarkFix(
            **identity,
            center_px=center,
            covariance_px2=covariance_px2,
            residuals=pose.residuals_px[pose.inliers].ravel(),
            residuals_at_px=np.repeat(observed, 2, axis=0),
            n_used=len(used),
            n_rejected=len(rejected),
            score=score,
            flags=self._flags(found, observed, score),
            position_camera_km=pose.position_camera_km,
            covariance_camera_km2=covariance,
            limb_px=observed,
            camera_from_body=pose.camera_from_body,
            pose_covariance=pose.covariance,
            attitude_change_rad=(pose.camera_from_body * known.inv()).as_rotvec(),
            landmark_names=tuple(self.catalog.landmarks[number].name for number in numbers),
            landmark_px=observed,
            landmark_predicted_px=projected[numbers],
            covariance_landmarks_px2=np.array([match.covariance_px2 for match in used]) + pose.floor_px**2 * np.eye(2),
            landmark_body_km=self.viewer.points_body_km[numbers],
            rejected_names=tuple(self.catalog.landmarks[number].name for number in rejected),
            rejected_predicted_px=projected[rejected],
            rejected_because=tuple(
                f"{off_px[number]:.1f} px off the others" if number in off_px else "not found" for number in rejected
            ),
        )

    def _flags(self, found: _Found, observed_px: Float, score: float) -> Quality:
        inputs = self.inputs
        area = np.zeros_like(inputs.usable)
        columns, rows = np.rint(observed_px).astype(np.int64).T
        area[np.clip(rows, 0, area.shape[0] - 1), np.clip(columns, 0, area.shape[1] - 1)] = True
        checks = Facts(
            off_px=inputs.camera.model.project(found.pose.position_camera_km) - inputs.predicted_px,
            search_px=self.options.search_px,
            bounded=True,
            n_used=len(observed_px),
            n_offered=len(found.tried),
        )
        return inputs.flags_at(area) | checks.flags
