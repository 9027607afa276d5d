"""Sigmoid limb: position of an ellipsoid by fitting its blurred horizon to all pixels along the lit limb at once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from giantlike.camera import Camera
from giantlike.core.outcomes import Failure, PositionFix, Reason
from giantlike.image import Image
from giantlike.relative.estimator import gather
from giantlike.relative.horizon.fit import fit_horizon
from giantlike.relative.horizon.geometry import Altitude, Figure
from giantlike.relative.horizon.scan import HorizonScan, settle_horizon, settled_limb
from giantlike.relative.limb.fix import LimbSearch, position_fix
from giantlike.scene import Scene
from giantlike.shapes import Ellipsoid

_CELL_PX = 14.0
"""Brightness changes smoothly along a limb: long cells, each with its growth along it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SigmoidLimbOptions:
    """How the sigmoid is fitted.

    Parameters
    ----------
    search_px : float, px
        Largest error of the predicted center, in both coordinates.
    search_range : float
        Largest relative error of the predicted range.
    max_iterations : int
        Times that the horizon is laid anew and fitted.
    tolerance_px : float, px
        The fit has settled when the horizon would move less than this in another iteration.
    outlier_mad : float
        Cells beyond so many robust sigmas are left out.
    max_rms_px : float, px
        Larger residuals are a failure.
    large_rms_px : float, px
        Larger residuals get a flag.
    limb_altitude_km : float, km
        What is seen as the limb stands so high above the shape: haze, an atmosphere.
    altitude_sigma_km : float, km
        Standard deviation of that; where it is not zero the altitude is estimated with the position.
    scan : HorizonScan
    """

    search_px: float = 40.0
    search_range: float = 0.03
    max_iterations: int = 15
    tolerance_px: float = 0.005
    outlier_mad: float = 5.0
    max_rms_px: float = 3.0
    large_rms_px: float = 0.5
    limb_altitude_km: float = 0.0
    altitude_sigma_km: float = 0.0
    scan: HorizonScan = field(default_factory=lambda: HorizonScan(cell_px=_CELL_PX))

    def __post_init__(self) -> None:
        self.search()  # checks the values
        self.altitude()

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

    def altitude(self) -> Altitude:
        """What is known of the altitude of the limb."""
        return Altitude(self.limb_altitude_km, self.altitude_sigma_km)


class SigmoidLimb:
    """Full position of an ellipsoid by an iterative least-squares fit of its ellipsoidal sigmoid to the image.

    Where the Christian-Robinson algorithm first finds points on the horizon and then an ellipsoid through them, here
    the position moves one blurred horizon over all pixels near the lit limb. The brightness inside is free in short
    cells along the limb (gain, growth along and inward), background too; the width of the blur and a smooth error of
    the reflectance law are common to all cells and known a priori to what the options say. The start is the contrast
    of the whole outline.

    ``score`` of the fix is the root mean square of the residuals in px: what each cell alone would move the horizon,
    positive outward.

    Parameters
    ----------
    options : SigmoidLimbOptions

    References
    ----------
    .. [1] Inman et al., Artemis I optical navigation system performance, section III.B: the fit "minimizing the
       residual between the image gradient around the lit limb with that of an ellipsoidal sigmoid function", iterated
       until the update falls below a threshold. Its source (Mortari, D'Souza and Zanetti 2016) was not at hand; here
       the brightness itself is fitted rather than its gradient, which is the same model with independent noise.
    """

    name: ClassVar[str] = "sigmoid_limb"

    def __init__(self, options: SigmoidLimbOptions | None = None) -> None:
        self.options = options or SigmoidLimbOptions()

    def estimate(self, image: Image, camera: Camera, scene: Scene, target: str | None = None) -> PositionFix | Failure:
        """Find a target of ``scene`` in ``image``.

        Parameters
        ----------
        image : Image
        camera : Camera
            Without a psf, its width is estimated with the position.
        scene : Scene
        target : str, optional
            May be left out when there is only one.

        Returns
        -------
        PositionFix or Failure
            ``WRONG_SHAPE`` for a body that is no ellipsoid; ``NO_LIMB``, ``NOT_LIT``, ``OUT_OF_FRAME``, ``SATURATED``,
            ``NOT_CONVERGED``, ``LARGE_RESIDUALS`` or ``DEGENERATE_GEOMETRY``, and what ``gather`` fails for.

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
        shape = inputs.geometry.target.shape
        if not isinstance(shape, Ellipsoid):
            return inputs.fail(
                Reason.WRONG_SHAPE,
                f"the fit needs an ellipsoid, got a {type(shape).__name__}: use ellipsoid_cra or limb_matching",
            )
        search, scan, altitude = self.options.search(), self.options.scan, self.options.altitude()
        geometry = inputs.geometry
        figure = altitude.above(Figure(radii_km=shape.radii_km, camera_from_axes=geometry.camera_from_body))
        view = settle_horizon(inputs, figure, geometry.position_camera_km, search=search, scan=scan)
        if isinstance(view, Failure):
            return view
        fitted = fit_horizon(view, camera.model, figure, view.position_camera_km, altitude)
        fix = position_fix(
            inputs,
            settled_limb(inputs, view, scan),
            position_camera_km=fitted.position_camera_km,
            covariance_camera_km2=fitted.covariance_camera_km2,
            residuals_px=fitted.residuals_px,
            search=search,
        )
        return fitted.told(fix) if isinstance(fix, PositionFix) else fix
