"""From an image to the horizon of an ellipsoid in it: found as a whole, then measured in cells until it stands still.

Shared by ``ellipsoid_cra`` and ``sigmoid_limb``, which turn what the cells say into a position each in its own way.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.processing.correlated_fit import robust_solution
from giantlike.processing.limb.search import search_limb
from giantlike.relative.estimator import EstimatorInputs, position_of_center
from giantlike.relative.horizon.cells import CellFits, LimbPixels, fit_cells, limb_pixels
from giantlike.relative.horizon.geometry import Figure
from giantlike.relative.horizon.profile import HorizonArc, blur_width_px, brightness_inside, horizon_arc, profile_table
from giantlike.relative.horizon.rings import Rings
from giantlike.relative.limb.fix import LimbSearch, SettledLimb
from giantlike.relative.limb.lines import LimbLines
from giantlike.relative.limb.observation import EdgeModel, LimbObservation

_LOG = logging.getLogger("giantlike.relative")

_COARSE_POINTS = 120
_MIN_BRIGHTNESS = 0.1  # of the brightest horizon: darker one tells little beside the rest
_LAW_POWERS, _STEP_POWERS = 2, 3
_LAW_SIGMA = 0.2
"""How much a smooth reflectance law may add to another at the square of the cosine of emission, over the first."""
_STEP_LAW_SIGMA = 2.0
_FIRST_BLUR_PX2 = 2.0
"""Variance added to the blur while the horizon is known to a pixel or two only: wider profiles catch from farther."""
_FIRST_CELLS = 24
_PATIENCE = 3  # iterations after which steps are halved: the cells used can alternate
_STIFF_STEPS, _STIFF = 2, 1e12  # while the horizon is off, that looks like more blur and another law
_UNKNOWN_PSF_SIGMA_PX2, _LEAST_PSF_PX2 = 2.0, 0.01
_SMALL_DISK_PX = 4.6
"""Its cube over that of the radius is what the profile leaves of the limb of small disks, px; measured from 20 px."""
_CELL_RADII = 0.25  # longest cell over the apparent radius
_MIN_FILLED = 0.6
_MIN_CONTRAST_SIGMAS = 5.0
_MAX_UNEXPLAINED, _MAX_UNEXPLAINED_FIRST = 0.12, 0.4
_GAIN_RANGE = (0.2, 5.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class HorizonScan:
    """How the horizon of an ellipsoid is measured.

    Parameters
    ----------
    edges : EdgeModel
        With ``TEMPLATE`` the brightness inside is that of the reflectance law times a line in the cosine of emission;
        with ``STEP`` a parabola in that cosine, whatever the law.
    window_px : float, px
        How far to both sides of the horizon pixels are used.
    cell_px : float, px
        Length of the cells along the horizon, each with its own brightness; on small disks they are shorter.
    min_cells : int
        Fewer good cells than this are no limb.
    min_contrast : float
        Mean of (inside - outside) / (inside + outside) across the limb below which no limb was located.
    psf_error : float
        Relative standard deviation of the width of the camera's point spread function.
    rings_km : (float, float), optional
        Inner and outer radius of rings in the equator of the body, whose pixels and shadow are left out.
    """

    edges: EdgeModel = EdgeModel.TEMPLATE
    window_px: float = 5.0
    cell_px: float = 7.0
    min_cells: int = 8
    min_contrast: float = 0.35
    psf_error: float = 0.05
    rings_km: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        known = [str(kind) for kind in EdgeModel]
        require(self.edges in known, f"edges must be one of {', '.join(known)}, got {self.edges!r}")
        object.__setattr__(self, "edges", EdgeModel(self.edges))
        for name in ("window_px", "cell_px"):
            value = getattr(self, name)
            require(math.isfinite(value) and 2.0 <= value <= 50.0, f"{name} must be in [2, 50], got {value}")
        require(self.min_cells >= 6, f"min_cells must be >= 6, got {self.min_cells}")
        require(0.0 < self.min_contrast < 1.0, f"min_contrast must be in (0, 1), got {self.min_contrast}")
        require(0.0 < self.psf_error <= 1.0, f"psf_error must be in (0, 1], got {self.psf_error}")
        if self.rings_km is not None:
            require(len(self.rings_km) == 2, f"rings_km must be an inner and an outer radius, got {self.rings_km}")
            object.__setattr__(self, "rings_km", tuple(float(radius) for radius in self.rings_km))
            Rings(*self.rings_km)  # checks the values

    @property
    def powers(self) -> int:
        """Powers of the cosine of emission that are free in every cell."""
        return _LAW_POWERS if self.edges is EdgeModel.TEMPLATE else _STEP_POWERS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HorizonView(Value):
    """What cells along a horizon show.

    Parameters
    ----------
    arc : HorizonArc
        The lit part of the horizon at ``position_camera_km``.
    pixels : LimbPixels
    fits : CellFits
    keep : (c,) bool
        Cells that agree with one position.
    rejected : dict of str to int
        Cells left out, by reason.
    position_camera_km : (3,) float64, km, camera axes
        Of the center of the ellipsoid, for which the profiles are.
    cut_by_frame : bool
        Part of the horizon, lit or not, lies outside the frame.
    prior : (2, 2) float64
        Information on blur and law before the measurement.
    prior_pull : (2,) float64
        That information times what is expected.
    """

    arc: HorizonArc
    pixels: LimbPixels
    fits: CellFits
    keep: Mask
    rejected: dict[str, int]
    position_camera_km: Float
    cut_by_frame: bool
    prior: Float
    prior_pull: Float

    @property
    def design(self) -> Float:
        """Outward motion (c, 3) of the horizon in the cells with the position, px/km."""
        return self.arc.design[self.pixels.middles]

    @property
    def points_px(self) -> Float:
        """Points of the predicted horizon (c, 2) in the middle of the cells."""
        return self.arc.points_px[self.pixels.middles]

    @property
    def normals_px(self) -> Float:
        """Outward normals (c, 2) there."""
        return self.arc.normals_px[self.pixels.middles]

    def shared(self) -> tuple[Float, Float]:
        """Blur and law error (2,) as the cells show them with every shift left free, and covariance (2, 2)."""
        information, pull = self.fits.about_shared(self.keep)
        covariance = np.asarray(np.linalg.inv(information / self.noise_scale2 + self.prior), dtype=np.float64)
        return covariance @ (pull / self.noise_scale2 + self.prior_pull), covariance

    @property
    def noise_scale2(self) -> float:
        """Variance that the profiles leave over that of pixel noise, at least 1."""
        return max(float(np.median(self.fits.chi2[self.keep])), 1.0) if self.keep.any() else 1.0


def settle_horizon(
    inputs: EstimatorInputs, figure: Figure, position_camera_km: Float, *, search: LimbSearch, scan: HorizonScan
) -> HorizonView | Failure:
    """Find the horizon of an ellipsoid as a whole, then measure it and move the body until it nearly stands still.

    What is left is for the solution that comes after: its profiles are linear in the shift to second order, so that a
    last step of s px leaves errors of s^2 over the width of the blur, about a pixel.

    Parameters
    ----------
    inputs : EstimatorInputs
    figure : Figure
    position_camera_km : (3,) float64, km, camera axes
        Of the ellipsoid's center, predicted.
    search : LimbSearch
    scan : HorizonScan

    Returns
    -------
    HorizonView or Failure
        ``NO_LIMB``, ``NOT_LIT``, ``OUT_OF_FRAME``, ``SATURATED``, ``NOT_CONVERGED`` or ``DEGENERATE_GEOMETRY``.
    """
    position = _located(inputs, figure, position_camera_km, search, scan)
    if isinstance(position, Failure):
        return position
    nominal_px2 = UNKNOWN_PSF_SIGMA_PX**2 if inputs.psf_sigma_px is None else inputs.psf_sigma_px**2
    variance_px2, moved_px = nominal_px2 + _FIRST_BLUR_PX2, math.inf
    for iteration in range(search.max_iterations):
        view = _observed(inputs, figure, position, variance_px2, nominal_px2, search, scan)
        if isinstance(view, Failure):
            return view
        known = inputs.psf_sigma_px is not None
        step, shared = _step(view, stiff=known and iteration < _STIFF_STEPS)
        moved_px = float(np.max(np.abs(view.design[view.keep] @ step)))
        _LOG.debug("%s: horizon moved by %.3g px in iteration %d", inputs.image.name, moved_px, iteration + 1)
        settled = moved_px**2 < search.tolerance_px or moved_px < _worst_sigma_px(view, step)
        if iteration > _PATIENCE:
            step, shared = 0.5 * step, 0.5 * shared
        if settled and iteration > 0 and (known or abs(shared[0]) < 0.5 * variance_px2):
            return view
        limit = 0.1 * float(np.linalg.norm(position))
        position = position + step * min(1.0, limit / max(float(np.linalg.norm(step)), 1e-300))
        variance_px2 = nominal_px2 if known or iteration == 0 else max(variance_px2 + shared[0], _LEAST_PSF_PX2)
        if not float(position @ figure.shape_matrix @ position) > 1.0:
            break
    return inputs.fail(
        Reason.NOT_CONVERGED,
        f"the horizon still moved by {moved_px:.2g} px after {iteration + 1} iterations, needed "
        f"{math.sqrt(search.tolerance_px):.2g} px",
    )


def settled_limb(inputs: EstimatorInputs, view: HorizonView, scan: HorizonScan) -> SettledLimb:
    """What a view is to the judgement that all estimators on limbs share."""
    fits, arc, pixels = view.fits, view.arc, view.pixels
    shared, _ = view.shared()
    shift = fits.raw_shift_px - fits.shared @ shared
    area = np.zeros(inputs.usable.shape, dtype=bool)
    area[pixels.rows[pixels.good], pixels.columns[pixels.good]] = True
    grown = inputs.saturated | inputs.masked
    if grown.any():
        area |= grown & _near(arc, scan.window_px, grown.shape)
    cells = len(pixels.middles)
    spacing = float(np.median(np.diff(arc.along_px[pixels.middles]))) if cells > 1 else scan.cell_px
    lawless = 0.0
    if scan.edges is EdgeModel.STEP:
        lawless = _STEP_LAW_SIGMA * float(np.median(np.abs(fits.shared[view.keep, 1])))
    profile_px = (_SMALL_DISK_PX / inputs.radius_px) ** 3
    observation = LimbObservation(
        predicted_px=view.points_px,
        limb_camera_km=arc.points_camera_km[pixels.middles],
        normals_px=view.normals_px,
        shift_px=shift,
        sigma_px=fits.sigma_px,
        brightness_error_px=math.hypot(lawless, profile_px),
        position_camera_km=view.position_camera_km,
        lines=LimbLines(
            angles_rad=np.arctan2(*(view.points_px - inputs.camera.model.project(view.position_camera_km)).T[::-1]),
            brightness=fits.gain_dn,
            spacing_px=spacing,
            perimeter_px=arc.perimeter_px,
            cut_by_frame=view.cut_by_frame,
        ),
        n_lines=cells,
        rejected=view.rejected,
        limb_share=min(float(view.keep.sum()) * spacing / arc.perimeter_px, 1.0),
        area=area,
    )
    return SettledLimb(observation=observation, design=view.design, keep=view.keep)


@dataclass(frozen=True, slots=True, eq=False)
class _LitHorizon(Value):
    """The part of a horizon that is lit and in the frame, and how bright it is inside."""

    arc: HorizonArc
    light: Float
    cut_by_frame: bool


def _located(
    inputs: EstimatorInputs, figure: Figure, position_km: Float, search: LimbSearch, scan: HorizonScan
) -> Float | Failure:
    """Position (3,) at which the contrast across the lit horizon is largest."""
    lit = _lit_arc(inputs, figure, position_km, search.search_px, scan)
    if isinstance(lit, Failure):
        return lit
    arc = lit.arc
    chosen = np.unique(np.linspace(0, len(arc.points_px) - 1, _COARSE_POINTS).round().astype(np.int64))
    model = inputs.camera.model
    center_px = model.project(position_km)
    noise_dn = float(np.sqrt(inputs.camera.detector.variance_dn2(np.zeros(1))[0]))
    coarse = search_limb(
        inputs.pixels_dn,
        inputs.usable,
        arc.points_px[chosen],
        arc.normals_px[chosen],
        lit.light[chosen],
        center_px,
        search_px=search.search_px,
        search_scale=search.search_range,
        noise_dn=noise_dn,
    )
    if coarse.contrast < scan.min_contrast:
        return inputs.fail(
            Reason.NO_LIMB,
            f"no limb within {search.search_px:g} px of the predicted one: the best contrast across {chosen.size} lit "
            f"points of the horizon is {coarse.contrast:.2f}, needed {scan.min_contrast:g}; noise in the dark is "
            f"{noise_dn:.3g} DN",
        )
    range_km = float(np.linalg.norm(position_km)) / coarse.scale
    position, _ = position_of_center(model, center_px + coarse.shift_px, range_km, np.zeros((3, 3)))
    if not np.isfinite(position).all():
        return inputs.fail(Reason.OUT_OF_FRAME, "the limb was found where the camera model images nothing")
    return position


def _lit_arc(
    inputs: EstimatorInputs, figure: Figure, position_km: Float, reach_px: float, scan: HorizonScan
) -> _LitHorizon | Failure:
    """The part of the horizon that is lit and in the frame (or not farther outside than ``reach_px``)."""
    whole = horizon_arc(inputs.camera.model, figure, position_km)
    if isinstance(whole, Failure):
        return inputs.fail(whole.reason, whole.detail)
    inside = inputs.camera.contains(whole.points_px, margin_px=reach_px)
    if not inside.any():
        size = np.ptp(whole.points_px, axis=0)
        return inputs.fail(
            Reason.NO_LIMB,
            f"none of the predicted outline ({size[0]:.0f} x {size[1]:.0f} px) lies in the frame of "
            f"{inputs.camera.columns} x {inputs.camera.rows}: the surface fills the frame or lies beside it",
        )
    sun, law = inputs.geometry.sun_direction_camera, inputs.geometry.target.reflectance
    light = brightness_inside(whole, figure, position_km, sun_direction_camera=sun, law=law)
    chosen = inside & (light > _MIN_BRIGHTNESS * light.max())
    if not chosen.any():
        phase_deg = math.degrees(inputs.geometry.phase_angle_rad)
        return inputs.fail(
            Reason.NOT_LIT,
            f"{inside.mean():.0%} of the predicted outline lie in the frame, but the body is dark there (phase angle "
            f"{phase_deg:.0f} deg)",
        )
    if scan.rings_km is not None:
        chosen &= ~Rings(*scan.rings_km).hide(
            whole.points_camera_km, position_km, figure.camera_from_axes, sun_direction_camera=sun
        )
        if not chosen.any():
            return inputs.fail(Reason.NO_LIMB, "rings or their shadow cover all of the lit limb in the frame")
    return _LitHorizon(
        arc=whole.only(chosen),
        light=light[chosen],
        cut_by_frame=not (whole.complete and bool(inputs.camera.contains(whole.points_px).all())),
    )


def _observed(
    inputs: EstimatorInputs,
    figure: Figure,
    position_km: Float,
    psf_px2: float,
    nominal_px2: float,
    search: LimbSearch,
    scan: HorizonScan,
) -> HorizonView | Failure:
    """Measure the horizon in cells about a position that is good to a pixel or two."""
    lit = _lit_arc(inputs, figure, position_km, 0.0, scan)
    if isinstance(lit, Failure):
        return lit
    cell_px = max(min(scan.cell_px, _CELL_RADII * inputs.radius_px), 3.0)
    first = psf_px2 >= nominal_px2 + _FIRST_BLUR_PX2  # few cells and a stiff profile, until the horizon is known better
    arc = lit.arc
    if first:
        arc = arc.thinned(cell_px, math.ceil(len(arc.points_px) * arc.spacing_px / cell_px / _FIRST_CELLS))
    table = profile_table(
        arc,
        figure,
        position_km,
        sun_direction_camera=inputs.geometry.sun_direction_camera,
        law=inputs.geometry.target.reflectance if scan.edges is EdgeModel.TEMPLATE else None,
        width_px=blur_width_px(psf_px2),
        window_px=scan.window_px,
        powers=2 if first else scan.powers + 1,
    )
    pixels = limb_pixels(
        arc,
        inputs.camera.model,
        figure,
        position_km,
        _clear(inputs, figure, position_km, scan),
        window_px=scan.window_px,
        cell_px=cell_px,
    )
    if pixels is None:
        return _too_few(inputs, arc, scan, 0, 0, {})
    fits = fit_cells(pixels, inputs.pixels_dn, table, inputs.camera.detector.variance_dn2)
    keep, rejected = _judged(pixels, fits, _MAX_UNEXPLAINED_FIRST if first else _MAX_UNEXPLAINED)
    if keep.sum() >= scan.min_cells:
        shift, design = fits.raw_shift_px[keep], arc.design[pixels.middles][keep]
        _, agrees = robust_solution(shift, design, fits.sigma_px[keep], outlier_mad=search.outlier_mad)
        rejected["off the horizon of the rest"] = int((~agrees).sum())
        keep[keep] = agrees
    if keep.sum() < scan.min_cells:
        return _too_few(inputs, arc, scan, int(keep.sum()), keep.size, rejected)
    prior, prior_pull = _prior(inputs, psf_px2, nominal_px2, scan)
    return HorizonView(
        arc=arc,
        pixels=pixels,
        fits=fits,
        keep=keep,
        rejected=rejected,
        position_camera_km=position_km,
        cut_by_frame=lit.cut_by_frame,
        prior=prior,
        prior_pull=prior_pull,
    )


def _prior(inputs: EstimatorInputs, psf_px2: float, nominal_px2: float, scan: HorizonScan) -> tuple[Float, Float]:
    """What is known of blur and law before the measurement: information (2, 2), and that times expectation (2,)."""
    sigma_px2 = _UNKNOWN_PSF_SIGMA_PX2
    if inputs.psf_sigma_px is not None:
        sigma_px2 = 2.0 * scan.psf_error * max(nominal_px2, 0.1)
    law_sigma = _LAW_SIGMA if scan.edges is EdgeModel.TEMPLATE else _STEP_LAW_SIGMA
    prior = np.diag([sigma_px2**-2, law_sigma**-2])
    return prior, prior @ [nominal_px2 - psf_px2, 0.0]


def _judged(pixels: LimbPixels, fits: CellFits, max_unexplained: float) -> tuple[Mask, dict[str, int]]:
    """Which cells are good, and how many are not for which reason (the first that applies)."""
    complete = (pixels.filled > _MIN_FILLED) & np.isfinite(fits.chi2)
    sound = complete & (fits.gain_dn > 0.0) & (fits.unexplained < max_unexplained)
    low, high = np.array(_GAIN_RANGE) * (float(np.median(fits.gain_dn[sound])) if sound.any() else 1.0)
    checks = (
        ("masked, saturated or outside the frame", complete),
        ("too weak", fits.contrast > _MIN_CONTRAST_SIGMAS),
        ("not like the expected profile", fits.unexplained < max_unexplained),
        ("too bright or too dark", (fits.gain_dn > low) & (fits.gain_dn < high)),
    )
    keep = np.ones(complete.shape, dtype=bool)
    rejected = {}
    for name, passed in checks:
        rejected[name] = int((keep & ~passed).sum())
        keep &= passed
    return keep, rejected


def _step(view: HorizonView, *, stiff: bool) -> tuple[Float, Float]:
    """Step (3,) of the position, km, and of blur and law (2,), by all cells together; these two stay if ``stiff``."""
    design = np.concatenate([view.design, view.fits.shared], axis=1)[view.keep] / view.fits.sigma_px[view.keep, None]
    information, pull = view.fits.about_shared(view.keep)
    normal = design.T @ design
    normal[3:, 3:] += information + view.prior * view.noise_scale2 + (_STIFF if stiff else 0.0) * np.eye(2)
    right = design.T @ (view.fits.raw_shift_px / view.fits.sigma_px)[view.keep]
    right[3:] += pull + view.prior_pull * view.noise_scale2
    scale = np.sqrt(np.diagonal(normal))
    solution = np.linalg.solve(normal / np.outer(scale, scale), right / scale) / scale
    return solution[:3], solution[3:]


def _worst_sigma_px(view: HorizonView, step_km: Float) -> float:
    """How uncertain the horizon is where it is fixed worst, px, by the scatter of the cells alone."""
    design = view.design[view.keep]
    left = view.fits.raw_shift_px[view.keep] - design @ step_km
    leverage = np.linalg.qr(design)[0]
    return float(np.std(left) * np.max(np.linalg.norm(leverage, axis=1)))


def _clear(inputs: EstimatorInputs, figure: Figure, position_km: Float, scan: HorizonScan) -> Mask:
    """Usable pixels (rows, columns) that no rings cover."""
    if scan.rings_km is None:
        return inputs.usable
    covered = Rings(*scan.rings_km).cover(
        inputs.camera, position_km, figure.camera_from_axes, widened_px=2.0 * UNKNOWN_PSF_SIGMA_PX
    )
    return inputs.usable & ~covered


def _near(arc: HorizonArc, window_px: float, shape: tuple[int, ...]) -> Mask:
    """Pixels (rows, columns) within ``window_px`` of the horizon."""
    area = np.zeros(shape, dtype=bool)
    across = np.arange(-window_px, window_px + 0.5, 0.5)
    places = arc.points_px[:, None] + across[:, None] * arc.normals_px[:, None]
    index = np.rint(places).astype(np.int64).reshape(-1, 2)
    inside = np.all((index >= 0) & (index < [shape[1], shape[0]]), axis=1)
    area[index[inside, 1], index[inside, 0]] = True
    return area


def _too_few(
    inputs: EstimatorInputs, arc: HorizonArc, scan: HorizonScan, kept: int, total: int, rejected: dict[str, int]
) -> Failure:
    area = _near(arc, scan.window_px, inputs.usable.shape)
    saturated = float(inputs.saturated[area].mean()) if area.any() else 0.0
    reasons = ", ".join(f"{count} {name}" for name, count in rejected.items() if count)
    return inputs.fail(
        Reason.SATURATED if saturated > 0.2 else Reason.NO_LIMB,
        f"{kept} of {total} cells along the lit limb in the frame are good, needed {scan.min_cells}"
        + (f"; {reasons}" if reasons else ""),
    )
