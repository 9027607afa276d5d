"""Measure the lit limb of an ellipsoid: cells along its horizon, fitted with the profile that it has in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.causes import Cause
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value, select_rows
from giantlike.image_model.columns import Layout, Prior, when_seen
from giantlike.image_model.optics import ovality
from giantlike.processing.limb.measurement import (
    MIN_BRIGHTNESS,
    LimbMeasurement,
    SmoothError,
    no_lit_limb,
    pixels_near,
    too_few,
)
from giantlike.processing.limb.scan import PIXEL_VARIANCE_PX2
from giantlike.processing.limb.search import find_limb
from giantlike.processing.limb.view import LimbView, PredictedLimb
from giantlike.ray_tracing import Lambert, LommelSeeliger, Minnaert, Reflectance
from giantlike.ray_tracing.air import Black
from giantlike.relative.horizon.cells import CellFits
from giantlike.relative.horizon.clipped_disk import measure_clipped
from giantlike.relative.horizon.geometry import Figure
from giantlike.relative.horizon.good_cells import CellRules, NoCells, good_cells
from giantlike.relative.horizon.options import HorizonScan
from giantlike.relative.horizon.profile import HorizonArc, blur_width_px, brightness_inside, horizon_arc, profile_table
from giantlike.relative.judge import LEAST_USED_SHARE
from giantlike.relative.limb.fix import (
    PATIENCE,
    EdgeModel,
    IteratedSearch,
    LimbState,
    LimbStep,
    agreeing_step,
    settle_limb,
)
from giantlike.rings import Rings

_COARSE_POINTS = 120  # points for the search of the horizon as a whole
OTHER_LAWS = (Lambert(), LommelSeeliger(), Minnaert(k=0.5), Minnaert(k=0.75))
"""Laws mixed into the assumed one; their fractions are estimated with the position.

Lambert and Lommel-Seeliger are the limits of bright and of dark surfaces, and McEwen's and the lunar law mixtures of
them; Minnaert's exponent is 0.5 for a flat disk at full phase and 1 for Lambert, and two of them between span the rest.
Laws outside of this span (Hapke's with slopes of 20 degrees, Akimov's) have squared errors of 0.8-1.4 per degree of
freedom at 15 to 125 degrees of phase; 4 to 28 with one exponent of 0.7.
"""
_OTHER_LAW_SIGMA = 1.0
"""A priori standard deviation of the fraction of another law; at 1 the surface has that law altogether."""
_WING_RATIOS = (2.0, 6.0)
"""Widths of the wings of a point spread function relative to its core; two span the widths between."""
_WING_SIGMA = 0.1
"""Standard deviation of the fraction of light in each of the wings; a negative fraction sharpens the core."""
_LAW_SIGMA = 0.2
"""Standard deviation of the quadratic term in the cosine of emission by which laws differ, relative to the first."""
_STEP_LAW_SIGMA = 2.0  # as above, for the cubic term, where no law is used
_FIRST_BLUR_PX2 = 1.0
"""Variance added to the blur while the horizon is known to a pixel or two only: it widens the range of convergence."""
_FIRST_CELLS = 24  # cells of the first measurement, which is only a start for the next
_WIDE = 2.0  # times the width of an unknown point spread function, from which a free width is estimated
_STIFF_STEPS, _STIFF = 2, 1e12  # while the horizon is off, that looks like more blur and another law
_BLUR_REST, _BLUR_REST_LATER = 0.1, 0.5
"""Relative step of the variance of the blur at which it has converged: linear to 1 % of the width of a profile. Later
half, because the blur of limbs in haze does not converge."""
_UNKNOWN_PSF_SIGMA_PX2 = 2.0
"""Standard deviation, px^2, of the variance of an unknown point spread function: widths up to 2 px are usual."""
_LEAST_VARIANCE_PX2 = 0.1
"""Minimum variance of the point spread function, px^2, to which ``psf_error`` is applied: about that of a pixel."""
_SMALL_DISK_PX = 1.8
"""The error of the profile on small disks, px, is the square of this divided by that of the radius.

Centers of bodies of 60,000 DN with little noise (8 views of 4 phases and 3 laws each) had errors of 0.03, 0.016 and
0.007 px per axis at 20, 30 and 50 px.
"""
_UNEVEN, _UNEVEN_RADIUS_PX = 1.0, 25.0
"""Ratio of brightness to its change along a cell below which the cell is left out; smaller on disks below that radius.

The radius is in px. Profiles assume a uniform limb along a cell, which fails where the terminator meets the limb: the
fraction of a law was then in error by 4 standard deviations, and a limb of 50 px by 0.04 px. Lommel-Seeliger bodies of
60,000 DN and 100 px at 100 degrees of phase have squared errors of 37, 21 and 11 per degree of freedom with 0, 0.5 and
1, and of 4.4 with 1 and the present points of `horizon_arc`. On disks of 30 px, two of eight crescents have too few
cells left with 1.
"""
_CELL_RADII, _LEAST_CELL_PX = 0.25, 3.0
"""Maximum length of a cell relative to the apparent radius, as cells are treated as straight; and minimum length,
px."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CellMeasurement(LimbMeasurement):
    """Limb measured in cells, blur and law still to be solved for."""

    fits: CellFits  # of the good cells
    shared: Layout  # of the shared errors: blur, law, other laws, wings, and ovality of the point spread function
    prior: Prior  # of the shared errors
    whole: bool  # all of the arc was measured, not only a few cells of it

    @property
    def noise_scale2(self) -> float:
        """Ratio of the variance of the residuals to the pixel noise, at least 1."""
        return max(float(np.median(self.fits.chi2[self.keep])), 1.0) if self.keep.any() else 1.0

    def about_shared(self) -> tuple[Float, Float]:
        """Add the prior information on the shared errors and that of the kept cells, every shift left free.

        Returns ``information`` (s, s) and ``pull`` (s,).
        """
        information, pull = self.fits.about_shared(self.keep)
        scale2 = self.noise_scale2
        prior = self.prior
        return information / scale2 + np.diag(prior.information), pull / scale2 + prior.information * prior.mean

    def blur_and_law(self) -> tuple[Float, Float]:
        """Estimate the shared errors with every shift left free.

        Returns ``estimate`` (s,) and ``covariance`` (s, s).
        """
        information, pull = self.about_shared()
        scale = np.sqrt(np.diagonal(information))
        covariance = np.asarray(np.linalg.inv(information / np.outer(scale, scale)), dtype=np.float64)
        covariance /= np.outer(scale, scale)
        return when_seen(covariance @ pull, covariance, self.shared.span("ovality"), self.prior)


def measure_by_cells(
    view: LimbView,
    figure: Figure,
    law: Reflectance,
    position_camera_km: Float,
    search: IteratedSearch,
    options: HorizonScan,
) -> LimbMeasurement | Failure:
    """Find the horizon of an ellipsoid and measure it in cells until it nearly converges.

    Where the disk is clipped along half of the limb or more, lines across it replace the cells.

    The last step is left to the solution that follows: profiles are linear in the shift to second order, so that a step
    of s px leaves errors of s^2 divided by the width of the blur, about a pixel.
    """
    scan = CellScan(view=view, figure=figure, law=law, search=search, options=options)
    lit = scan.find_lit_arc(position_camera_km, reach_px=search.search_px)
    if isinstance(lit, Failure):
        return lit
    arc, light, _ = lit
    some = np.unique(np.linspace(0, light.size - 1, _COARSE_POINTS).round().astype(np.int64))
    limb = PredictedLimb(
        points_px=arc.points_px[some],
        points_camera_km=arc.points_camera_km[some],
        normals_px=arc.normals_px[some],
        brightness=light[some],
    )
    found = find_limb(
        view,
        limb,
        position_camera_km,
        search_px=search.search_px,
        search_range=search.search_range,
        min_contrast=options.min_contrast,
    )
    if isinstance(found, Failure):
        return found
    closest_km = float(figure.radii_km.max())
    settled: LimbMeasurement | Failure = Failure(Reason.NOT_CONVERGED, "")
    for tried, psf_px2 in scan.in_turn():
        start = LimbState(position_camera_km=found[0], psf_px2=psf_px2)
        settled = settle_limb(tried, start, search, min_points=options.min_cells, closest_km=closest_km)
        if not isinstance(settled, Failure) or settled.reason is not Reason.NOT_CONVERGED:
            break
    if view.clipped_pixels.any() and _mostly_lost(settled):
        by_lines = measure_clipped(view, figure, law, found[0], search, options)
        return settled if isinstance(by_lines, Failure) else by_lines
    return settled


def _mostly_lost(settled: LimbMeasurement | Failure) -> bool:
    """True if the limb could not be measured, or less than half of its lit part."""
    return isinstance(settled, Failure) or settled.n_used < LEAST_USED_SHARE * settled.n_offered


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CellScan(Value):
    """Measures a horizon in cells: a :class:`~giantlike.relative.limb.fix.LimbScan`.

    held: hold blur, law and wings until the limb has converged: a short arc does not separate them from the position
        well enough to converge with them free. They are estimated once at the end, and are in the covariance.
    """

    view: LimbView
    figure: Figure
    law: Reflectance
    search: IteratedSearch
    options: HorizonScan
    held: bool = False

    def in_turn(self) -> tuple[tuple[CellScan, float], ...]:
        """Scans to try, each for a limb on which the one before does not converge, and their starting variances.

        An image that is blurred more than declared converges slowly from the declared width. The width is then
        estimated freely from above, since a profile that is too sharp underestimates the missing blur.
        """
        free = replace(self, view=replace(self.view, plane=replace(self.view.plane, psf=None)))
        nominal_px2 = self.nominal_psf_px2
        return (self, nominal_px2), (replace(self, held=True), nominal_px2), (free, _WIDE**2 * free.nominal_psf_px2)

    @property
    def nominal_psf_px2(self) -> float:
        """A priori variance of the point spread function, px^2."""
        sigma_px = self.view.psf_sigma_px
        return (UNKNOWN_PSF_SIGMA_PX if sigma_px is None else sigma_px) ** 2

    @property
    def other_laws(self) -> tuple[Reflectance, ...]:
        """Laws that the surface may have instead; under air, also black ground."""
        return OTHER_LAWS if self.figure.air is None else (*OTHER_LAWS, Black())

    @property
    def cell_px(self) -> float:
        """Length of the cells, px."""
        return max(min(self.options.cell_px, _CELL_RADII * self.view.radius_px), _LEAST_CELL_PX)

    def find_lit_arc(self, position_km: Float, *, reach_px: float) -> tuple[HorizonArc, Float, bool] | Failure:
        """Part of the horizon that is lit and in the frame, or not farther outside than ``reach_px``.

        ``position_km`` in camera axes; returns ``arc``, ``light`` (k,) and ``cut_by_frame``.
        """
        view, sun = self.view, self.view.sun_direction_camera
        whole = horizon_arc(view.model, self.figure, position_km)
        if isinstance(whole, Failure):
            return whole
        inside = view.contains(whole.points_px, margin_px=-reach_px)
        light = brightness_inside(whole, sun, self.law)
        change = self.cell_px * np.abs(np.gradient(light)) / whole.spacing_px  # along a cell
        uneven = _UNEVEN * min(1.0, view.radius_px / _UNEVEN_RADIUS_PX)
        chosen = inside & (light > np.maximum(MIN_BRIGHTNESS * light.max(), uneven * change))
        if not chosen.any():
            return no_lit_limb(view, whole.points_px, inside, position_km)
        if self.options.rings_km is not None:
            chosen &= ~Rings(*self.options.rings_km).hide(
                whole.points_camera_km, position_km, self.figure.camera_from_axes, sun_direction_camera=sun
            )
            if not chosen.any():
                return Failure(Reason.NO_LIMB, "rings or their shadow cover all of the lit limb in the frame")
        cut_by_frame = not (whole.complete and bool(view.contains(whole.points_px).all()))
        return select_rows(whole, chosen), light[chosen], cut_by_frame

    def measure(self, state: LimbState) -> CellMeasurement | Failure:
        """Measure the horizon at a position; at first in few cells, with more blur and a stiff profile."""
        lit = self.find_lit_arc(state.position_camera_km, reach_px=0.0)
        if isinstance(lit, Failure):
            return lit
        arc, _, cut_by_frame = lit
        every = math.ceil(len(arc.points_px) * arc.spacing_px / self.cell_px / _FIRST_CELLS)
        if every > 1 and state.iteration == 0:
            few = arc.thin(self.cell_px, every)
            return self._measure_arc(few, state, cut_by_frame=cut_by_frame, whole=False)
        return self._measure_arc(arc, state, cut_by_frame=cut_by_frame, whole=True)

    def _measure_arc(
        self, arc: HorizonArc, state: LimbState, *, cut_by_frame: bool, whole: bool
    ) -> CellMeasurement | Failure:
        """Measure the cells of an arc."""
        view, options = self.view, self.options
        position, first = state.position_camera_km, state.iteration == 0
        psf_px2 = state.psf_px2 + (_FIRST_BLUR_PX2 if first else 0.0)
        table = profile_table(
            arc,
            view.sun_direction_camera,
            self.law if options.edges is EdgeModel.TEMPLATE else None,
            width_px=blur_width_px(psf_px2),
            window_px=options.window_px,
            powers=2 if first else options.powers + 1,
            others=() if first else self.other_laws,
            wings_px=() if first else tuple(blur_width_px(ratio**2 * psf_px2) for ratio in _WING_RATIOS),
        )
        across = np.arange(-options.window_px, options.window_px + 0.5, 0.5)
        area = pixels_near(arc.points_px, arc.normals_px, across, view.usable.shape)
        rules = CellRules(
            window_px=options.window_px,
            cell_px=self.cell_px,
            min_cells=options.min_cells,
            outlier_mad=self.search.outlier_mad,
            first=first,
        )
        cells = good_cells(view, arc, table, self._clear(position), rules)
        if isinstance(cells, NoCells):
            return too_few(view, area, cells.good, cells.rejected, needed=options.min_cells)
        shared, sigmas = self._list_shared_unknowns(first)
        oval = shared.vector({"ovality": 1.0}).any()
        fits = cells.fits if not oval else cells.fits.with_ovality(ovality(arc.normals_px[cells.middles]))
        mean = shared.vector({"blur": self.nominal_psf_px2 - psf_px2})
        return CellMeasurement(
            predicted_px=arc.points_px[cells.middles],
            normals_px=arc.normals_px[cells.middles],
            design=arc.design[cells.middles],
            shift_px=cells.shift_px,
            sigma_px=fits.sigma_px,
            keep=np.ones(cells.middles.size, dtype=bool),
            common_px={},
            smooth_errors=(),
            position_camera_km=position,
            spacing_px=cells.spacing_px,
            perimeter_px=arc.perimeter_px,
            cut_by_frame=cut_by_frame,
            rejected=cells.rejected,
            area=area,
            fits=fits,
            shared=shared,
            prior=Prior.of_sigmas(sigmas, mean),
            whole=whole,
            unmeasured_px=arc.points_px[cells.others],
        )

    def step(self, measured: CellMeasurement, state: LimbState) -> LimbStep:
        """Step of position and blur from all cells; blur and law are held at first where they are known."""
        keep = agreeing_step(measured, self.search.outlier_mad).keep
        measured = replace(measured, keep=keep)
        known = self.view.psf_sigma_px is not None
        stiff = _STIFF if self.held or (known and state.iteration < _STIFF_STEPS) else 0.0
        sigma = measured.sigma_px[keep] * math.sqrt(measured.noise_scale2)
        design = np.concatenate([measured.design, measured.fits.shared_shifts], axis=1)[keep] / sigma[:, None]
        information, pull = measured.about_shared()
        layout = Layout((("position", Cause.NOISE, 3), *measured.shared.effects))
        shared, normal = layout.span("blur", "ovality"), design.T @ design
        normal[shared, shared] += information + stiff * np.eye(len(information))
        right = design.T @ (measured.shift_px[keep] / sigma)
        right[shared] += pull + stiff * measured.prior.mean
        scale = np.sqrt(np.diagonal(normal))
        solution = np.linalg.solve(normal / np.outer(scale, scale), right / scale) / scale
        (blur_px2,) = solution[layout.span("blur")].tolist()
        psf_px2 = 0.0 if state.iteration == 0 or stiff else blur_px2
        return LimbStep(position_km=solution[layout.span("position")], keep=keep, psf_px2=psf_px2)

    def has_converged(self, measured: CellMeasurement, step: LimbStep, moved_px: float, state: LimbState) -> bool:
        """Return True if the square of the step is small, or noise explains it, and the blur has converged too."""
        kept = replace(measured, keep=step.keep)
        blurred_px2 = step.psf_px2 or float(kept.blur_and_law()[0][kept.shared.span("blur")][0])
        linear = _BLUR_REST if state.iteration <= PATIENCE else _BLUR_REST_LATER
        blurred = not self.held and abs(blurred_px2) > linear * (state.psf_px2 + PIXEL_VARIANCE_PX2)
        if state.iteration == 0 or blurred or not measured.whole:
            return False
        full_px = float(np.max(np.abs(kept.design[step.keep] @ step.position_km)))
        return full_px**2 < self.search.tolerance_px or full_px < kept.motion_sigma_px(step.position_km)

    def finish(self, measured: CellMeasurement, step: LimbStep) -> CellMeasurement:
        """Return the shifts with blur and law as estimated from the cells, and the effect of their errors on them."""
        kept = replace(measured, keep=step.keep)
        estimate, covariance = kept.blur_and_law()
        layout, shared_px = kept.shared, kept.fits.shared_shifts @ np.linalg.cholesky(covariance)
        (wider_px2,) = (estimate - kept.prior.mean)[layout.span("blur")].tolist()
        radius_px = self.view.radius_px
        lawless = 0.0
        if self.options.edges is EdgeModel.STEP:
            lawless = _STEP_LAW_SIGMA * float(np.median(np.abs(kept.fits.shared_shifts[kept.keep, layout.span("law")])))
        brightness_px = math.hypot(lawless, (_SMALL_DISK_PX / radius_px) ** 2)
        known = self.view.psf_sigma_px is not None
        return replace(
            kept,
            wider_px2=wider_px2 if known else None,
            shift_px=kept.shift_px - kept.fits.shared_shifts @ estimate,
            common_px={cause: shared_px[:, layout.of_cause(cause)] for cause in (Cause.PSF, Cause.REFLECTANCE)},
            smooth_errors=(SmoothError(cause=Cause.REFLECTANCE, sigma_px=brightness_px, length_px=radius_px),),
        )

    def _list_shared_unknowns(self, first: bool) -> tuple[Layout, Float]:
        """Blur, the power of the law, other laws, wings and ovality, with their a priori standard deviations.

        Ovality of declared optics only, as of unknown ones the blur itself is a rough estimate, and not in air, which
        blurs the limb more in some directions than in others.
        """
        sigma_px2 = _UNKNOWN_PSF_SIGMA_PX2
        known = self.view.psf_sigma_px is not None
        if known:
            sigma_px2 = 2.0 * self.options.psf_error * max(self.nominal_psf_px2, _LEAST_VARIANCE_PX2)
        layout = Layout(
            (
                ("blur", Cause.PSF, 1),
                ("law", Cause.REFLECTANCE, 1),
                ("laws", Cause.REFLECTANCE, 0 if first else len(self.other_laws)),
                ("wings", Cause.REFLECTANCE, 0 if first else len(_WING_RATIOS)),
                ("ovality", Cause.PSF, 2 if known and not (first or self.view.in_air) else 0),
            )
        )
        law_sigma = _LAW_SIGMA if self.options.edges is EdgeModel.TEMPLATE else _STEP_LAW_SIGMA
        sigmas = {"blur": sigma_px2, "law": law_sigma, "laws": _OTHER_LAW_SIGMA, "wings": _WING_SIGMA}
        sigmas["ovality"] = sigma_px2
        return layout, layout.vector(sigmas)

    def _clear(self, position_km: Float) -> Mask:
        """Usable pixels (rows, columns) that no rings cover."""
        view = self.view
        if self.options.rings_km is None:
            return view.usable
        covered = Rings(*self.options.rings_km).cover(
            view.plane, position_km, self.figure.camera_from_axes, widened_px=2.0 * UNKNOWN_PSF_SIGMA_PX
        )
        return view.usable & ~covered
