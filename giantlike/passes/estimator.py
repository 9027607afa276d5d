"""Whole-pass estimator: errors common to the images of a pass, from the limbs or positions measured in them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats
from scipy.spatial.transform import Rotation

from giantlike._system.processes import one_thread
from giantlike.calibration.observability import WeakCombination, weak_combinations
from giantlike.core.arrays import Float, Mask, symmetric
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.passes.fix import PassFix, TimetagJitter, term_test
from giantlike.passes.images import DISPLACEMENT, ROTATION, NavigationPass
from giantlike.passes.layout import PassLayout
from giantlike.passes.normal import (
    ImageSums,
    Normal,
    agreeing,
    evaluate,
    new_in_image,
    noise_variance,
    normal_of,
    restricted_cost,
    scaled_inverse,
    sums_of,
)
from giantlike.passes.terms import PassOptions, PassTerm

WEAK = 30.0  # inflation from which a combination is reported: its parts then correlate by more than 0.999
_JITTER_REACH = 1e3  # factor, down and up, within which the jitter is searched around the first guess
_LARGEST_NOISE = 10.0  # residuals over stated noise from which a pass is refused: noise is measured in images
_LOG_STEP = 0.05  # step in the logarithm of the jitter by which the curvature of its likelihood is taken


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _PassState(Value):
    """The converged fit: departure (k,) of all parameters, with residuals and normal equations."""

    departure: Float
    residuals: tuple[Float, ...]
    keeps: tuple[Mask, ...]
    sums: tuple[ImageSums, ...]
    normal: Normal
    iterations: int


def estimate_pass(given: NavigationPass, options: PassOptions | None = None) -> PassFix | Failure:
    r"""Estimate the errors that the images of a pass share.

    Parameters
    ----------
    given : NavigationPass; images with the measured and predicted values of each
    options : PassOptions, optional; terms, and their a priori uncertainties

    Returns
    -------
    PassFix or Failure
        ``DEGENERATE_GEOMETRY`` where the images do not determine a combination of parameters without a priori
        information; ``TOO_FEW_DETECTIONS`` where outliers leave too little; ``NOT_CONVERGED``.

    Raises
    ------
    InputError
        A term needs several exposures or several sensors, and the images do not have them.

    Notes
    -----
    Gauss-Newton on all residuals at once. A limb point is moved outward by a rotation of the camera, a displacement
    of the body, the altitude of the limb and a shift in the image, and every parameter is a combination of these in
    every image; so an image is compressed to its information on them. Errors that are new in each image (jitter of
    timetag and attitude) are integrated out of that with their standard deviations, which weights the images as their
    full covariance would. With ``P`` the inverse of the information ``N`` of measurements and a priori values, the
    covariance is :math:`P N P` by noise, :math:`P \Lambda P` by the a priori values and
    :math:`S C S^T` by a considered term with covariance C, :math:`S = -P N_{ec}`.

    The hypothesis of a test is that a term has its a priori value; its covariance is then the total covariance
    without the term's own a priori variance. The jitter has the standard deviation with the largest restricted
    likelihood; under the hypothesis of none the ratio is zero in half of all cases and chi-square of one in the other.

    References
    ----------
    .. [1] Inman et al., Artemis I optical navigation system performance, section IV.C: the altitude of the limb of the
       Earth found from the images of two passes, radius by exposure, and "timetag jitter".

    Examples
    --------
    >>> import numpy as np
    >>> from giantlike.passes import NavigationPass, PassImage, PassOptions, PassTerm
    >>> from giantlike.passes.images import MeasuredPosition
    >>> images = tuple(
    ...     PassImage(
    ...         name=str(k),
    ...         time_s=30.0 * k,
    ...         position_camera_km=np.array([0.0, 0.0, 150_000.0]),
    ...         observed=MeasuredPosition(
    ...             position_camera_km=np.array([0.0, 0.0, 150_234.0]),
    ...             covariance_camera_km2=np.diag([1.0, 1.0, 50.0]) ** 2,
    ...             radius_km=6371.0,
    ...             apparent_radius_px=310.0,
    ...         ),
    ...     )
    ...     for k in range(20)
    ... )
    >>> given = NavigationPass(images=images, limb_altitude_km=35.0)
    >>> fix = estimate_pass(given, PassOptions(estimate={PassTerm.LIMB_ALTITUDE: np.inf}))
    >>> round(fix.value("limb_altitude")), bool(fix.test("limb_altitude").significant())
    (25, True)
    """
    options = options or PassOptions()
    with one_thread():
        layout = PassLayout.from_pass(given, options)
        state = _solve_parameters(given, layout, options, options.timetag_jitter_s, np.zeros(len(layout.names)))
        jitter = (options.timetag_jitter_s, 0.0, 1.0)
        if options.estimate_jitter and not isinstance(state, Failure):
            jitter = _likely_jitter(given, layout, options, state)
            state = _solve_parameters(given, layout, options, jitter[0], state.departure)
        if isinstance(state, Failure):
            return state
        return _result(given, layout, options, state, jitter)


def _solve_parameters(
    given: NavigationPass, layout: PassLayout, options: PassOptions, jitter_s: float, start: Float
) -> _PassState | Failure:
    """Gauss-Newton steps until the parameters rest."""
    departure, prior, which = start, layout.information, layout.estimated
    keeps: list[Mask] | None = None
    for iteration in range(1, options.max_iterations + 1):
        measured = evaluate(given, layout, departure)
        random = [
            new_in_image(image, len(moves), jitter_s, options.pointing_jitter_rad)
            for image, moves in zip(given.images, layout.maps, strict=True)
        ]
        found = [np.isfinite(residuals) for residuals, _ in measured]
        used = found if keeps is None else [a & b for a, b in zip(found, keeps, strict=True)]
        sums = [sums_of(*each, keep, new) for each, keep, new in zip(measured, used, random, strict=True)]
        normal = normal_of(layout, sums)
        failure = _untold(layout, normal)
        if failure is not None:
            return failure
        total = (normal.information + prior)[np.ix_(which, which)]
        covariance = scaled_inverse(total)
        step = covariance @ (normal.pull - prior @ departure)[which]
        small = bool(np.all(np.abs(step) <= options.tolerance * np.sqrt(np.diagonal(covariance))))
        if small and keeps is not None:
            return _PassState(
                departure=departure,
                residuals=tuple(residuals for residuals, _ in measured),
                keeps=tuple(used),
                sums=tuple(sums),
                normal=normal,
                iterations=iteration,
            )
        departure = departure.copy()
        departure[which] += step
        if not _sensible(given, layout, departure):
            break
        if iteration > 1 or small:
            keeps = agreeing(given, measured, sums, options.outlier_sigmas)
    weakest = _weak(layout, normal)
    hint = f"; the weakest combination is {weakest[0]}" if weakest else ""
    return Failure(
        Reason.NOT_CONVERGED,
        f"the parameters of the pass did not settle in {options.max_iterations} iterations: give them a priori "
        f"standard deviations or switch terms off{hint}",
    )


def _sensible(given: NavigationPass, layout: PassLayout, departure: Float) -> bool:
    """True while every body stays before the camera and outside of it."""
    for image, moves in zip(given.images, layout.maps, strict=True):
        errors = moves @ departure
        moved_km = float(np.linalg.norm(errors[DISPLACEMENT]))
        if not (moved_km < 0.5 * np.linalg.norm(image.position_camera_km) and np.abs(errors[ROTATION]).max() < 1.0):
            return False
    altitude = departure[[term == PassTerm.LIMB_ALTITUDE for term in layout.terms]]
    radius_km = min(image.observed.least_radius_km for image in given.images)
    return bool(np.all(np.abs(altitude) < 0.5 * radius_km))


def _weak(layout: PassLayout, normal: Normal) -> tuple[WeakCombination, ...]:
    which = np.flatnonzero(layout.estimated)
    names = tuple(layout.names[k] for k in which)
    return weak_combinations(names, normal.information[np.ix_(which, which)], above=WEAK)


def _untold(layout: PassLayout, normal: Normal) -> Failure | None:
    """The failure of a pass that does not determine parameters without a priori information."""
    if normal.count == 0:
        return Failure(Reason.TOO_FEW_DETECTIONS, "no point or position of the pass agrees with the others")
    which = np.flatnonzero(layout.estimated)
    information = (normal.information + layout.information)[np.ix_(which, which)]
    names = tuple(layout.names[k] for k in which)
    lost = [each for each in weak_combinations(names, information, above=WEAK) if math.isinf(each.inflation)]
    if not lost:
        return None
    return Failure(
        Reason.DEGENERATE_GEOMETRY,
        f"the pass does not tell {lost[0]}: give one of its terms a priori standard deviations or switch it off",
    )


def _likely_jitter(
    given: NavigationPass, layout: PassLayout, options: PassOptions, state: _PassState
) -> tuple[float, float, float]:
    """Standard deviation of the timetags, standard deviation of its logarithm, and p-value of no jitter."""
    variance = noise_variance(list(state.sums)) if options.scale_noise else 1.0

    def cost(jitter_s: float) -> float:
        sums = [
            each.rescale(variance, new_in_image(image, len(each.pull), jitter_s, options.pointing_jitter_rad))
            for image, each in zip(given.images, state.sums, strict=True)
        ]
        return restricted_cost(layout, sums, state.departure)

    first = math.log(options.timetag_jitter_s)
    reach = math.log(_JITTER_REACH)
    best = optimize.minimize_scalar(
        lambda log: cost(math.exp(log)),
        bounds=(first - reach, first + reach),
        method="bounded",
        options={"xatol": 1e-3},
    )
    ratio = cost(0.0) - float(best.fun)
    if ratio <= 0.0:
        return 0.0, 0.0, 1.0
    around = [cost(math.exp(float(best.x) + shift)) for shift in (-_LOG_STEP, _LOG_STEP)]
    curvature = (sum(around) - 2.0 * float(best.fun)) / (2.0 * _LOG_STEP**2)
    spread = 1.0 / math.sqrt(curvature) if curvature > 0.0 else math.inf
    return math.exp(float(best.x)), spread, 0.5 * float(stats.chi2.sf(ratio, 1))


def _result(
    given: NavigationPass,
    layout: PassLayout,
    options: PassOptions,
    state: _PassState,
    jitter: tuple[float, float, float],
) -> PassFix | Failure:
    """Covariance by cause, tests and weak combinations of the converged fit."""
    which, normal, prior = np.flatnonzero(layout.estimated), state.normal, layout.information
    own = np.ix_(which, which)
    inverse = scaled_inverse((normal.information + prior)[own])
    told = inverse @ normal.information[own]
    freedom = max(normal.count - round(float(np.trace(told))), 1)
    chi2 = normal.squares
    ratio2 = max((chi2 - _squares_of_considered(normal, layout, inverse)) / freedom, 1.0)
    scale2 = ratio2 if options.scale_noise else 1.0
    if ratio2 > _LARGEST_NOISE**2:
        return Failure(
            Reason.LARGE_RESIDUALS,
            f"residuals are {math.sqrt(ratio2):.3g} times the stated noise (chi-square {chi2:.3g}, {freedom} degrees "
            "of freedom): the trajectory, the shape or an error that the images share is missing among the terms",
        )
    parts = {"noise": scale2 * symmetric(told @ inverse), "a priori": symmetric(inverse @ prior[own] @ inverse)}
    for term, members in layout.groups.items():
        held = [k for k in members if not layout.estimated[k]]
        if held:
            moved = inverse @ normal.information[np.ix_(which, held)]
            known = layout.covariance_apriori[np.ix_(held, held)]
            parts[f"considered {term}"] = symmetric(moved @ known @ moved.T)
    covariance = symmetric(np.sum(list(parts.values()), axis=0))
    departure = state.departure[which]
    sigmas = np.where(layout.free, np.inf, np.sqrt(np.diagonal(layout.covariance_apriori)))[which]
    tests = []
    for term, members in layout.groups.items():
        mine = np.flatnonzero(np.isin(which, members))
        if mine.size:
            still = prior[own].copy()
            still[mine, :] = still[:, mine] = 0.0
            others = covariance - parts["a priori"] + symmetric(inverse @ still @ inverse)
            tests.append(
                term_test(term, departure[mine], others[np.ix_(mine, mine)], freedom if options.scale_noise else None)
            )
    return PassFix(
        names=tuple(layout.names[k] for k in which),
        units=tuple(layout.units[k] for k in which),
        terms=tuple(layout.terms[k] for k in which),
        values=layout.apriori[which] + departure,
        covariance=covariance,
        parts=parts,
        apriori=layout.apriori[which],
        apriori_sigmas=sigmas,
        learned=np.clip(1.0 - np.diagonal(covariance) / sigmas**2, 0.0, 1.0),
        tests=tuple(tests),
        weak=_weak(layout, normal),
        jitter=_tags(given, layout, state, jitter, inverse) if jitter[0] > 0.0 or options.estimate_jitter else None,
        positions_camera_km=_positions(given, layout, state.departure),
        residuals=tuple(np.where(keep, r, np.nan) for r, keep in zip(state.residuals, state.keeps, strict=True)),
        chi2=chi2,
        freedom=freedom,
        noise_scale=math.sqrt(scale2),
        n_used=normal.count,
        n_rejected=sum(keep.size for keep in state.keeps) - normal.count,
        iterations=state.iterations,
    )


def _squares_of_considered(normal: Normal, layout: PassLayout, inverse: Float) -> float:
    """Reduction of chi-square if the errors that are considered were estimated, too."""
    estimated, held = np.flatnonzero(layout.estimated), np.flatnonzero(~layout.estimated)
    shared = normal.information[np.ix_(estimated, held)]
    left = normal.information[np.ix_(held, held)] - shared.T @ inverse @ shared
    known, pull = layout.covariance_apriori[np.ix_(held, held)], normal.pull[held]
    return float(pull @ known @ np.linalg.solve(np.eye(held.size) + left @ known, pull))


def _tags(
    given: NavigationPass, layout: PassLayout, state: _PassState, jitter: tuple[float, float, float], inverse: Float
) -> TimetagJitter:
    """Error of every timetag, with the error of the parameters in its standard deviation."""
    errors, sigmas = np.zeros(len(given.images)), np.zeros(len(given.images))
    which = np.flatnonzero(layout.estimated)
    for k, (moves, image) in enumerate(zip(layout.maps, state.sums, strict=True)):
        if jitter[0] > 0.0:
            known = np.linalg.inv(image.inner)
            errors[k] = jitter[0] * image.new_errors[0]
            follows = known @ image.random.T @ image.information @ moves[:, which]
            sigmas[k] = jitter[0] * math.sqrt(float(known[0, 0] + follows[0] @ inverse @ follows[0]))
    return TimetagJitter(sigma_s=jitter[0], sigma_of_log=jitter[1], p_value=jitter[2], errors_s=errors, sigmas_s=sigmas)


def _positions(given: NavigationPass, layout: PassLayout, departure: Float) -> Float:
    """Positions (n, 3) of the body in every image with the estimate applied."""
    errors = [moves @ departure for moves in layout.maps]
    turned = [
        Rotation.from_rotvec(each[ROTATION]).apply(image.position_camera_km + each[DISPLACEMENT])
        for image, each in zip(given.images, errors, strict=True)
    ]
    return np.stack(turned)
