"""Attitude of an image from its stars."""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike._system.processes import one_thread
from giantlike.camera import Camera
from giantlike.camera_models import model_to_mapping
from giantlike.catalogs import StarCatalog, proper_names
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.errors import BREAKDOWNS, breakdown_text
from giantlike.core.frames import rotate
from giantlike.core.outcomes import AttitudeFix, Failure, Quality, Reason
from giantlike.core.time import utc_text
from giantlike.core.version import VERSION
from giantlike.image import Image
from giantlike.processing.detection.detect import detect_in_parts
from giantlike.processing.detection.detections import DetectionFlag, Detections, UnmeasuredSources
from giantlike.processing.detection.options import DetectionOptions
from giantlike.stars.apriori import Identification, identify_apriori
from giantlike.stars.attitude import AttitudeSolution
from giantlike.stars.consider import attitude_parts, response_to_camera
from giantlike.stars.field import EPOCH_WHEN_UNKNOWN, Sky, half_diagonal_rad
from giantlike.stars.lost_in_space import find_other_scale, identify_in_cone, identify_lost_in_space
from giantlike.stars.matching import attitudes_within, predicted_in_frame
from giantlike.stars.options import StarOptions, bright_enough
from giantlike.stars.other_readings import find_reading, is_interlaced, text_of_error
from giantlike.stars.refine import RefinedAttitude, depth_for, refine_attitude

_LOG = logging.getLogger("giantlike.stars")
_IDENTIFIED_FIRST = 200  # brightest detections tried with an a priori attitude: twice those that vote
_DETECTIONS_PER_STAR, _SPARE_DETECTIONS = 4, 30  # detections used per catalog star expected: fainter ones are noise
_INFORMATION = 0.95  # of all stars, in an attitude: the rest would shrink its covariance by 5 %
_MEASURED_FIRST = 0.96
"""Share measured first. Of 57 star images, 27 fell short of the share above when just as much was measured, because
errors of catalog and neighbors count most for the brightest, and had to be measured once more; with this share 2."""
_LARGE_CHI = 5.0  # root of the reduced chi-square above which residuals are large; no study yet
_LARGE_SHARED_PX = 0.5  # of errors that neighbors share: as large a shift hides in the attitude
_LARGE_BLUR = 1.3
"""Width of stars relative to the PSF of the camera. Measured on 260 star images: 0.97-1.01 without blur, 1.10-1.17 for
motion of one pixel, 1.42-1.78 out of focus; the PSF varies over the field by 0.1-0.2."""
_CLEAR_SNR = 10.0
"""Minimum signal-to-noise ratio of stars in which odd and even rows are compared: centroids to a tenth of a width."""
_ROUND = 0.25  # growth of the minor axis of stars relative to the major axis, above which a blur is isotropic
_UNMATCHED = (Reason.TOO_FEW_MATCHES, Reason.NO_PATTERN_MATCH, Reason.AMBIGUOUS, Reason.FOV_MISMATCH)
"""Reasons of stars that match nowhere near the a priori attitude."""
_RADIAL_SHARE, _RADIAL_STARS = 0.5, 12
"""Share of the squares of the residuals that two radial terms explain, of at least so many stars: by chance 2 of 24."""
_MOST_ALONE = 1 / 3
"""Limit of the fractions of sources and of catalog stars, each of the brighter half, that have no partner."""
_LARGE_FLOOR_PX = 1.0  # error floor, px, above which they are; real calibrated cameras leave 0.1 to 0.2 px


class _SolvedAttitude(NamedTuple):
    """An attitude and the solution that it was made of."""

    fix: AttitudeFix
    solution: AttitudeSolution


class StarNavigation:
    """Attitude of images from their stars: detection, identification and fit.

    Parameters
    ----------
    camera : Camera
    catalog : StarCatalog
    options : StarOptions, optional
    detection : DetectionOptions, optional; options of :func:`~giantlike.processing.detect_sources`
    """

    def __init__(
        self,
        camera: Camera,
        catalog: StarCatalog,
        options: StarOptions | None = None,
        *,
        detection: DetectionOptions | None = None,
    ) -> None:
        self.camera = camera
        self.catalog = catalog
        self.options = StarOptions() if options is None else options
        self.detection = DetectionOptions() if detection is None else detection

    def solve(self, image: Image) -> AttitudeFix | Failure:
        """Estimate the attitude of an image.

        The a priori attitude, if there is one, is tried first, then the whole sky if the options allow it.

        Parameters
        ----------
        image : Image
            Without an epoch, stars are taken at J2016.0; without an observer, as seen from the solar system barycenter
            at rest, so that aberration (up to 20 arcsec from Earth) becomes part of the attitude. The provenance of the
            fix says which. An image of another size than the camera raises InputError.

        Returns
        -------
        AttitudeFix or Failure
            Reasons: as for :func:`~giantlike.processing.detect_sources` and of the identification.
        """
        return self.detect_and_solve(image)[1]

    @one_thread()
    def detect_and_solve(self, image: Image) -> tuple[Detections | Failure, AttitudeFix | Failure]:
        """Detect the stars of an image and estimate its attitude, as :meth:`solve` does.

        Unless ``StarOptions.all_stars`` is set, the brightest sources are measured first. The rest are measured too if
        no attitude is found or if they would shrink its covariance by more than 5 %, which errors that do not depend on
        brightness, of camera or catalog, make likely. Both results are the failure of the detection if that failed.
        """
        first = 1.0 if self.options.all_stars else _MEASURED_FIRST
        until_s = time.thread_time() + self.options.time_limit_s
        shares = sorted({min(first, self.detection.information), self.detection.information})
        for detections in self._detections(image, self.detection, shares):
            if isinstance(detections, Failure):
                return detections, detections
            outcome, left = self._solve(image, detections, until_s), detections.left_out
            if left is None or (isinstance(outcome, _SolvedAttitude) and _enough(detections, outcome, left)):
                break
            if _is_final(outcome):
                break
        assert isinstance(detections, Detections)
        return detections, self._without_interlace(image, detections, outcome)

    def _explain(self, image: Image, detections: Detections, failure: Failure) -> Failure:
        """Failure with its cause, where the stars match with another reading of the a priori attitude or camera."""
        apriori, options = image.camera_from_inertial, self.options
        if apriori is None or options.lost_in_space or failure.reason not in _UNMATCHED:
            return failure
        clean = np.flatnonzero(np.isfinite(detections.covariance_px2).all(axis=(1, 2)) & detections.clean)
        usable = clean[bright_enough(detections.snr[clean], options.min_snr)]
        points, covariance = detections.points_px[usable], detections.covariance_px2[usable]
        sky = sky_of(image, self.catalog, options)
        found = find_reading(points, self.camera, sky, apriori, options)
        if found is None:
            found = find_other_scale(points, covariance, self.camera, sky, apriori, options=options)
        return failure if found is None else Failure(found.reason, f"{found.detail}: {failure.detail}")

    def _without_interlace(
        self, image: Image, detections: Detections, outcome: _SolvedAttitude | Failure
    ) -> AttitudeFix | Failure:
        """Attitude of an outcome, flagged where odd and even rows are shifted against each other."""
        if isinstance(outcome, Failure):
            return self._explain(image, detections, outcome)
        fix = outcome.fix
        stars = fix.detection_indices[detections.snr[fix.detection_indices] > _CLEAR_SNR]
        shifted = is_interlaced(
            image.linearized(self.camera.detector).pixels,
            image.mask,
            detections.points_px[stars],
            detections.background_dn[stars],
            detections.psf_sigma_px,
            math.sqrt(float(fix.covariance_rad2[1, 1])) * fix.focal_length_px,
        )
        return replace(fix, flags=fix.flags | Quality.BLURRED) if shifted else fix

    @one_thread()
    def detect(self, image: Image, options: DetectionOptions | None = None) -> Detections | Failure:
        """Detect the point sources of an image, with the detection options of this object unless others are given."""
        options = self.detection if options is None else options
        return next(self._detections(image, options, (options.information,)))

    def _detections(
        self, image: Image, options: DetectionOptions, shares: Sequence[float]
    ) -> Iterator[Detections | Failure]:
        """Sources of an image, more with every iteration."""
        self.camera.require_image(image)
        image = image.linearized(self.camera.detector)
        return detect_in_parts(
            image.pixels,
            shares,
            detector=image.detector or self.camera.detector,
            psf_sigma_px=None if self.camera.psf is None else self.camera.psf.sigma_px,
            mask=image.mask,
            options=options,
        )

    @one_thread()
    def solve_detections(self, image: Image, detections: Detections) -> AttitudeFix | Failure:
        """Estimate the attitude of an image from its detections; the pixels of the image are not used.

        Detections without the flags of ``NOT_A_STAR`` are tried first, then all that are not extended, because
        undersampled stars may be flagged as hot pixels.
        """
        outcome = self._solve(image, detections, time.thread_time() + self.options.time_limit_s)
        return self._explain(image, detections, outcome) if isinstance(outcome, Failure) else outcome.fix

    def _solve(self, image: Image, detections: Detections, until_s: float) -> _SolvedAttitude | Failure:
        """Attitude from detections, with the solution it was made of; a computation that breaks down is a failure."""
        try:
            return self._solve_detections(image, detections, until_s)
        except BREAKDOWNS as error:
            _LOG.debug("%s: the attitude broke down", image.name, exc_info=True)
            return Failure(Reason.INTERNAL_ERROR, f"the computation broke down: {breakdown_text(error)}")

    def _solve_detections(self, image: Image, detections: Detections, until_s: float) -> _SolvedAttitude | Failure:
        """Attitude from clean detections, or from all that are not extended."""
        measured = np.isfinite(detections.covariance_px2).all(axis=(1, 2))
        clean = measured & detections.clean
        outcome = self._solve_usable(image, detections, np.flatnonzero(clean), until_s)
        rest = measured & ((detections.flags & np.uint16(DetectionFlag.EXTENDED)) == 0)
        solved = isinstance(outcome, _SolvedAttitude)
        if solved or _is_final(outcome) or int(rest.sum()) == int(clean.sum()):
            return outcome
        again = self._solve_usable(image, detections, np.flatnonzero(rest), until_s)
        return again if isinstance(again, _SolvedAttitude) else outcome

    def _solve_usable(
        self, image: Image, detections: Detections, usable: NDArray[np.intp], until_s: float
    ) -> _SolvedAttitude | Failure:
        """Attitude from the detections of indices ``usable`` (k,)."""
        usable = usable[bright_enough(detections.snr[usable], self.options.min_snr)]
        needed = self.options.min_matches
        if usable.size < needed:
            return Failure(
                Reason.TOO_FEW_DETECTIONS,
                f"{usable.size} of {len(detections)} detections look like stars, {needed} are needed",
            )
        points, covariance = detections.points_px[usable], detections.covariance_px2[usable]
        sky = sky_of(image, self.catalog, self.options)
        outcome: RefinedAttitude | Failure = Failure(
            Reason.NO_ATTITUDE, "the image has no a priori attitude: provide one or allow the lost-in-space search"
        )
        method = "a_priori"
        if image.camera_from_inertial is not None:
            outcome = self._from_apriori(image.camera_from_inertial, points, covariance, sky, until_s)
        if isinstance(outcome, Failure) and self.options.lost_in_space:
            _LOG.debug("%s: searching the whole sky, because %s", image.name, outcome.detail)
            first, method = outcome, "lost_in_space"
            outcome = identify_lost_in_space(
                points, covariance, self.camera, sky, options=self.options, until_s=until_s
            )
            if isinstance(outcome, Failure) and first.reason is not Reason.NO_ATTITUDE:
                outcome = Failure(outcome.reason, f"{outcome.detail}; with the a priori attitude: {first.detail}")
        if isinstance(outcome, Failure):
            _LOG.info("%s: no attitude: %s: %s", image.name, outcome.reason, outcome.detail)
            return outcome
        fix = self._fix(image, detections, usable, outcome, method)
        _LOG.info("%s: attitude from %d of %d sources (%s)", image.name, fix.n_used, len(detections), method)
        return _SolvedAttitude(fix, outcome.solution)

    def _from_apriori(
        self, camera_from_inertial: Rotation, points_px: Float, covariance_px2: Float, sky: Sky, until_s: float
    ) -> RefinedAttitude | Failure:
        options, camera = self.options, self.camera
        depth, margin = depth_for(len(points_px)), options.max_pixel_distance
        # the catalog covers any attitude within the margin, to the depth of one image
        several = (1.0 + margin / (half_diagonal_rad(camera) * camera.model.focal_length_px)) ** 2
        around = sky.field(camera, camera_from_inertial, margin_px=margin, count=math.ceil(several * depth))
        wide = around.directions_inertial[:depth]
        expected = camera.contains(camera.model.project(rotate(camera_from_inertial, wide)))
        offered = _DETECTIONS_PER_STAR * int(expected.sum()) + _SPARE_DETECTIONS
        points, covariance = points_px[:offered], covariance_px2[:offered]
        found: Identification | Failure = Failure(Reason.TOO_FEW_MATCHES, "not tried")
        for number in sorted(
            {min(_IDENTIFIED_FIRST, len(points)), len(points)}
        ):  # the brightest alone suffice, and are fast
            found = identify_apriori(
                wide[: depth_for(number)], points[:number], camera, camera_from_inertial, options=options
            )
            if isinstance(found, Identification):
                break
        if isinstance(found, Failure):
            near: RefinedAttitude | Failure = found
        else:
            near = refine_attitude(
                around,
                points,
                covariance,
                camera,
                found.camera_from_inertial,
                radius_px=options.inlier_px,
                trials=lambda radius_px: attitudes_within(radius_px, options.max_pixel_distance),
                options=options,
            )
        if isinstance(near, RefinedAttitude):
            return near
        far = identify_in_cone(
            points_px, covariance_px2, camera, sky, camera_from_inertial, options=options, until_s=until_s
        )
        return far if isinstance(far, RefinedAttitude) else Failure(far.reason, f"{far.detail}; {near.detail}")

    def _fix(
        self, image: Image, detections: Detections, usable: NDArray[np.intp], outcome: RefinedAttitude, method: str
    ) -> AttitudeFix:
        solution, used = outcome.solution, outcome.solution.used
        field = outcome.field.select(outcome.matches.star_indices[used])
        by_camera = response_to_camera(solution, field)
        parts = attitude_parts(solution, field, by_camera, self.camera, image, self.options)
        indices = usable[outcome.matches.detection_indices[used]]
        focal = solution.model.focal_length_px
        apriori_error = self._apriori_error(image, solution.camera_from_inertial)
        radial = _radial_text(solution, detections.points_px[indices])
        return AttitudeFix(
            camera_from_inertial=solution.camera_from_inertial,
            covariance_rad2=sum_parts(parts, tuple(Cause)),
            star_ids=field.stars.ids,
            detection_indices=indices.astype(np.int64),
            observed_px=detections.points_px[indices],
            predicted_px=solution.predicted_px[used],
            sigma_px=solution.sigma_px[used],
            magnitudes=field.stars.magnitude,
            star_names=proper_names(field.stars),
            n_detected=outcome.n_detections,
            n_rejected=int((~used).sum()),
            false_match_probability=outcome.false_match_probability,
            focal_length_px=focal,
            fov_deg=math.degrees(2.0 * math.atan(self.camera.columns / (2.0 * focal))),
            rejected_px=detections.points_px[usable[outcome.matches.detection_indices[~used]]],
            camera_name=self.camera.frame_name,
            flags=_flags(image, solution, detections.flags[indices])
            | self._blur(detections, indices)
            | self._other_sky(detections, usable, outcome)
            | (Quality.LARGE_RESIDUALS if radial else Quality.NONE)
            | (Quality.WRONG_APRIORI if apriori_error else Quality.NONE),
            provenance=self._provenance(image, outcome, method),
            notes=tuple(text for text in (apriori_error, radial) if text),
            parts=parts,
            by_camera=by_camera,
        )

    def _apriori_error(self, image: Image, solved: Rotation) -> str:
        """Sentence on an a priori attitude that is farther from the solved one than the options allow, else empty."""
        apriori, most = image.camera_from_inertial, math.radians(self.options.attitude_error_deg)
        if apriori is None or (solved * apriori.inv()).magnitude() <= most:
            return ""
        return text_of_error(apriori, solved, most)

    def _blur(self, detections: Detections, indices: NDArray[np.intp]) -> Quality:
        """Flag of stars that are wider or narrower than the camera's optics make them."""
        if self.camera.psf is None:
            return Quality.NONE
        weights = 1.0 / detections.sigma_px[indices] ** 2
        ratio = float(weights @ detections.width_px[indices] / weights.sum()) / detections.psf_sigma_px
        if 1.0 / _LARGE_BLUR < ratio < _LARGE_BLUR:
            return Quality.NONE
        if detections.moments is None or ratio < 1.0:
            return Quality.BLURRED
        longest, shortest = weights @ (detections.moments[indices] - 0.5)
        return Quality.DEFOCUSED if shortest > _ROUND * longest else Quality.BLURRED

    def _other_sky(self, detections: Detections, usable: NDArray[np.intp], outcome: RefinedAttitude) -> Quality:
        """Flag of an image that shows two skies: bright sources without a star, and bright stars without a source."""
        solution, matches = outcome.solution, outcome.matches
        stars, found = matches.star_indices[solution.used], usable[matches.detection_indices[solution.used]]
        camera, magnitude = replace(self.camera, model=solution.model), outcome.field.stars.magnitude
        predicted = predicted_in_frame(
            outcome.field.directions_inertial, camera, solution.camera_from_inertial, margin_px=0.0
        )
        seen = usable[detections.snr[usable] > np.median(detections.snr[found])]
        expected = np.flatnonzero(np.isfinite(predicted[:, 0]) & (magnitude < np.median(magnitude[stars])))
        alone = [1.0 - float(np.isin(*pair).mean()) for pair in ((seen, found), (expected, stars)) if pair[0].size]
        return Quality.AMBIGUOUS if len(alone) == 2 and min(alone) > _MOST_ALONE else Quality.NONE

    def _provenance(self, image: Image, outcome: RefinedAttitude, method: str) -> Mapping[str, str]:
        solution = outcome.solution
        return {
            "giantlike": VERSION,
            "catalog": f"{self.catalog.name}: {self.catalog.version}",
            "band": self.catalog.band,
            "image": image.name,
            "image_sha256": image.sha256,
            "camera": self.camera.name,
            "camera_model": json.dumps(model_to_mapping(solution.model)),
            "identification": method,
            "epoch": f"J{EPOCH_WHEN_UNKNOWN} assumed" if image.epoch is None else utc_text(image.epoch),
            "observer": "barycenter at rest assumed" if image.observer is None else "position and velocity",
            "error_floor_px": f"{solution.error_floor_px:.4g}",
            "error_factor": f"{solution.error_factor:.4g}",
            "hidden_floor_px": f"{solution.hidden_floor_px:.4g}",
            "shared_error_px": f"{solution.shared_error_px:.4g}",
            "unmodeled_errors": "likely" if solution.unmodeled_likely else "not likely",
            "reduced_chi2": f"{solution.reduced_chi2:.4g}",
        }


def _radial_text(solution: AttitudeSolution, observed_px: Float) -> str:
    """Sentence on residuals (n, 2) that point to or from the boresight, as of a wrong distortion; empty for others."""
    used = solution.used
    residuals, weights = observed_px - solution.predicted_px[used], 1.0 / solution.sigma_px[used]
    away = solution.predicted_px[used] - solution.model.project([0.0, 0.0, 1.0])
    radius = np.linalg.norm(away, axis=1)
    if len(away) < _RADIAL_STARS or not np.isfinite(radius).all():
        return ""
    scaled = (radius / radius.max())[:, None]
    columns = [(weights[:, None] * away / radius.max() * scaled**power).ravel() for power in (0, 2)]
    measured = (weights[:, None] * residuals).ravel()
    values = np.linalg.lstsq(np.stack(columns, axis=1), measured, rcond=None)[0]
    left = measured - np.stack(columns, axis=1) @ values
    explained = 1.0 - float(left @ left) / max(float(measured @ measured), np.finfo(float).tiny)
    largest_px = float(np.max(np.abs(values[0] * scaled + values[1] * scaled**3)))
    if largest_px < _LARGE_SHARED_PX or explained < _RADIAL_SHARE:
        return ""
    return (
        f"the residuals of the stars are radial, up to {largest_px:.2g} px: the radial distortion or the focal length "
        "of the camera is wrong (check the sign of k1, or calibrate)"
    )


def _is_final(outcome: _SolvedAttitude | Failure) -> bool:
    """True for a failure after which other detections are not tried: stars of a mirrored image, or no time left."""
    return isinstance(outcome, Failure) and outcome.reason in (Reason.MIRRORED_IMAGE, Reason.TIME_LIMIT)


def _enough(detections: Detections, solved: _SolvedAttitude, left: UnmeasuredSources) -> bool:
    """True if the sources left out would shrink the covariance of an attitude by less than 5 %.

    As many of them as of the measured ones are assumed to be stars, with median errors. Where unmodeled errors are
    likely, all sources are measured: few stars estimate such errors badly.
    """
    fix, solution = solved
    if solution.unmodeled_likely:
        return False
    variance = fix.sigma_px**2 + solution.hidden_floor_px**2
    own = detections.sigma_px[fix.detection_indices] ** 2
    beyond = max(float(np.median(variance - own)), 0.0)
    share = fix.n_used / max(fix.n_detected, 1)
    rest = share * float(np.sum(1.0 / (left.sigma_px**2 + beyond)))
    return rest <= (1.0 - _INFORMATION) * (rest + float(np.sum(1.0 / variance)))


def sky_of(image: Image, catalog: StarCatalog, options: StarOptions) -> Sky:
    """Sky of an image: the catalog as seen by its observer at its epoch."""
    observer = image.observer
    return Sky(
        catalog=catalog,
        et=image.et,
        observer_position_km=None if observer is None else observer.position_km,
        observer_velocity_km_s=None if observer is None else observer.velocity_km_s,
        max_magnitude=options.max_magnitude,
        light_deflection=options.light_deflection,
    )


def _flags(image: Image, solution: AttitudeSolution, detection_flags: NDArray[np.uint16]) -> Quality:
    """Flags of a solution and of the detections that it used."""
    flags = Quality.NONE
    together = DetectionFlag(int(np.bitwise_or.reduce(detection_flags)))
    if image.observer is None:
        flags |= Quality.OBSERVER_UNKNOWN
    if image.epoch is None:
        flags |= Quality.EPOCH_UNKNOWN
    if DetectionFlag.SATURATED in together:
        flags |= Quality.SATURATED
    if DetectionFlag.MASKED in together:
        flags |= Quality.MASKED
    if 2 * int(solution.used.sum()) < solution.used.size:
        flags |= Quality.MANY_REJECTED
    large = solution.reduced_chi2 > _LARGE_CHI**2 and solution.error_floor_px > _LARGE_FLOOR_PX
    if large or solution.shared_error_px > _LARGE_SHARED_PX:
        flags |= Quality.LARGE_RESIDUALS
    return flags
