"""Limb matching: the full position of a body of any shape from its lit limb."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from giantlike.camera import Camera
from giantlike.core.arrays import require
from giantlike.core.outcomes import Failure, PositionFix, Reason
from giantlike.image import Image
from giantlike.processing.correlated_fit import correlated_solution
from giantlike.relative.estimator import EstimatorInputs, gather
from giantlike.relative.limb.fix import LimbSearch, SettledLimb, position_fix, settle_limb
from giantlike.relative.limb.observation import LimbScanOptions
from giantlike.scene import Scene

_LONGEST_WAVES, _LEAST_WAVES_PX = 1.0 / 3.0, 15.0
"""Correlation length of errors along the limb that residuals show, over the radius and at least; more is brightness."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LimbMatchingOptions:
    """How limbs are matched.

    Parameters
    ----------
    search_px : float, px
        Largest error of the predicted center, in both coordinates.
    search_range : float
        Largest relative error of the predicted range.
    max_iterations : int
        Times that the template is rendered and the limb measured.
    tolerance_px : float, px
        The fit has settled when the limb would move less than this in another iteration.
    outlier_mad : float
        Limb points beyond so many robust sigmas are left out.
    max_rms_px : float, px
        Larger residuals are a failure.
    large_rms_px : float, px
        Larger residuals get a flag.
    min_diameter_px : float, px
        Smaller bodies (by the predicted size of the sphere of the same volume) are a failure: a limb of a few dozen
        pixels tells the range to 0.2 % at best, and ``cross_correlation`` and ``unresolved``, which use all of the
        light, do better. Lower it to have such limbs nevertheless.
    scan : LimbScanOptions
    """

    search_px: float = 40.0
    search_range: float = 0.03
    max_iterations: int = 8
    tolerance_px: float = 0.01
    outlier_mad: float = 4.0
    max_rms_px: float = 5.0
    large_rms_px: float = 1.0
    min_diameter_px: float = 40.0
    scan: LimbScanOptions = field(default_factory=LimbScanOptions)

    def __post_init__(self) -> None:
        _ = self.search  # checks the values
        require(self.min_diameter_px >= 0.0, f"min_diameter_px must be >= 0, got {self.min_diameter_px}")

    @property
    def search(self) -> LimbSearch:
        """The part of the options that every estimator on limbs has."""
        return LimbSearch(
            search_px=self.search_px,
            search_range=self.search_range,
            max_iterations=self.max_iterations,
            tolerance_px=self.tolerance_px,
            outlier_mad=self.outlier_mad,
            max_rms_px=self.max_rms_px,
            large_rms_px=self.large_rms_px,
        )


class LimbMatching:
    """Full position of a body from its lit limb.

    The outline is found as a whole, then the body is rendered where it seems to be, the image compared with it line
    by line across the limb, and the position improved by least squares, until the limb stands still. The covariance
    comes from the residuals: their scatter, and how far along the limb they err together. What moves the whole limb
    in or out alike leaves no residuals and is not in it: a wrong reflectance law costs up to 0.2 px.

    ``score`` of the fix is the root mean square of the residuals in px; ``residuals`` are those across the limb, px,
    positive where the limb in the image lies outside that of the body.

    Parameters
    ----------
    options : LimbMatchingOptions

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Limb Matching".
    """

    name: ClassVar[str] = "limb_matching"

    def __init__(self, options: LimbMatchingOptions | None = None) -> None:
        self.options = options or LimbMatchingOptions()

    def estimate(self, image: Image, camera: Camera, scene: Scene, target: str | None = None) -> PositionFix | Failure:
        """Find a target of ``scene`` in ``image``.

        Parameters
        ----------
        image : Image
        camera : Camera
            Without a psf, its width is measured on the limb.
        scene : Scene
        target : str, optional
            May be left out when there is only one.

        Returns
        -------
        PositionFix or Failure
            ``NO_LIMB``, ``NOT_LIT``, ``OUT_OF_FRAME``, ``SATURATED``, ``NOT_CONVERGED``, ``LARGE_RESIDUALS`` or
            ``DEGENERATE_GEOMETRY``, and what ``gather`` fails for.

        Raises
        ------
        InputError
            The image has another size than the camera, or there is no such target.
        DataError
            SPICE kernels do not cover the epoch.
        """
        inputs = gather(image, camera, scene, target, estimator=self.name, options=self.options)
        if isinstance(inputs, Failure):
            return inputs
        diameter_px, least_px = 2.0 * inputs.radius_px, self.options.min_diameter_px
        if diameter_px < least_px:
            advice = "use cross_correlation or unresolved, or lower min_diameter_px"
            return inputs.fail(
                Reason.NO_LIMB, f"the body is {diameter_px:.1f} px across, min_diameter_px is {least_px:g}: {advice}"
            )
        limb = settle_limb(inputs, inputs.geometry.body(), search=self.options.search, scan=self.options.scan)
        if isinstance(limb, Failure):
            return limb
        return _fix(inputs, limb, self.options)


def _fix(inputs: EstimatorInputs, limb: SettledLimb, options: LimbMatchingOptions) -> PositionFix | Failure:
    """The last step of the iteration, with the covariance of the residuals."""
    observation, keep = limb.observation, limb.keep
    shift_px, design = observation.shift_px[keep], limb.design[keep]
    fit = correlated_solution(
        shift_px,
        design,
        observation.sigma_px[keep],
        observation.predicted_px[keep],
        min_length=options.scan.spacing_px,
        max_length=max(_LONGEST_WAVES * inputs.radius_px, _LEAST_WAVES_PX),
    )
    return position_fix(
        inputs,
        limb,
        position_camera_km=observation.position_camera_km + fit.solution,
        covariance_camera_km2=fit.covariance,
        residuals_px=shift_px - design @ fit.solution,
        search=options.search,
    )
