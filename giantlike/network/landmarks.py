"""Tracks by a shape: landmarks of a body, rendered in the pose of each image and found there one by one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from giantlike.camera import Camera
from giantlike.core.arrays import Float, require, require_number, unit
from giantlike.core.frames import rotate, skew
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.core.values import Value
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.network.adjust import adjust
from giantlike.network.photos import Photo, Tracks
from giantlike.network.result import NetworkFix, PointStatus
from giantlike.ray_tracing import Body
from giantlike.relative.inputs import EstimatorInputs, gather
from giantlike.relative.landmarks.matching import LandmarkMatch, common_shift, correlation_surface, fit_patch, peak_near
from giantlike.relative.landmarks.rendering import LandmarkRenderer, rays_for
from giantlike.relative.landmarks.selection import landmarks_of
from giantlike.relative.landmarks.visibility import VisibilityOptions, viewer_for
from giantlike.scene import Scene
from giantlike.shapes import Shape, TriangleMesh
from giantlike.shapes.detail import LevelsOfDetail
from giantlike.shapes.landmarks import LandmarkCatalog

_NEAR_PX = 6  # search around the common shift: errors of attitude and range on bodies of some hundred px, relief
_REACH_SIGMAS, MAX_SEARCH_PX = 5.0, 1000  # largest error of a declared pose, and the widest search
_FIRST_SIGMA = 0.02  # of the mean radius: a priori sigma of points before their spread about the shape is known
_FLOOR_PX = (0.3, 0.02)  # px: error of templates before it is estimated, and the least that it is taken for

_MOVED_PX = 0.5  # px: motion of landmarks by which their templates are rendered again
_ROUNDS = 8  # of adjustments that find the errors of templates and shape: the last change is some percent


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackOptions:
    """Options of :func:`~giantlike.network.find_tracks`.

    Parameters
    ----------
    search_px : int, px; largest error of the predicted center per axis, or 5 a priori sigmas where these are less
    min_score : float; minimum correlation of a landmark that counts as found
    min_landmarks : int; minimum number of landmarks of an image
    sigma_points_km : float, km, optional; of landmarks per axis, by the shape; by default as found
    visibility : VisibilityOptions

    Raises
    ------
    InputError
        A value is out of range.
    """

    search_px: int = 40
    min_score: float = 0.5
    min_landmarks: int = 4
    sigma_points_km: float | None = None
    visibility: VisibilityOptions = field(default_factory=lambda: VisibilityOptions(max_landmarks=150))

    def __post_init__(self) -> None:
        require(isinstance(self.search_px, int) and 1 <= self.search_px <= MAX_SEARCH_PX,
                f"search_px must be a whole number in [1, {MAX_SEARCH_PX}], got {self.search_px}")  # fmt: skip
        require(0.0 < self.min_score < 1.0, f"min_score must be in (0, 1), got {self.min_score}")
        require_number(self.min_landmarks, "min_landmarks", least=4)
        if self.sigma_points_km is not None:
            require_number(self.sigma_points_km, "sigma_points_km", above=0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LandmarkMeasures(Value):
    """Landmarks found in an image.

    Parameters
    ----------
    numbers : (k,) int64; in the catalog of the shape
    points_px : (k, 2) float64, px
    covariance_px2 : (k, 2, 2) float64, px^2; by the noise of the pixels alone
    scores : (k,) float64; correlations with the templates
    rendered : Photo; pose of the templates
    """

    numbers: NDArray[np.int64]
    points_px: Float
    covariance_px2: Float
    scores: Float
    rendered: Photo


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundTracks(Value):
    """Tracks by a shape.

    Parameters
    ----------
    photos : tuple of Photo; images with tracks, in their a priori poses
    tracks : Tracks
    failures : mapping of str to Failure; by the names of the other images
    floor_px : float, px; error of templates, per axis, that the sigmas of the measures hold beside the noise
    sigma_points_km : float, km; a priori sigma of the landmarks
    """

    photos: tuple[Photo, ...]
    tracks: Tracks
    failures: Mapping[str, Failure]
    floor_px: float
    sigma_points_km: float


def photo_of(image: Image, camera: Camera, scene: Scene, target: str | None = None) -> Photo | Failure:
    """Return the a priori pose of an image, in the frame of the body.

    Parameters
    ----------
    image : Image; with an attitude
    camera : Camera
    scene : Scene
    target : str, optional; may be left out where the scene has one

    Returns
    -------
    Photo or Failure
        Light time and aberration, both of the center of the body, are removed: the camera as it stands in the rest
        frame of the body, at the range by which the size of the body goes (:func:`~giantlike.core.light.boosted`).
        What is not declared (a covariance of the attitude, an error of the ephemeris) is free.

    Raises
    ------
    InputError
        There is no such target.
    """
    geometry = scene.geometry(image, target)
    if isinstance(geometry, Failure):
        return geometry
    states, ephemeris = scene.circumstances(image, geometry.target.name), geometry.target.ephemeris
    light_time_s = geometry.range_km / SPEED_OF_LIGHT_KM_S if states is None else states.light_time_s
    et = (0.0 if image.et is None else image.et) - light_time_s
    if isinstance(ephemeris, ApparentGeometry):
        oriented = ephemeris.inertial_from_body
    else:
        oriented = ephemeris.inertial_from_body(et)
    camera_from_inertial = geometry.camera_from_body * oriented.inv()
    covariance = np.diag([np.inf] * 6)
    if image.attitude_covariance_rad2 is not None:
        covariance[:3, :3] = image.attitude_covariance_rad2
    if geometry.covariance_ephemeris_km2.any():
        turn = camera_from_inertial.as_matrix()
        covariance[3:, 3:] = turn.T @ geometry.covariance_ephemeris_km2 @ turn
    return Photo(
        name=image.name,
        model=camera.model,
        camera_from_inertial=camera_from_inertial,
        position_km=-rotate(camera_from_inertial.inv(), geometry.position_camera_km),
        covariance_pose=(covariance + covariance.T) / 2.0,
        inertial_from_body=oriented,
        et=et,
        columns=camera.columns,
        rows=camera.rows,
        sun_direction=rotate(camera_from_inertial.inv(), geometry.sun_direction_camera),
    )


def catalog_of(name: str, shape: Shape) -> LandmarkCatalog | Failure:
    """Return the landmarks of the mesh of a target."""
    mesh = shape.finest if isinstance(shape, LevelsOfDetail) else shape
    if isinstance(mesh, TriangleMesh):
        return landmarks_of(mesh)
    return Failure(Reason.WRONG_SHAPE, f"{name}: landmarks need a mesh, the shape is a {type(mesh).__name__}")


def measure_landmarks(
    image: Image,
    camera: Camera,
    scene: Scene,
    target: str | None = None,
    *,
    pose: Photo | None = None,
    options: TrackOptions | None = None,
) -> LandmarkMeasures | Failure:
    """Find the landmarks of the shape of a target in an image."""
    options = TrackOptions() if options is None else options
    inputs = gather(image, camera, scene, target, estimator="network", options=options)
    if isinstance(inputs, Failure):
        return inputs
    body_shape = inputs.geometry.target.shape
    catalog, apriori = catalog_of(inputs.target_name, body_shape), photo_of(image, camera, scene, target)
    if isinstance(catalog, Failure) or isinstance(apriori, Failure):
        return catalog if isinstance(catalog, Failure) else apriori  # type: ignore[return-value]
    rendered = apriori if pose is None else pose
    body = _body(inputs, rendered)
    sun = rotate(rendered.camera_from_inertial, np.asarray(apriori.sun_direction))
    viewer, plane = viewer_for(catalog, body.shape), inputs.focal_plane()
    renderer = LandmarkRenderer(
        catalog,
        plane,
        sun_direction_camera=sun,
        max_size_px=options.visibility.max_size_px,
        rays_per_pixel_side=rays_for(plane.psf_sigma_px),
        other_law=True,
    )
    seen = viewer.find_visible(body, plane, sun_direction_camera=sun, options=options.visibility)
    if pose is None and seen.numbers.size:
        rough, _ = renderer.roughly().patches(body, seen)
        search_px = min(options.search_px, _find_reach_px(apriori))
        surfaces = [correlation_surface(inputs.pixels_dn, ~inputs.masked, one, search_px) for one in rough]
        shift = common_shift(surfaces, np.full(len(surfaces), float(_NEAR_PX))) if surfaces else np.zeros(2, np.int64)
        if int(np.abs(shift).max()) >= search_px:
            detail = (
                f"best match at the edge of the search region, {shift.tolist()} px off: increase search_px, or the "
            )
            return inputs.fail(Reason.PEAK_AT_EDGE, detail + "declared errors of attitude and ephemeris")
        ahead = camera.model.unproject(camera.model.project(body.position_camera_km) + shift)
        body = replace(body, position_camera_km=inputs.geometry.range_km * ahead / np.linalg.norm(ahead))
        rendered = replace(rendered, position_km=-rotate(rendered.camera_from_inertial.inv(), body.position_camera_km))
        seen = viewer.find_visible(body, plane, sun_direction_camera=sun, options=options.visibility)
    patches = renderer.patches(body, seen)[0] if seen.numbers.size else ()
    matches: list[LandmarkMatch] = []
    for patch in patches:
        peak = peak_near(
            correlation_surface(inputs.pixels_dn, ~inputs.masked, patch, _NEAR_PX), np.zeros(2, np.int64), _NEAR_PX
        )
        if peak is not None and peak[1] >= options.min_score:
            match = fit_patch(inputs.pixels, patch, np.rint(peak[0]).astype(np.int64), peak[1])
            matches += [] if match is None else [match]
    if len(matches) < options.min_landmarks:
        detail = f"{len(matches)} of {len(patches)} landmarks found, needed {options.min_landmarks}; {seen}"
        return inputs.fail(Reason.TOO_FEW_MATCHES, detail)
    numbers = np.array([match.number for match in matches])
    predicted = camera.model.project(body.to_camera(viewer.points_body_km[numbers]) + body.position_camera_km)
    return LandmarkMeasures(
        numbers=numbers,
        points_px=predicted + np.array([match.offset_px for match in matches]),
        covariance_px2=np.array([match.covariance_px2 for match in matches]),
        scores=np.array([match.score for match in matches]),
        rendered=rendered,
    )


def _find_reach_px(photo: Photo) -> int:
    """Largest error of the predicted center by the a priori covariance of a pose."""
    covariance = np.asarray(photo.covariance_pose)
    if not np.isfinite(covariance).all():
        return MAX_SEARCH_PX
    ahead = rotate(photo.camera_from_inertial, -photo.position_km)
    turns = photo.camera_from_inertial.as_matrix()
    moved = photo.model.project_jacobian(ahead) @ np.concatenate([-skew(ahead), -turns], axis=1)
    largest = float(np.linalg.eigvalsh(moved @ covariance @ moved.T)[-1])
    return _NEAR_PX + math.ceil(_REACH_SIGMAS * math.sqrt(max(largest, 0.0)))


def _body(inputs: EstimatorInputs, photo: Photo) -> Body:
    """Body of an image in a pose."""
    return replace(
        inputs.geometry.body(-rotate(photo.camera_from_inertial, photo.position_km)),
        camera_from_body=photo.camera_from_inertial * photo.inertial_from_body,
    )


def tracks_of(
    measures: Sequence[LandmarkMeasures], catalog: LandmarkCatalog, *, floor_px: float, spread_km: tuple[float, float]
) -> Tracks:
    """Join the measures of images to tracks; landmarks seen once are left out.

    ``spread_km``: standard deviations of landmarks about the shape, along their radius and per axis across it.
    """
    photo = np.repeat(np.arange(len(measures)), [len(one.numbers) for one in measures])
    numbers = np.concatenate([one.numbers for one in measures])
    kept = np.bincount(numbers)[numbers] >= 2
    require(bool(kept.any()), "no landmark is found in two images")
    chosen, point = np.unique(numbers[kept], return_inverse=True)
    variance = np.concatenate([np.trace(one.covariance_px2, axis1=1, axis2=2) for one in measures]) / 2.0
    landmarks = [catalog.landmarks[number] for number in chosen]
    points_km = np.array([landmark.point_body_km for landmark in landmarks])
    up = unit(points_km)
    along, across = np.square(spread_km)
    return Tracks(
        names=tuple(landmark.name for landmark in landmarks),
        point=point,
        photo=photo[kept],
        points_px=np.concatenate([one.points_px for one in measures])[kept],
        sigma_px=np.sqrt(variance + floor_px**2)[kept],
        points_km=points_km,
        covariance_points_km2=across * np.eye(3) + (along - across) * up[:, :, None] * up[:, None, :],
    )


def adjust_tracks(
    photos: Sequence[Photo], measures: Sequence[LandmarkMeasures], catalog: LandmarkCatalog, options: TrackOptions
) -> tuple[FoundTracks, NetworkFix] | Failure:
    """Join measures to tracks, with the errors of templates and shape that their residuals show, and adjust them.

    The error of templates makes the noise of the adjustment one, that of the shape is the most likely spread of the
    points about it along their radius and across (expectation and maximization): a shape errs in its heights most.
    Ground that the shape lacks moves a template along the surface in all images alike: the spread across the radius is
    an error of each point that no residual shows.
    """
    radius_km = float(np.mean([np.linalg.norm(landmark.point_body_km) for landmark in catalog.landmarks]))
    first_km = options.sigma_points_km or _FIRST_SIGMA * radius_km
    floor_px, along_km, across_km = _FLOOR_PX[0], first_km, first_km
    for _ in range(_ROUNDS):
        tracks = tracks_of(measures, catalog, floor_px=floor_px, spread_km=(along_km, across_km))
        fix = adjust(photos, tracks)
        if isinstance(fix, Failure):
            return fix
        sigma_km = math.sqrt((along_km**2 + 2.0 * across_km**2) / 3.0)
        adjusted = FoundTracks(
            photos=tuple(photos), tracks=replace(tracks, common_sigma_km=across_km), failures={}, floor_px=floor_px,
            sigma_points_km=sigma_km,
        ), fix  # fmt: skip
        noise = float(np.median(tracks.sigma_px**2)) - floor_px**2
        found = max(fix.noise**2, fix.chi2 / max(fix.freedom, 1)) * (noise + floor_px**2)
        floor_px = math.sqrt(max(found - noise, _FLOOR_PX[1] ** 2))
        good = fix.point_status == PointStatus.CHECKED
        if options.sigma_points_km is None and good.any():
            start_km = np.asarray(tracks.points_km)[good]
            off, up = fix.points_km[good] - start_km, unit(start_km)
            squares = off[:, :, None] * off[:, None, :] + fix.covariance_points_km2[good]
            along = float(np.einsum("pi,pij,pj->p", up, squares, up).mean())
            across = (float(np.trace(squares, axis1=1, axis2=2).mean()) - along) / 2.0
            along_km, across_km = (max(math.sqrt(each), 1e-4 * radius_km) for each in (along, across))
    return adjusted


def has_moved(measures: LandmarkMeasures, pose: Photo, catalog: LandmarkCatalog) -> bool:
    """Tell whether the landmarks found lie elsewhere by a pose than where they were rendered, so that they change."""
    points = np.array([catalog.landmarks[number].point_body_km for number in measures.numbers])
    pixels = [
        each.model.project(
            rotate(each.camera_from_inertial, rotate(each.inertial_from_body, points) - each.position_km)
        )
        for each in (measures.rendered, pose)
    ]
    return not float(np.abs(pixels[1] - pixels[0]).max()) < _MOVED_PX


def find_tracks(
    images: Sequence[Image],
    camera: Camera,
    scene: Scene,
    target: str | None = None,
    *,
    options: TrackOptions | None = None,
) -> FoundTracks | Failure:
    """Find landmarks of the shape of a target in images, first at the a priori poses, then at adjusted ones.

    Parameters
    ----------
    images : sequence of Image; with attitudes; read twice, so that a sequence may load them when asked
    camera : Camera
    scene : Scene
    target : str, optional; may be left out where the scene has one; its shape has to be a mesh
    options : TrackOptions, optional

    Returns
    -------
    FoundTracks or Failure
        For :func:`~giantlike.network.adjust`: a priori poses, measures, and landmarks where the shape has them.

    Raises
    ------
    InputError
        There is no such target, an image is of another size than the camera, or no landmark is in two images.
    """
    options = TrackOptions() if options is None else options
    known = scene.target(target)
    catalog = catalog_of(known.name, known.shape)
    if isinstance(catalog, Failure):
        return catalog
    failures, kept = dict[str, Failure](), list[tuple[int, Photo, LandmarkMeasures]]()
    for number, image in enumerate(images):
        photo = photo_of(image, camera, scene, target)
        found = (
            photo if isinstance(photo, Failure) else measure_landmarks(image, camera, scene, target, options=options)
        )
        if isinstance(found, Failure) or isinstance(photo, Failure):
            failures[image.name] = found  # type: ignore[assignment]
        else:
            kept.append((number, photo, found))
    if len(kept) < 2:
        why = "; ".join(failure.detail for failure in failures.values())
        return Failure(Reason.TOO_FEW_MATCHES, f"landmarks are found in {len(kept)} images, needed 2: {why}")
    photos, measures = [photo for _, photo, _ in kept], [one for *_, one in kept]
    adjusted = adjust_tracks(photos, measures, catalog, options)
    if isinstance(adjusted, Failure):
        return adjusted
    for place, (number, *_) in enumerate(kept):
        pose = adjusted[1].photos[place]
        if not has_moved(measures[place], pose, catalog):
            continue
        again = measure_landmarks(images[number], camera, scene, target, pose=pose, options=options)
        measures[place] = measures[place] if isinstance(again, Failure) else again
    adjusted = adjust_tracks(photos, measures, catalog, options)
    return adjusted if isinstance(adjusted, Failure) else replace(adjusted[0], failures=failures)


def move_landmarks(catalog: LandmarkCatalog, fix: NetworkFix) -> LandmarkCatalog:
    """Move the maps of landmarks to the points of an adjusted network, for ``surface_features``."""
    found = {
        name: point for name, point in zip(fix.tracks.names, fix.points_km, strict=True) if np.isfinite(point).all()
    }
    moved = tuple(
        replace(one, map=replace(one.map, center_body_km=one.map.center_body_km + found[one.name] - one.point_body_km))
        for one in catalog.landmarks
        if one.name in found
    )
    return LandmarkCatalog(moved, body_name=catalog.body_name)
