"""Fit of the rendered body to the image in cells: residuals, and estimated corrections of position and shape."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.causes import Cause
from giantlike.core.findings import Response
from giantlike.core.values import Value
from giantlike.image_model.columns import Block, Columns, Layout, Prior, Solution
from giantlike.image_model.field import MarkingModes
from giantlike.ray_tracing import Lambert, LommelSeeliger, Minnaert, Template
from giantlike.ray_tracing.cached_trace import Trace
from giantlike.relative.judge import Alternative
from giantlike.relative.response import DISPLAY_BEND_SIGMA
from giantlike.relative.template.haze import VEIL_DEPTH, haze_block
from giantlike.relative.template.undeclared import IndependentParts, undeclared_effects
from giantlike.relative.verification.alternatives import (
    CellScores,
    other_outline,
    second_light,
    shifted_lines,
    waves_along,
)
from giantlike.relative.verification.cell_loops import design_of
from giantlike.relative.verification.cells import BLOCK, Cells

_EDGE_RADIUS, _EDGE_PX = 0.01, 0.3
"""Standard deviation of a limb or a terminator about the modeled one: relief of 1 % of the radius, and px, for the
point spread function."""
_WINGS, _WING_RADIUS = 0.01, 0.35
"""Ratio of the light scattered around a body to its own, and its distance, radii: wings of a point spread function."""
_AROUND, _FLOOR = 0.08, 0.02
"""Extent of albedo variations, radii, so that cells along a limb have them too; and minimum error of the model relative
to the brightest cell. Without it, bright images (20,000 DN) contradict correct fixes by up to 9 standard deviations
where the law differs; with 1 and 2 % by up to 5."""
_LAW_SIGMA = 1.0  # A priori standard deviation of the fraction of another law: 0 is the assumed law, 1 the other one
_MOVED, _GROWN, _STRAINED = 0.5, 0.3, 0.3
"""A priori standard deviations of motion (radii), growth and strain of a body: far beyond the linear range."""
OTHER_LAWS = (Lambert(), LommelSeeliger(), Minnaert(k=0.7))
"""Laws of a mixture: strong, no and medium limb darkening, as for limbs. Minnaert's is not a sum of the others: without
it, such a surface was mistaken for another shape by up to 3 standard deviations."""
_OTHER_LAW = 0.5  # ratio of the error by laws outside of that mixture to the change by the laws in it
_BLURRED = 10.0  # A priori standard deviation of the blur, squares of a cell: far beyond the linear range
_GAIN_SIGMAS = (0.1, 0.01)
"""A priori standard deviations of the brightness relative to the image, tried in turn where the fitted gain is not
positive: albedo variations took all of the light, or the image is darker at the body."""
_SIGMAS: Mapping[str, float | Sequence[float]] = {
    "gain": 0.0,
    "laws": _LAW_SIGMA,
    "place": (_MOVED, _MOVED, _GROWN),
    "strain": _STRAINED,
    "blur": _BLURRED,
}
"""A priori standard deviations of the unknowns relative to the gain; the others are free."""
_PSF_PX2 = 0.3
"""Standard deviation, px^2, of the variance of a declared point spread function: 0.7 px wide, known to 30 %."""
_ITERATIONS, _SETTLED = 3, 0.01
"""Maximum number of fits, and relative change of the gain at which they have converged. The gain sets the weights of
the cells."""
_UNLIKELY = 4.0
"""Residual, in standard deviations of noise and model errors together, beyond which a cell is an outlier."""
_ISOLATED = 3  # side, cells, of the median filter that removes stars, cosmic rays and single rows from the outliers
_KERNEL_SIGMAS = 4.0  # reach of a Gaussian, standard deviations: less than 1e-4 of it lies beyond
_LIT = 0.05  # fraction of the brightest cell below which cells are not counted as lit
_RELIEF_WAVES = 16
"""Wave number along the outline from which relief is neglected where the profile of the limb is tested."""
_LONG_WAVES = 1.3
"""Ratio of the effect of relief to that of errors of the same scatter that are correlated over parts of the disk. The
variances of eight correct limbs with unmodeled relief of 1 % grew threefold with 1.0 and by a half with 1.7, but with
1.7 rows shifted by two pixels were not detected as another shape."""
_LEAST_SCALE = 0.1
"""Minimum ratio of the scatter of the residuals of lit cells to the errors of the model. None of 80 correct fixes of
the independent renderer without albedo variations had an error of more than 1.1 standard deviations in position or
shape under any law (0.6 with a minimum of 0.6); a pole in error by 10 deg has 5 to 14 (1 to 3 with 0.6). Motion by
other laws that leaves no residuals is counted separately. Where fewer parts of a body are seen than there are unknowns,
the minimum is 1."""
_EDGES_OF_RIGHT = 0.45
"""Ratio of the scatter of limb and terminator to the errors of the model up to which the shape is correct. Of 288
undisturbed bodies of the gauntlet (20-250 px) only four crescents exceeded 0.4; one rock with craters (300 px, 120
degrees of phase) reached 0.51."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate(Value):
    """Unknowns of one effect."""

    values: Float  # (k,)
    covariance: Float  # (k, k); by noise, and by errors of the model scaled to the residuals


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CoarseFit(Value):
    """A body fitted to cells.

    strain: relative affine residual: shear along rows and along columns, and stretch along rows with shrinking along
        columns.
    figure_px2: (2, 2); covariance of the center of all light by an error of the shape, as shown by edges and strain;
        zero where they are consistent with the shape.
    response: response by which the values were linearized, if any, with the curvature estimated from the residuals.
    """

    gain_dn: float  # signal of a surface seen and lit along its normal
    log_evidence: float  # logarithm of the tempered likelihood of the cells without markings, up to a constant
    marked_log_evidence: float  # the same with a field of markings
    alternatives: Mapping[Alternative, float]  # logarithms of the odds of other models of the cells
    place: Estimate  # motion: x and y in px, and of the logarithm of the range
    strain: Estimate
    blur: Estimate  # covariance of the blur beyond the point spread function: xx, xy and yy, px^2
    figure_px2: Float
    response: Response
    bend_sigma: float  # standard deviation of its curvature
    bend_log_odds: float  # logarithm of the odds of a curvature other than the linearized one
    haze_chance: float = 0.0  # probability of undeclared haze
    haze_depth: float = 0.0  # its vertical optical depth

    def at(self, moved: Float) -> CoarseFit:
        """Return the same fit with another motion (3,)."""
        return replace(self, place=replace(self.place, values=moved))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Design(Value):
    """Linear model of the light of cells.

    Derivatives ``matrix`` (k, n, n) by the unknowns and their a priori standard deviations ``sigma`` (k,) relative to
    the gain; the light itself, its gradient per cell and the light scattered by optics, (n, n) each; the modes of
    undeclared markings, if any; the light ``around`` (n, n), and the center of the body (2,), cells.
    """

    layout: Layout
    matrix: Float
    sigma: Float
    own: Float
    slope: Float
    scattered: Float
    around: Float
    markings: MarkingModes | None
    center: Float

    @property
    def plain(self) -> _Design:
        """The design without markings."""
        return replace(self, markings=None)

    def columns(
        self, values: Float, weights: Float, gain: float, variances: Float | None, *, gain_sigma: float = 1.0
    ) -> Columns:
        """Linear problem for the values (n, n) of cells, with undeclared markings in addition to the unknowns.

        The gain has a prior, because markings could explain all of the light.
        """
        sigma = self.layout.vector({"gain": gain_sigma}) + self.sigma
        markings = None if self.markings is None else self.markings.brighter(gain)
        prior = Prior.of_sigmas(gain * sigma, self.layout.vector({"gain": gain}))
        return Columns(self.layout, self.matrix, prior, values, weights, markings, variances)


@dataclass(frozen=True, kw_only=True, eq=False)
class _FittedDesign(Value):
    """A design fitted to cells: the solution, the solution with free gain, gain and model errors (n, n).

    ``edge`` (n, n) are the cells whose errors are mostly errors of edges, ``least`` is the minimum scatter of the
    residuals; ``noise`` (n, n) is the variance of the noise.
    """

    cells: Cells
    design: _Design
    solution: Solution
    free: Solution
    gain: float
    noise: Float
    model_sigma: Float
    edge: Mask
    least: float

    @cached_property
    def fresh(self) -> Mask:
        """Cells (n, n) that count."""
        return self.solution.columns.weights > 0.0

    @cached_property
    def lit(self) -> Mask:
        """Counted cells (n, n) where the body is lit."""
        return self.fresh & _find_lit(self.design.own)

    @cached_property
    def scores(self) -> CellScores:
        """Score tests of effects left out of the fit."""
        return CellScores(solution=self.solution, temper=1.0 / max((BLOCK * self.cells.radius) ** 2, 1.0))

    @cached_property
    def normalized_residuals(self) -> Float:
        """Residuals (n, n) over their standard deviations; 0 where a cell does not count."""
        return np.asarray(self.solution.residuals * np.sqrt(self.solution.columns.weights))

    def covariance(self, influence: Float, *, noise: Float | None = None) -> Float:
        """Covariance (k, k) of unknowns that change with the cells by ``influence`` (k, n, n).

        ``noise`` (n, n), squares of the normalized residuals, is not counted as an error of the model.
        """
        scale = _scale(self.normalized_residuals, self.lit, self.edge, least=self.least, noise=noise)
        return _covariance(influence, self.noise, scale * self.model_sigma, self.cells)


def fit_cells(
    cells: Cells,
    trace: Trace,
    own: Template,
    *,
    albedo: float,
    turn_rad: float = 0.0,
    response: Response | None = None,
    motion: Callable[[Float], Float] | None = None,
    veils: Float | None = None,
) -> CoarseFit | None:
    """Fit gain, law, a plane and small changes of the position to the cells around a body.

    ``motion`` blurs images in cells; ``veils`` (3, n, n) are the images of undeclared haze, where it is tested for.
    None where too few cells hold the body.
    """
    fresh, design = cells.crop(cells.fresh), _design(cells, trace, own, motion)
    if np.count_nonzero(fresh & _find_lit(design.own)) <= design.layout.count:
        return None
    sigma, edge = _model_sigma(design, turn_rad, cells)
    fitted = _fit_design(cells, design, sigma, edge, cells.place(own.coverage, own))
    if fitted is None:
        return _nothing_alike()
    if not fitted.lit.any():
        return None
    place, strain, blur = _geometry(fitted)
    plain = _fit_design(
        cells, design.plain, np.hypot(sigma, albedo * design.around), edge, cells.place(own.coverage, own)
    )
    plain = fitted if plain is None or not plain.lit.any() else plain
    bent, bend_sigma, bend_log_odds = _response(plain, response)
    chance, depth = (0.0, 0.0) if veils is None else _haze(plain, plain.gain * veils)
    return CoarseFit(
        gain_dn=fitted.gain,
        log_evidence=plain.scores.log_evidence,
        marked_log_evidence=fitted.scores.log_evidence,
        alternatives=_alternatives(fitted),
        place=place,
        strain=strain,
        blur=blur,
        figure_px2=_figure_covariance(fitted, strain),
        response=bent,
        bend_sigma=bend_sigma,
        bend_log_odds=bend_log_odds,
        haze_chance=chance,
        haze_depth=depth,
    )


def motion_log_evidence(cells: Cells, trace: Trace, own: Template, motion: Callable[[Float], Float]) -> float:
    """Logarithm of the likelihood of cells in which a body is blurred by a motion, up to a constant.

    Relief shifts the limb, which does not change the profile across it: waves along the outline are fitted, and cells
    at edges have no errors of the model beyond those of the disk interior.
    """
    design = _design(cells, trace, own, motion).plain
    _, edge = _model_sigma(design, 0.0, cells)
    fitted = _fit_design(cells, design, _face_sigma(design), edge, cells.place(own.coverage, own))
    if fitted is None:
        return -math.inf
    growth = fitted.gain * fitted.solution.columns["place"][2]
    waves = growth * waves_along(growth.shape, design.center, range(2, _RELIEF_WAVES))
    relief = Block(
        effect="relief", cause=Cause.RELIEF, matrix=waves, prior=Prior.of_sigmas([_EDGE_RADIUS] * len(waves))
    )
    parts = fitted.scores.temper * float(np.count_nonzero(fitted.fresh))
    return fitted.solution.columns.extend([relief]).log_evidence(parts)


def _find_lit(light: Float) -> Mask:
    """Cells (n, n) that are not much fainter than the brightest."""
    return np.asarray(light > _LIT * float(light.max()))


def _fit_design(cells: Cells, design: _Design, sigma: Float, edge: Mask, coverage: Float) -> _FittedDesign | None:
    """Fit a design to cells, weighted by the gain and without isolated outliers.

    ``sigma`` (n, n) are the errors of the model relative to the gain, ``coverage`` (n, n) the fractions of cells that
    the body covers. None where the image fits a dark body better than a bright one.
    """
    values, noise, fresh = cells.crop(cells.values), cells.crop(cells.variance), cells.crop(cells.fresh)
    gain, variances = _first_gain(values, design.own, fresh), None
    for _ in range(_ITERATIONS):
        model_sigma = gain * sigma
        weights = np.where(fresh, 1.0 / (noise + model_sigma**2), 0.0)
        found = free = design.columns(values, weights, gain, variances).solve()
        for gain_sigma in _GAIN_SIGMAS:
            if found is not None and not found["gain"][0] > 0.0:
                found = design.columns(values, weights, gain, variances, gain_sigma=gain_sigma).solve()
        if found is None or free is None or not found["gain"][0] > 0.0:
            return None
        solution, bare, variances = found, free, found.columns.mode_variances
        change, gain = abs(float(solution["gain"][0]) / gain - 1.0), float(solution["gain"][0])
        isolated = _find_isolated(solution.residuals * np.sqrt(weights), fresh)
        used, fresh = fresh, fresh & ~isolated
        if change < _SETTLED and not isolated.any():
            break
    parts = float(coverage[used].sum()) / (BLOCK * cells.radius) ** 2
    return _FittedDesign(
        cells=cells,
        design=design,
        solution=solution,
        free=bare,
        gain=gain,
        noise=noise,
        model_sigma=model_sigma,
        edge=edge,
        least=_LEAST_SCALE if parts > design.layout.count else 1.0,
    )


def _alternatives(fitted: _FittedDesign) -> dict[Alternative, float]:
    """Logarithms of the odds of other models of the cells."""
    by_x, by_y, growth = fitted.gain * fitted.solution.columns["place"]
    cells, light, scores = fitted.cells, fitted.gain * fitted.design.own, fitted.scores
    free = CellScores(solution=fitted.free, temper=scores.temper)
    return {
        Alternative.DARK_BODY: free.log_evidence - scores.log_evidence if fitted.free["gain"][0] <= 0.0 else -math.inf,
        Alternative.SECOND_LIGHT: second_light(scores, light, cells.radius, cells.blur),
        Alternative.OTHER_OUTLINE: other_outline(scores, growth, fitted.design.center),
        Alternative.SHIFTED_ROWS: shifted_lines(scores, by_x, axis=0),
        Alternative.SHIFTED_COLUMNS: shifted_lines(scores, by_y, axis=1),
    }


def _geometry(fitted: _FittedDesign) -> tuple[Estimate, Estimate, Estimate]:
    """Place, strain and blur."""
    solution, gain, cells = fitted.solution, fitted.gain, fitted.cells
    layout = solution.columns.layout.part("place", "blur")
    by_law = _OTHER_LAW * (solution.values - _without_laws(solution.columns))
    by_law = by_law[solution.columns.layout.span("place", "blur")]
    span = solution.columns.layout.span("place", "blur")
    marks = solution.columns.propagate(solution.columns.field_scatter)[span, span]
    covariance = fitted.covariance(solution.columns.gain("place", "blur")) + marks + np.outer(by_law, by_law)
    place, strain, blur = (
        Estimate(solution[name] / gain, covariance[layout.span(name), layout.span(name)] / gain**2)
        for name, _, _ in layout.effects
    )
    per_radius = np.diag([cells.radius * cells.size, cells.radius * cells.size, -1.0])
    return (
        Estimate(per_radius @ place.values, per_radius @ place.covariance @ per_radius),
        strain,
        Estimate(
            cells.size**2 * blur.values, cells.size**4 * blur.covariance + _PSF_PX2**2 * np.diag([1.0, 0.25, 1.0])
        ),
    )


def _response(fitted: _FittedDesign, known: Response | None) -> tuple[Response, float, float]:
    """The known or a linear response with the curvature that the residuals show, its standard deviation and odds."""
    solution = fitted.solution
    if known is None:
        dark_dn, bright_dn = float(solution["background"][0]), float(solution.model[fitted.lit].max())
        known = Response(bend=0.0, dark_dn=dark_dn, bright_dn=bright_dn)
    image = -known.changes_dn(solution.model)[:1]
    influence = _influence(solution, "bend", image)[0]
    bend = known.bend + float(np.vdot(influence, solution.residuals))
    sigma = math.sqrt(float(fitted.covariance(influence)[0, 0]))
    return replace(known, bend=bend), sigma, float(fitted.scores.log_odds(image, DISPLAY_BEND_SIGMA)[0])


def _haze(fitted: _FittedDesign, images: Float) -> tuple[float, float]:
    """Probability of haze by its images (3, n, n), DN, and its vertical optical depth."""
    cells, columns = fitted.cells, fitted.solution.columns
    parts = IndependentParts.from_size(int(np.count_nonzero(columns.weights)), cells.radius, 1.0).of_surface
    haze = undeclared_effects(fitted.solution, {haze_block(images): parts})["haze"]
    return haze.chance, VEIL_DEPTH * max(-float(haze.score.values[0]), 0.0)


def _influence(solution: Solution, effect: str, images: Float) -> tuple[Float, Float]:
    """Derivatives of the amplitudes of omitted images (a, n, n), each alone, by the cells; and their information (a,).

    Applied to residuals it counts the prior of the other unknowns twice: amplitudes differ from ``Score.alone`` by up
    to 0.15 standard deviations.
    """
    prior = Prior.of_sigmas([math.inf] * len(images))
    score = solution.score_omitted(Block(effect=effect, cause=Cause.NOISE, matrix=images, prior=prior))
    return score.gain_alone, np.maximum(np.diag(score.information), 1e-300)


def _design(cells: Cells, trace: Trace, own: Template, motion: Callable[[Float], Float] | None) -> _Design:
    """Design with the light of the body under its law and others, a plane, and derivatives by position and size."""
    light = cells.place(own.brightness, own)
    light = light if motion is None else motion(light)
    others = np.empty((len(OTHER_LAWS), *light.shape))
    for number, law in enumerate(OTHER_LAWS):
        other = cells.light(trace.with_reflectance(law))
        others[number] = other if motion is None else motion(other)
    x, y = own.center_px[0] - cells.inner.x, own.center_px[1] - cells.inner.y
    scattered = _blur(light, _WING_RADIUS * cells.radius)
    laws, background, stray, place, strain, blur, slope = design_of(light, others, scattered, x, y, cells.radius)
    blocks = (
        ("gain", Cause.REFLECTANCE, light[None]),
        ("laws", Cause.REFLECTANCE, laws),
        ("background", Cause.BACKGROUND, background),
        ("stray", Cause.BACKGROUND, stray),
        ("place", Cause.NOISE, place),
        ("strain", Cause.RELIEF, strain),
        ("blur", Cause.PSF, blur),
    )
    layout = Layout(tuple((effect, cause, len(images)) for effect, cause, images in blocks))
    return _Design(
        layout=layout,
        matrix=np.concatenate([images for _, _, images in blocks]),
        sigma=layout.vector(_SIGMAS, other=math.inf),
        own=light,
        slope=slope,
        scattered=scattered,
        around=_blur(light, _AROUND * cells.radius),
        markings=MarkingModes.across(light, np.array([x, y]), cells.radius),
        center=np.array([x, y]),
    )


def _without_laws(columns: Columns) -> Float:
    """Solution (k,) under the assumed law."""
    kept = columns.layout.without("laws")
    solution = np.zeros(columns.layout.count)
    solution[kept] = np.linalg.solve(columns.information[np.ix_(kept, kept)], columns.right[kept])
    return solution


def _first_gain(values: Float, light: Float, fresh: Mask) -> float:
    """Gain (DN) at which the light of the body has the norm of the image about its median."""
    seen = values[fresh]
    above = seen - float(np.median(seen))
    return max(float(np.linalg.norm(above) / np.linalg.norm(light[fresh])), 1e-300)


def _blur(images: Float, sigma: float, border: int = cv2.BORDER_REFLECT) -> Float:
    """Images (..., n, n) blurred by a truncated Gaussian whose standard deviation is in cells."""
    reach = math.ceil(_KERNEL_SIGMAS * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel /= kernel.sum()
    blurred = np.empty_like(images)
    size = images.shape[-2:]
    for image, result in zip(images.reshape(-1, *size), blurred.reshape(-1, *size), strict=True):
        cv2.sepFilter2D(image, cv2.CV_64F, kernel, kernel, dst=result, borderType=border)
    return blurred


def _scale(normalized: Float, lit: Mask, edge: Mask, *, least: float, noise: Float | None = None) -> Float:
    """Ratio (n, n) of the scatter of the residuals to the errors of the model: in the disk interior, and at edges.

    Relief moves only the edges, and is correlated over longer parts of them. ``noise`` (n, n) are the squared residuals
    by noise, negligible for coarse cells.
    """
    squares = normalized**2 if noise is None else normalized**2 - noise
    face, rim = (
        max(math.sqrt(max(float(np.mean(squares[part])), 0.0)) if part.any() else 0.0, least)
        for part in (lit & ~edge, lit & edge)
    )
    return np.where(edge, _LONG_WAVES * rim, face)


def _model_sigma(design: _Design, turn_rad: float, cells: Cells) -> tuple[Float, Mask]:
    """Standard deviation (n, n) of the errors of the model relative to the gain, and where edges dominate it."""
    edges = (math.hypot(_EDGE_RADIUS, turn_rad) * cells.radius + _EDGE_PX / cells.size) * design.slope
    face = _face_sigma(design)
    return np.hypot(face, edges), np.asarray(edges > face)


def _face_sigma(design: _Design) -> Float:
    """Standard deviation (n, n) of the errors of the model relative to the gain, without those of edges."""
    return np.hypot(_WINGS * design.scattered, _FLOOR * float(design.own.max()))


def _nothing_alike() -> CoarseFit:
    """Outcome where the image fits a dark body better than a bright one."""
    nothing = Estimate(np.zeros(3), np.eye(3))
    return CoarseFit(
        gain_dn=0.0,
        log_evidence=-math.inf,
        marked_log_evidence=-math.inf,
        alternatives={},
        place=nothing,
        strain=nothing,
        blur=nothing,
        figure_px2=np.zeros((2, 2)),
        response=Response(bend=0.0, dark_dn=0.0, bright_dn=1.0),
        bend_sigma=math.inf,
        bend_log_odds=-math.inf,
    )


def _covariance(influence: Float, noise: Float, model_sigma: Float, cells: Cells) -> Float:
    """Covariance (k, k) of unknowns where errors of the model are correlated over a part of the disk.

    ``influence`` (k, n, n) are the derivatives of the unknowns by the cells.
    """
    length = 0.5 * BLOCK * cells.radius
    area = max(2.0 * math.pi * length**2, 1.0)
    errors = _blur(model_sigma * influence, length, cv2.BORDER_CONSTANT)
    errors *= area * model_sigma
    errors += noise * influence
    covariance = np.tensordot(influence, errors, axes=([1, 2], [1, 2]))
    return np.asarray(0.5 * (covariance + covariance.T))


def _figure_covariance(fitted: _FittedDesign, strain: Estimate) -> Float:
    """Covariance (2, 2), px^2, of the center of all light by an error of the shape.

    A strain (3,) about the center hardly moves light, but an error of the shape that strains the image also moves it:
    slipping rows strain it by half of their motion. Markings hardly strain: none of 80 nominal fixes of the gauntlet
    (seeds 3000 and 6000) is strained beyond its errors. Limb and terminator add errors scaled to their residuals.
    """
    cells, light, values = fitted.cells, fitted.design.own, strain.values
    excess = max(1.0 - len(values) / max(float(values @ np.linalg.solve(strain.covariance, values)), 1e-300), 0.0)
    strained_px2 = excess * float(np.mean(values**2)) * (cells.radius * cells.size) ** 2
    normalized, lit, edge = fitted.normalized_residuals, fitted.lit, fitted.edge
    by_figure = math.sqrt(_share_of_figure(normalized, lit, edge))
    shown = _scale(normalized, lit, edge, least=fitted.least) * fitted.model_sigma
    strayed = np.where(edge, by_figure * shown / fitted.gain, 0.0)
    if not strayed.any():
        return strained_px2 * np.eye(2)
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]].astype(np.float64)
    total = float(light.sum())
    arms = np.stack([each - float((light * each).sum()) / total for each in (columns, rows)]) * cells.size
    return strained_px2 * np.eye(2) + _covariance(arms / total, np.zeros_like(light), strayed, cells)


def _share_of_figure(normalized: Float, lit: Mask, edge: Mask) -> float:
    """Fraction of the squared residuals of limb and terminator that only another shape explains.

    Markings and other laws leave as much in the disk interior.
    """
    face, rim = (float(np.mean(normalized[part] ** 2)) if part.any() else 0.0 for part in (lit & ~edge, lit & edge))
    usual = max(_EDGES_OF_RIGHT**2, face)
    return 1.0 - usual / rim if rim > usual else 0.0


def _find_isolated(normalized: Float, fresh: Mask) -> Mask:
    """Outlying cells, alone or in a single line: stars, cosmic rays, dead columns."""
    odd = fresh & (np.abs(normalized) > _UNLIKELY)
    return np.asarray(odd & ~_in_patches(odd))


def _in_patches(odd: Mask) -> Mask:
    """Outlying cells most of whose neighbors are outliers too."""
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(odd, size=_ISOLATED)) if odd.any() else odd
