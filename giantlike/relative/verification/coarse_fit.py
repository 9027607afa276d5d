"""The rendered body fitted to the image in cells: what of the light it leaves, and where it would rather be."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.findings import Response, Smear
from giantlike.core.values import Value
from giantlike.ray_tracing import Lambert, LommelSeeliger, Minnaert, Template, Trace
from giantlike.relative.response import LEAST_BEND
from giantlike.relative.verification.cell_loops import design_of, unevenness_of
from giantlike.relative.verification.cells import BLOCK, Cells

_EDGE_RADIUS, _EDGE_PX = 0.01, 0.3
"""Standard deviation of a limb or a terminator about those of the model: relief of 1 % of the radius, and px, for the
point spread function."""
_WINGS, _WING_RADIUS = 0.01, 0.35
"""Light scattered around a body, over its own, and how far from it, radii: wings of a point spread function."""
_AROUND, _FLOOR = 0.08, 0.02
"""Radii over which markings and errors of the law reach, so that the cells along a terminator and a limb have them too,
and the least error over the brightest cell. Without the floor bright images (20,000 DN) of right fixes contradict them
by up to 9 standard deviations where the law is another one; with 1 and 2 % by up to 5."""
_LAW_SIGMA = 1.0
"""Share of another law in the light, a priori: anything from the law that was told to the other one."""
_MOVED, _GROWN, _STRAINED = 0.5, 0.3, 0.3
"""Motion, radii, growth and strain of a body a priori: far beyond what is linear."""
_OTHER_LAWS = (Lambert(), LommelSeeliger(), Minnaert(k=0.7))
"""Laws that the light may be a sum of: of strong, no and medium darkening, as for limbs. Minnaert's is no sum of the
others: without it, it looked like another figure by up to 3 standard deviations."""
_LAWS = (1, 2, 3)
"""Columns of the design for other laws."""
_OTHER_LAW = 0.5
"""Error that laws beyond those leave, over what they change: half of it."""
_LEVEL = 4
"""Column of the design for the background."""
_PLACE, _STRAIN, _BLUR = slice(10, 13), slice(13, 16), slice(16, 19)
"""Columns of the design for the place, the strain and the blur."""
_GEOMETRY, _OF_GEOMETRY = slice(10, None), (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, None))
"""All of these and what is fitted besides, and each of them among all."""
_X_AND_Y = slice(10, 12)
"""Columns of the place in the image alone."""
_FURTHER = slice(19, None)
"""Columns of what is fitted besides."""
_BLURRED = 10.0
"""Standard deviation of the blur a priori, squares of a cell: far beyond what is linear."""
_SIGMA = np.array(
    [math.inf, *3 * [_LAW_SIGMA], *6 * [math.inf], _MOVED, _MOVED, _GROWN, *3 * [_STRAINED], *3 * [_BLURRED]]
)
"""Standard deviations of all of these a priori, over the gain."""
_PSF_PX2 = 0.3
"""Standard deviation, px^2, of the variance of a point spread function that a camera knows: one of 0.7 px to 30 %."""
_ITERATIONS, _SETTLED = 3, 0.01
"""The gain that sets the weights of the cells is known to a percent after three; where it is before, and no cell is
left out any more, these are the last."""
_UNLIKELY = 4.0
"""Standard deviations beyond which a cell is not explained, by noise and errors of the model together."""
_ISOLATED = 3
"""Side, cells, of the median that takes stars, cosmic rays and single rows out of what is not explained."""
_KERNEL_SIGMAS = 4.0
"""Reach of a Gaussian, standard deviations: less than 1e-4 of it lies beyond."""
_DARK = 1e-30
"""Sum of the light of cells below which a law leaves a body dark."""
_LIT = 0.05
"""Of the brightest cell: fainter ones are not counted as lit."""
_TELLING, _LINES = 0.05, 4
"""Information of a row or column on its place, over that of the one that tells most, from which on it counts, and pairs
of neighbors that are needed."""
_BESIDE = 3
"""Lines on each side of a gap whose places are compared. With one, the spikes that cosmic rays and ghosts leave in
single lines are as large as some steps of shifted rows; with six, steps of markings are."""
_LONG_WAVES = 1.3
"""Effect of relief over that of errors of the same scatter that are alike over parts of a face. With 1.0 the variances
of eight right limbs with relief of 1 % that no shape holds grew threefold, with 1.7 by a half, but rows that are two
pixels off were no other figure any more."""
_LEAST_SCALE = 0.1
"""Least scatter, over that of the errors of the model, that the residuals of the lit cells are taken to show. Of 80
right fixes of the independent renderer without markings none was then off by more than 1.1 standard deviations in place
or figure, whatever the law; with 0.6 none by more than 0.6, and a pole that is 10 deg off by 1 to 3 only, now by 5 to
14. What laws move without leaving residuals is counted on its own. Where fewer parts of a body are seen than there are
unknowns, which then take up its errors, residuals show nothing: the least is 1."""
_EDGES_OF_RIGHT = 0.45
"""Scatter of limb and terminator, over that of the errors of the model, up to which they are those of a right figure:
of 288 undisturbed bodies of the gauntlet (20-250 px) none but four crescents came to more than 0.4, of rocks with
craters of 300 px at 120 degrees of phase one to 0.51."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CoarseFit(Value):
    """A body fitted to cells.

    Parameters
    ----------
    gain_dn : float, DN
        Light of a surface seen and lit along its normal.
    misfit : float
        Root mean square, over the lit cells, of the residuals over what noise and known errors of models come to.
    unexplained : float
        Area of the cells with light that neither explains, or that lack it, over the area that is lit.
    moved : (3,) float64
        Motion that the image asks for: x and y in px, and of the logarithm of the range.
    covariance : (3, 3) float64
        Of ``moved``: noise, and errors of the model of the size that the residuals show.
    strain : (3,) float64
        How the parts of the body disagree: motion along rows and along columns in proportion to the place along the
        other axis, and growth along rows with shrinking along columns; relative.
    strain_covariance : (3, 3) float64
    blur : (3,) float64, px^2
        Covariance of light about its place beyond that of the point spread function: xx, xy and yy.
    blur_covariance : (3, 3) float64
    unevenness : float
        Mean squared difference of the places of neighboring rows, or columns, over its variance: where one of them ends
        light tells where it is. Errors of figures, laws and markings reach over many, so that 1 is far too much.
    step : float
        The largest squared difference of the places of :data:`_BESIDE` rows and as many below them, or columns, over
        its variance, or over what is usual beside other rows: where all lines from one on are shifted. A single line
        that is off counts little.
    figure_px2 : (2, 2) float64, px^2
        Covariance of the center of all light by a figure that is not that of the body, as far as edges and strain show
        it; zero where they are those of a right one.
    response : Response
        What the residuals ask for beside all else: the one by which the values were made proportional to light, if they
        were, with another bend.
    bend_sigma : float
        Standard deviation of its bend; infinite where it is too small to be looked at.
    structure : float
        Mean product of residuals of neighboring lit cells over their errors: noise comes to zero.
    further : (k,) float64
        What was fitted besides.
    further_covariance : (k, k) float64
    asked : (a,) float64
        What the residuals ask for, beside all else, of each of the images that they were asked about, alone.
    asked_sigma : (a,) float64
        Standard deviations.
    asked_explains : (a,) float64
        Squared residuals that each of them explains, over those that noise leaves.
    """

    gain_dn: float
    misfit: float
    unexplained: float
    moved: Float
    covariance: Float
    strain: Float
    strain_covariance: Float
    blur: Float
    blur_covariance: Float
    unevenness: float
    step: float
    figure_px2: Float
    response: Response
    bend_sigma: float
    structure: float
    further: Float
    further_covariance: Float
    asked: Float
    asked_sigma: Float
    asked_explains: Float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Design(Value):
    """Columns (p, n, n) that light may be a sum of, and their a priori standard deviations (p,) over the gain.

    Also the light itself, its steepness per cell and what optics scatter of it, (n, n) each.
    """

    own: Float
    columns: Float
    sigma: Float
    slope: Float
    scattered: Float

    def with_further(self, columns: Float) -> _Design:
        """Add columns (k, n, n) of unknowns of the order of 1."""
        sigma = np.concatenate([self.sigma, np.ones(len(columns))])
        return replace(self, columns=np.concatenate([self.columns, columns]), sigma=sigma)


def fit_cells(
    cells: Cells,
    trace: Trace,
    own: Template,
    *,
    albedo: float,
    turn_rad: float = 0.0,
    further: Float | None = None,
    response: Response | None = None,
    smear: Smear | None = None,
    asked: Float | None = None,
) -> CoarseFit | None:
    """Fit gain, law, a plane and small changes of the place to the cells around a body.

    Parameters
    ----------
    cells : Cells
    trace : Trace
        Of the body at the place found.
    own : Template
        The body under its law.
    albedo : float
        Standard deviation of the brightness of its surface about its law.
    turn_rad : float, rad
        Standard deviation of the orientation of the body, about any axis.
    further : (k, n, n) float64, optional
        Changes of the light in :attr:`Cells.inner` that are fitted besides, by unknowns of the order of 1 at most.
    response : Response, optional
        By which the values were made proportional to light.
    smear : Smear, optional
        Motion of the body during the exposure, in pixels of the image.
    asked : (a, n, n) float64, optional
        Changes of the light in :attr:`Cells.inner` that the residuals are asked about: what is fitted stays without.

    Returns
    -------
    CoarseFit or None
        None where too few cells hold the body.
    """
    design = _design(cells, trace, own, smear)
    if further is not None:
        design = design.with_further(further)
    fresh = cells.cropped(cells.fresh)
    lit = fresh & (design.own > _LIT * float(design.own.max()))
    if np.count_nonzero(lit) <= len(design.columns):
        return None
    values, noise = cells.cropped(cells.values), cells.cropped(cells.variance)
    gain = _first_gain(values, design.own, fresh)
    relative_sigma, edge = _model_sigma(design, albedo, turn_rad, cells)
    flat = design.columns.reshape(len(design.columns), -1)
    for _ in range(_ITERATIONS):
        model_sigma = gain * relative_sigma
        weights = 1.0 / (noise + model_sigma**2)
        weighted = flat * np.where(fresh, weights, 0.0).ravel()
        normal, projected = weighted @ flat.T + np.diag(1.0 / (gain * design.sigma) ** 2), weighted @ values.ravel()
        solution = np.linalg.solve(normal, projected)
        if not solution[0] > 0.0:
            return _nothing_alike()
        change, gain = abs(float(solution[0]) / gain - 1.0), float(solution[0])
        used, normalized = fresh, (values - (solution @ flat).reshape(values.shape)) * np.sqrt(weights)
        isolated = _isolated(normalized, fresh)
        if change < _SETTLED and not isolated.any():
            break
        fresh = fresh & ~isolated
    fresh, lit = used, lit & used
    if not lit.any():
        return None
    normalized = np.where(fresh, normalized, 0.0)
    misfit = float(np.sqrt(np.mean(normalized[lit] ** 2)))
    parts = float(cells.place(own.coverage, own)[fresh].sum()) / (BLOCK * cells.radius) ** 2
    least = _LEAST_SCALE if parts > len(flat) else 1.0
    shown_sigma = _scale(normalized, lit, edge, least=least) * model_sigma
    influence = (np.linalg.inv(normal)[_GEOMETRY] @ weighted).reshape(-1, *values.shape)
    by_law = _OTHER_LAW * (solution - _without_laws(normal, projected))[_GEOMETRY]
    covariance = _covariance(influence, noise, shown_sigma, cells) + np.outer(by_law, by_law)
    place, strain, blur, besides = (covariance[part, part] for part in _OF_GEOMETRY)
    strain_covariance = strain / gain**2 + turn_rad**2 * np.eye(3)
    by_figure = math.sqrt(_share_of_figure(normalized, lit, edge))
    strained, strayed = np.asarray(solution[_STRAIN] / gain), np.where(edge, by_figure * shown_sigma / gain, 0.0)
    by_x, by_y = design.columns[_X_AND_Y]
    unevenness, step = unevenness_of(by_x, by_y, weights, normalized, _TELLING, _LINES, _BESIDE)
    per_radius = np.diag([cells.radius * cells.size, cells.radius * cells.size, -1.0])
    model = (solution @ flat).reshape(values.shape)
    if response is None:
        response = Response(bend=0.0, dark_dn=float(solution[_LEVEL]), bright_dn=float(model[lit].max()))
    by_bend, bend = _bend_asked(response, values, model, flat, weighted, normal)
    bend_sigma = math.inf
    if bend > LEAST_BEND:
        bend_sigma = math.sqrt(float(_covariance(by_bend[None], noise, shown_sigma, cells)[0, 0]))
    shares, share_variances, explained = np.zeros(0), np.zeros(0), np.zeros(0)
    if asked is not None:
        by_asked, information = _influences(gain * asked.reshape(len(asked), -1), flat, weighted, normal)
        shares = by_asked @ (values - model).ravel()
        of_noise = np.where(fresh, noise * weights, 0.0)
        scale = _scale(normalized, lit, edge, least=least, noise=of_noise)
        share_variances = np.diag(_covariance(by_asked.reshape(-1, *values.shape), noise, scale * model_sigma, cells))
        by_chance = math.sqrt(2.0 * float(np.sum(of_noise**2)))
        explained = shares**2 * information / max(float(np.sum(normalized**2 - of_noise)), by_chance)
    return CoarseFit(
        gain_dn=gain,
        misfit=misfit,
        unexplained=_unexplained_area(normalized, fresh) / float(np.count_nonzero(lit)),
        moved=per_radius @ solution[_PLACE] / gain,
        covariance=per_radius @ place @ per_radius / gain**2,
        blur=np.asarray(solution[_BLUR] / gain * cells.size**2),
        blur_covariance=blur * (cells.size**2 / gain) ** 2 + _PSF_PX2**2 * np.diag([1.0, 0.25, 1.0]),
        strain=strained,
        strain_covariance=strain_covariance,
        unevenness=unevenness,
        step=step,
        figure_px2=_by_figure(strained, strain_covariance, strayed, design.own, cells),
        response=replace(response, bend=bend),
        bend_sigma=bend_sigma,
        structure=_structure(normalized, lit),
        further=np.asarray(solution[_FURTHER] / gain),
        further_covariance=besides / gain**2,
        asked=shares,
        asked_sigma=np.sqrt(share_variances),
        asked_explains=explained,
    )


def _bend_asked(
    response: Response, values: Float, model: Float, flat: Float, weighted: Float, normal: Float
) -> tuple[Float, float]:
    """Bend of a response that residuals ask for beside a model (n, n), and how it changes with the cells (n, n).

    ``flat`` and ``weighted`` (p, n * n) are the design and the same over variances, ``normal`` (p, p) their products.
    """
    bent = -response.changes_dn(model)[0].ravel()
    influence = _influences(bent[None], flat, weighted, normal)[0][0]
    return influence.reshape(values.shape), response.bend + float(influence @ (values - model).ravel())


def _influences(images: Float, flat: Float, weighted: Float, normal: Float) -> tuple[Float, Float]:
    """How shares of images (a, n * n) that residuals ask for beside a model, each alone, change with the cells.

    And what the cells tell of each, (a,).
    ``flat`` and ``weighted`` (p, n * n) are the design and the same over variances, ``normal`` (p, p) their products.
    """
    weights = weighted[_LEVEL]  # of a column of ones
    influence = weights * (images - np.linalg.solve(normal, weighted @ images.T).T @ flat)
    information = np.maximum(np.sum(influence * images, axis=1), 1e-300)
    return influence / information[:, None], information


def _structure(normalized: Float, lit: Mask) -> float:
    """Mean product of neighboring residuals of lit cells."""
    left = np.where(lit, normalized, 0.0)
    products = 0.5 * float(np.vdot(left[1:], left[:-1]) + np.vdot(left[:, 1:], left[:, :-1]))
    return products / float(np.count_nonzero(lit))


def _design(cells: Cells, trace: Trace, own: Template, smear: Smear | None) -> _Design:
    """The light of the body under its law and others, a plane, and derivatives by place and size."""
    in_cells = None if smear is None else smear.on_blocks(cells.size)
    light = cells.place(own.brightness, own)
    light = light if in_cells is None else in_cells.smeared(light)
    others = np.empty((len(_OTHER_LAWS), *light.shape))
    for number, law in enumerate(_OTHER_LAWS):
        other = cells.light(trace.with_reflectance(law))
        others[number] = other if in_cells is None else in_cells.smeared(other)
    x, y = own.center_px[0] - cells.inner.x, own.center_px[1] - cells.inner.y
    scattered = _blurred(light, _WING_RADIUS * cells.radius)
    columns, slope = design_of(light, others, scattered, x, y, cells.radius)
    return _Design(own=light, columns=columns, sigma=_SIGMA, slope=slope, scattered=scattered)


def _without_laws(normal: Float, projected: Float) -> Float:
    """Solution (p,) with the law as it was told."""
    kept = np.delete(np.arange(len(projected)), _LAWS)
    solution = np.zeros_like(projected)
    solution[kept] = np.linalg.solve(normal[np.ix_(kept, kept)], projected[kept])
    return solution


def _first_gain(values: Float, light: Float, fresh: Mask) -> float:
    """Gain (DN) that makes the light of the body as strong as that of the image about its median."""
    seen = values[fresh]
    above = seen - float(np.median(seen))
    return max(float(np.linalg.norm(above) / np.linalg.norm(light[fresh])), 1e-300)


def _blurred(images: Float, sigma: float, border: int = cv2.BORDER_REFLECT) -> Float:
    """Images (..., n, n) blurred by a Gaussian of a standard deviation in cells, cut at some of them."""
    reach = math.ceil(_KERNEL_SIGMAS * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel /= kernel.sum()
    blurred = np.empty_like(images)
    size = images.shape[-2:]
    for image, result in zip(images.reshape(-1, *size), blurred.reshape(-1, *size), strict=True):
        cv2.sepFilter2D(image, cv2.CV_64F, kernel, kernel, dst=result, borderType=border)
    return blurred


def _scale(normalized: Float, lit: Mask, edge: Mask, *, least: float, noise: Float | None = None) -> Float:
    """Scatter (n, n) that the residuals show over that of the errors of the model: of the face, and of its edges.

    Relief moves the edges and leaves the face, which has many more cells; and it is alike over longer parts of them.
    ``noise`` (n, n) are the squares that come from noise: of coarse cells next to none, which may be left out.
    """
    squares = normalized**2 if noise is None else normalized**2 - noise
    face, rim = (
        max(math.sqrt(max(float(np.mean(squares[part])), 0.0)) if part.any() else 0.0, least)
        for part in (lit & ~edge, lit & edge)
    )
    return np.where(edge, _LONG_WAVES * rim, face)


def _model_sigma(design: _Design, albedo: float, turn_rad: float, cells: Cells) -> tuple[Float, Mask]:
    """Standard deviation (n, n) of the errors of the model over the gain by cell, and where edges are most of it."""
    markings = albedo * _blurred(design.own, _AROUND * cells.radius)
    edges = (math.hypot(_EDGE_RADIUS, turn_rad) * cells.radius + _EDGE_PX / cells.size) * design.slope
    wings, floor = _WINGS * design.scattered, _FLOOR * float(design.own.max())
    face = markings**2 + wings**2 + floor**2
    return np.asarray(np.sqrt(face + edges**2)), np.asarray(edges**2 > face)


def _nothing_alike() -> CoarseFit:
    """The outcome where the image fits a dark body better than a bright one."""
    return CoarseFit(
        gain_dn=0.0,
        misfit=math.inf,
        unexplained=1.0,
        moved=np.zeros(3),
        covariance=np.eye(3),
        strain=np.zeros(3),
        strain_covariance=np.eye(3),
        blur=np.zeros(3),
        blur_covariance=np.eye(3),
        unevenness=0.0,
        step=0.0,
        figure_px2=np.zeros((2, 2)),
        response=Response(bend=0.0, dark_dn=0.0, bright_dn=1.0),
        bend_sigma=math.inf,
        structure=math.inf,
        further=np.zeros(0),
        further_covariance=np.zeros((0, 0)),
        asked=np.zeros(0),
        asked_sigma=np.zeros(0),
        asked_explains=np.zeros(0),
    )


def _covariance(influence: Float, noise: Float, model_sigma: Float, cells: Cells) -> Float:
    """Covariance (k, k) of unknowns where errors of the model are alike over a part of the disk.

    ``influence`` (k, n, n) is how the unknowns change with the cells.
    """
    length = 0.5 * BLOCK * cells.radius
    area = max(2.0 * math.pi * length**2, 1.0)
    errors = _blurred(model_sigma * influence, length, cv2.BORDER_CONSTANT)
    errors *= area * model_sigma
    errors += noise * influence
    covariance = np.tensordot(influence, errors, axes=([1, 2], [1, 2]))
    return np.asarray(0.5 * (covariance + covariance.T))


def _by_figure(strain: Float, strain_covariance: Float, strayed: Float, light: Float, cells: Cells) -> Float:
    """Covariance (2, 2), px^2, of the center of all light by a wrong figure.

    A strain (3,) about the center hardly moves light, but a figure that is wrong by as much in what a strain tells is
    wrong by as much in what a motion tells too: rows that slip strain it by half of what they move it. Markings hardly
    strain: of 80 nominal fixes of the gauntlet (seeds 3000 and 6000) none is strained beyond its errors. ``strayed``
    (n, n) are the errors of limb and terminator over the gain by the figure, as the residuals show them.
    """
    excess = max(1.0 - len(strain) / max(float(strain @ np.linalg.solve(strain_covariance, strain)), 1e-300), 0.0)
    strained_px2 = excess * float(np.mean(strain**2)) * (cells.radius * cells.size) ** 2
    if not strayed.any():
        return strained_px2 * np.eye(2)
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]].astype(np.float64)
    total = float(light.sum())
    arms = np.stack([each - float((light * each).sum()) / total for each in (columns, rows)]) * cells.size
    return strained_px2 * np.eye(2) + _covariance(arms / total, np.zeros_like(light), strayed, cells)


def _share_of_figure(normalized: Float, lit: Mask, edge: Mask) -> float:
    """Share of the squared residuals of limb and terminator that only another figure leaves.

    Markings and other laws leave as much in the face.
    """
    face, rim = (float(np.mean(normalized[part] ** 2)) if part.any() else 0.0 for part in (lit & ~edge, lit & edge))
    usual = max(_EDGES_OF_RIGHT**2, face)
    return 1.0 - usual / rim if rim > usual else 0.0


def _isolated(normalized: Float, fresh: Mask) -> Mask:
    """Cells that nothing explains, alone or in a single line: stars, cosmic rays, dead columns."""
    odd = fresh & (np.abs(normalized) > _UNLIKELY)
    return np.asarray(odd & ~_in_patches(odd))


def _unexplained_area(normalized: Float, fresh: Mask) -> float:
    """Number of cells that nothing explains, isolated ones left out."""
    return float(np.count_nonzero(_in_patches(fresh & (np.abs(normalized) > _UNLIKELY))))


def _in_patches(odd: Mask) -> Mask:
    """Cells most of whose neighbors are odd too."""
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(odd, size=_ISOLATED)) if odd.any() else odd
