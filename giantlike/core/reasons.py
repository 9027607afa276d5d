"""Reasons of failures and quality flags of fixes, each with its meaning and its remedy."""

from __future__ import annotations

import enum
from enum import StrEnum


class Reason(StrEnum):
    """Reason of a failure, with its remedy; the values are those of tables and JSON."""

    UNREADABLE_IMAGE = "unreadable_image"
    """The image file cannot be read, or has another size than the camera.

    The detail names the file and its error.
    """
    NO_SIGNAL = "no_signal"
    """Nothing exceeds the noise at the predicted position of the target.

    Look at the image: exposure, pointing, the correct target; widen `search_px` if it lies farther away.
    """
    MASKED = "masked"
    """Bad pixels cover the signal that would be measured.

    Check the mask and the bad-pixel frame.
    """
    SATURATED = "saturated"
    """Too much of the signal that would be measured is saturated.

    Use a shorter exposure, or an estimator of limbs, which needs only the outline.
    """
    TOO_FEW_DETECTIONS = "too_few_detections"
    """Fewer stars were detected than an identification needs.

    Lower `threshold_sigma`, expose longer, or take the attitude from neighboring images (`long_exposure_s`).
    """
    NO_CATALOG_STARS = "no_catalog_stars"
    """The catalog has too few stars in the field.

    Use a deeper catalog, or raise `max_magnitude`.
    """
    TOO_FEW_MATCHES = "too_few_matches"
    """Too few detections, or landmarks, match at any pose near the a priori one.

    Check the a priori attitude, the focal length and the observer; search for stars over the whole sky
    (`lost_in_space`).
    """
    WRONG_APRIORI = "wrong_apriori"
    """The stars match with another reading of the a priori attitude: other axes, order or direction, or another roll.

    The detail names it. Correct the a priori attitudes; `lost_in_space` finds the attitude without them.
    """
    NO_PATTERN_MATCH = "no_pattern_match"
    """No pattern of detections is one of the catalog.

    Check the field of view and distortion of the camera, and the epoch; look for trails and dense fields.
    """
    AMBIGUOUS = "ambiguous"
    """Two solutions fit the image equally well.

    Give a better a priori, or check which of them is correct.
    """
    FOV_MISMATCH = "fov_mismatch"
    """The scale of the image differs from the scale of the camera.

    Calibrate the camera, or give its field of view with a larger error.
    """
    TIME_LIMIT = "time_limit"
    """The search for patterns of stars took its time limit without a result.

    Check focal length and detections (spurious ones make it slow), raise `time_limit_s`, or give an a priori attitude.
    """
    MIRRORED_IMAGE = "mirrored_image"
    """The image shows the sky mirrored.

    Read it with the rows turned around (`bottom_up`).
    """
    DEGENERATE_GEOMETRY = "degenerate_geometry"
    """The geometry of the observations does not determine the solution.

    Use more observations, or ones that are spread wider.
    """
    NO_ATTITUDE = "no_attitude"
    """The image has no attitude.

    Look at the reason of its star solution, or give an a priori attitude.
    """
    NO_EPOCH = "no_epoch"
    """The image has no epoch.

    Give it in the header or in the geometry table.
    """
    NO_GEOMETRY = "no_geometry"
    """Position or orientation of the target are not known at this epoch.

    Give them in the geometry table, or kernels that cover the epoch.
    """
    OUT_OF_FRAME = "out_of_frame"
    """The target lies outside of the image.

    Nothing, if that is true; else check attitude and ephemeris.
    """
    SUN_KEEP_OUT = "sun_keep_out"
    """A planned image points the camera too near to the Sun.

    Leave it out, or point elsewhere; `keep_out_deg` is the limit.
    """
    NOT_LIT = "not_lit"
    """The side of the target that the camera sees is dark.

    Nothing, if that is true; else check the direction of the Sun.
    """
    NO_LIMB = "no_limb"
    """There is no limb to measure: the body is too small, not resolved, or its edge does not stand out.

    The detail tells which; small bodies are for `cross_correlation`, `moment` or `unresolved`.
    """
    LOW_CORRELATION = "low_correlation"
    """The image does not look like the template.

    Check shape, orientation, target and the direction of the Sun.
    """
    PEAK_AT_EDGE = "peak_at_edge"
    """The best match lies at the border of the search region.

    Widen `search_px`, or improve the a priori.
    """
    NOT_CONVERGED = "not_converged"
    """The iteration did not converge.

    Give a better a priori; look at the image for a second body or stray light.
    """
    LARGE_RESIDUALS = "large_residuals"
    """Residuals are several times those that the model allows.

    Look at the residuals: shape, distortion or blur may be wrong.
    """
    WRONG_SHAPE = "wrong_shape"
    """The assumed shape disagrees with the image.

    Use a mesh for a body that is not an ellipsoid, or an estimator that uses its relief.
    """
    NOT_UNRESOLVED = "not_unresolved"
    """The body is too large for an estimator of unresolved ones.

    Use `cross_correlation` or an estimator of limbs.
    """
    REJECTED = "rejected"
    """A person rejected it.

    `giantlike edit RUN restore` takes that back.
    """
    INTERNAL_ERROR = "internal_error"
    """An error of this program; the traceback is in the record.

    Report it, with the image.
    """


class Outcome(StrEnum):
    """Outcome of a step for an image or a target in it; only ``failed`` counts as a failure."""

    OK = "ok"
    """There is a result."""
    ACCEPTED = "accepted"
    """A named check objects to the result, and a user accepted it."""
    SUSPECT = "suspect"
    """There is a result, but a named check objects."""
    FAILED = "failed"
    """There is no result."""
    REJECTED = "rejected"
    """A user rejected the result."""
    NOT_APPLICABLE = "not_applicable"
    """The estimator is not made for such a body, or for one of this size."""
    NOT_IN_FIELD = "not_in_field"
    """The target is predicted far outside of the image."""

    @property
    def words(self) -> str:
        """The outcome in words: ``not in the field``."""
        return "not in the field" if self is Outcome.NOT_IN_FIELD else self.value.replace("_", " ")

    @property
    def is_attempt(self) -> bool:
        """True for a result, and for a failure to get one."""
        return self in (Outcome.OK, Outcome.ACCEPTED, Outcome.SUSPECT, Outcome.FAILED)

    @property
    def is_usable(self) -> bool:
        """True for a result that is used by default: not suspect, or accepted by a user."""
        return self in (Outcome.OK, Outcome.ACCEPTED)


class Quality(enum.Flag):
    """Quality flags of a fix; those in ``SUSPECT`` make its status ``suspect``."""

    NONE = 0
    SATURATED = enum.auto()
    """Saturated pixels lie in the measured region.

    They are left out; a shorter exposure would give more information.
    """
    MASKED = enum.auto()
    """Bad pixels lie in the measured region.

    They are left out; nothing is to be done.
    """
    CUT_BY_FRAME = enum.auto()
    """The body reaches over the edge of the image.

    No action is needed: the visible part was used.
    """
    APRIORI_ATTITUDE = enum.auto()
    """The attitude is the a priori one of the image: there is no star solution.

    Its error is in the covariance only as far as it was declared.
    """
    INTERPOLATED_ATTITUDE = enum.auto()
    """The attitude comes from neighboring star images.

    Fixes between the same star images share its error.
    """
    SHAPE_APPROXIMATED = enum.auto()
    """The estimator replaced the shape by a simpler one, such as a mesh by its ellipsoid.

    Prefer an estimator that takes the mesh.
    """
    SHORT_ARC = enum.auto()
    """Less than a quarter of the limb was used.

    Range and the direction along the arc are less precise; the covariance includes this.
    """
    LOW_SCORE = enum.auto()
    """All of the limb is saturated, so that only the wings of the point spread function remain.

    Expose shorter, or use an estimator of light that knows saturation.
    """
    MANY_REJECTED = enum.auto()
    """More than half of the observations were rejected.

    Look at the rejected ones: a wrong shape, clouds, relief or a second body.
    """
    FAR_FROM_PREDICTION = enum.auto()
    """The estimate lies at or beyond the border of the declared search, or beyond declared errors of the prediction,
    also by the size of the body in the image.

    Check that it is the right target, and the errors declared of ephemeris and attitude.
    """
    LARGE_RESIDUALS = enum.auto()
    """Residuals of stars, or of a triangulation, are several times the noise, or those of stars are radial.

    Look at the residuals: distortion or blur may be wrong. Fixes of bodies never have it: there such residuals inflate
    the sigma.
    """
    AMBIGUOUS = enum.auto()
    """Another source fits equally well in the search region, or the body at another position is not a thousand times
    less likely; of stars: many bright sources are not stars, and many bright stars have no source.

    Check which of them is the target, or narrow the search; of stars, look for a second exposure.
    """
    OBSERVER_UNKNOWN = enum.auto()
    """The velocity of the observer is unknown: the attitude contains stellar aberration, up to 20 arcsec at 1 au.

    The covariance includes it, as the part `aberration`. Give the position and velocity of the observer with respect to
    the solar system barycenter: kernels or tables relative to the target do not contain it.
    """
    EPOCH_UNKNOWN = enum.auto()
    """No epoch: stars were taken where the catalog has them, at J2016.0, with the error of that in the covariance.

    Give the epoch in the header or in the geometry table.
    """
    DISAGREEMENT = enum.auto()
    """Two independent estimators differ by more than their covariances explain.

    Nothing raises it any more: the sigmas grow until they explain the difference. It occurs in runs of earlier
    versions.
    """
    UNCHECKED = enum.auto()
    """No other estimator confirms the fix: none that is not suspect found the body with a sufficiently small sigma.

    It does not make the fix suspect. Look at the image before you rely on it.
    """
    UNCONFIRMED = enum.auto()
    """No estimator that is not suspect itself confirms the fix, where one should.

    Nothing raises it any more: such a fix is `unchecked`. It occurs in runs of earlier versions.
    """
    WRONG_LIGHT = enum.auto()
    """The image fits a Sun on another side of the body better, by odds of more than a thousand to one.

    Check `bottom_up`, the axes of the camera and the direction of the Sun.
    """
    UNEXPLAINED_LIGHT = enum.auto()
    """A second image of the body lies next to the first, or the body is darker than the sky, at a likelihood ratio
    above 1000.

    Another exposure, a ghost or a second body: look at the image, and mask all but the body.
    """
    WRONG_FIGURE = enum.auto()
    """The outline is that of another body, rows or columns are shifted against each other, or the limb is smooth where
    a height map has relief, at a likelihood ratio above 1000.

    Look at the image for shifted rows; check the shape, pole, rotation and epoch.
    """
    BLURRED = enum.auto()
    """The stars are wider along one direction than the camera's optics make them, or narrower in all, or odd rows are
    shifted against even ones.

    Check the motion during the exposure, the psf of the camera, and the order of the lines of an interlaced detector.
    No fix of a body has it: there a blur makes the sigma larger.
    """
    DEFOCUSED = enum.auto()
    """The stars are much wider than the camera's point spread function, in all directions: no focus, or a wrong psf.

    Their positions and the covariance are valid. Give the camera the width that its stars have before bodies are
    measured.
    """
    ODD_EPOCH = enum.auto()
    """The epoch is years away from those of the other images of the run: the clock of the header is probably wrong.

    Give the epoch in the geometry table, or reject the image. Places of bodies, and aberration, are those of that time.
    """
    WRONG_APRIORI = enum.auto()
    """The a priori attitude is wrong by more than `attitude_error_deg`; the stars were found without it.

    Of attitudes from stars, which do not suffer from it. The provenance names the rotation: correct the headers.
    """
    SUSPECT = (
        LOW_SCORE
        | MANY_REJECTED
        | FAR_FROM_PREDICTION
        | LARGE_RESIDUALS
        | AMBIGUOUS
        | DISAGREEMENT
        | UNCONFIRMED
        | WRONG_LIGHT
        | UNEXPLAINED_LIGHT
        | WRONG_FIGURE
        | BLURRED
        | ODD_EPOCH
    )

    @property
    def suspect(self) -> bool:
        """True if a flag of ``SUSPECT`` is set."""
        return bool(self & Quality.SUSPECT)

    def names(self) -> tuple[str, ...]:
        """Return the lower-case names of the flags that are set, in order of definition."""
        return tuple(str(flag.name).lower() for flag in Quality if flag in self and flag.value.bit_count() == 1)
