"""The checks that every estimator of a body makes of its fix, and the limits beyond which each raises its flag."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float, require
from giantlike.core.outcomes import Quality
from giantlike.core.values import Value

SHORT_ARC_SHARE = 0.25
"""Share of the outline below which an arc is short; the documented meaning of ``Quality.SHORT_ARC``.

Over a quarter of a circle center and radius are still told apart: the sagitta of such an arc is 29 % of the radius.
"""
LEAST_USED_SHARE = 0.5
"""Share of the observations that must be used; the documented meaning of ``Quality.MANY_REJECTED``.

The median absolute deviation, by which outliers are found, breaks down where half of the observations are wrong.
"""
UNLIKELY = 0.01
"""Probability of what residuals, or a difference to the prediction, show of an error that a fix does not have, below
which its errors grow by that, if it does not contradict them: of 168 nominal limbs one is strained by less than 0.03.
"""
BORDER_SHARE = 0.9
"""Share of a bounded search beyond which a fix lies at its border: the body may lie outside."""
LIGHT_LOG_ODDS = math.log(1000.0)
"""Logarithm of the odds that decide between two Suns, or two places, of a body: a thousand to one.

A Sun on another side must be as much more likely than the right one; another place as much less likely than the fix.

On eleven real images, each as it is and in eight variants, the odds against a right Sun were never above 3 to 1, those
against a Sun on the wrong side were over 10^4 to 1 at phase angles of 20 deg and more, and some 10 to 1 at 7-13 deg.
"""
MISFIT = 1.25
"""Residuals of a coarse render over the errors that are known beyond which the image shows something else.

Of 860 right fixes of images of the independent renderer (20-200 px, 150-20,000 DN, phase angles of 5-130 deg, five
laws told as one, markings of 15 %, unlisted relief of 1 %) 99 % came to less than 1.15 and three to more than 1.25; of
the 145 with the right law, shape and albedo none came to more than 0.6. Double exposures, wrong shapes and eclipses
come to 1.3-20.
"""
TERRAIN_MISFIT = 3.0
"""Residuals of a limb with its height map, over those that the map lets expect, beyond which the map must explain it a
thousand times better than no map does: no residuals of three times their size come from a right one by chance."""
UNEXPLAINED = 0.005
"""Area with unexplained light over the lit area beyond which something else is in the image: one of the same 860 fixes
had more, a second body beside the first gives 0.5, a ring 3."""
UNEVENNESS = 1.0
"""Squared differences of the places of neighboring rows, or columns, over their variance, beyond which they were read
or sent apart, or belong to another surface: errors of figures, laws and markings reach over many.

Of 102 images of the gauntlet that can be solved none comes to more than 0.2, of rocks with markings of 15 % found by
their light (2.5 px off) none to more than 0.8; rows that slip by a pixel or two come to 1 to 26.
"""
STEP = 16.0
"""Squared difference of the places of rows before and after one, or columns, over its variance, or over the scatter of
such differences elsewhere, beyond which they were sent apart: four standard deviations of noise and errors of the model
together, beyond which a cell is not explained.

Of 256 fixes of the gauntlet from which an answer is demanded (seed 9501, 21 kinds) those of markings of 15 % come to 12
at most (one of seed 9500 to 14), all others to 1.8, right fixes of real images to 4.4; rows that are shifted from one
on come to 13 to 30 where nothing else tells.
"""
TURN_SHARE = 0.15
"""Share of the squared residuals that a turn of the face must explain to be one; markings and relief look turned too.

Of 16 right fixes of rocks with markings of 15 % or relief of 1 % that no shape holds, which ask for turns of up to 1.6
degrees and 5 sigma, none came to more than 0.09; rocks that were turned by 2 degrees and more come to 0.2 to 0.5.
"""
LEAST_CHANCE = 6e-6
"""Probability below which the place, the figure or the blur that a coarse render asks for contradicts a fix.

Of three degrees of freedom it is that of 9 each: sigmas that would have to grow threefold, as they do above it. Of 70
right fixes of bodies with markings of 15 % or relief of 1 % that no shape holds 5e-3 is the least for place and figure;
of 80 without, of five laws told as one, 0.1. Real limbs are not as good: Jupiter came to 6.5e-6, and with 1e-4 Saturn
within its rings is refused. Of 176 fixes of seed 2000 of the gauntlet that need not be ok 33 are refused with 6e-6, 38
with 1e-4, 43 with 1e-3; of 102 that must be, none. A blur is less sure: markings along a terminator at 90 degrees of
phase came to 1e-8 to 1e-3, three of fourteen right fixes to less than 6e-6. A strain of a whole template comes to 0.04
at least for 33 fixes of the gauntlet that must be ``ok`` (seed 9538), to 5e-6 and less for silent wrong ones.
"""
MOST_GROWTH = 3.0
"""Sigma of a center of light with what its figure adds, over that without, beyond which the figure is another one: the
threefold growth at which :data:`LEAST_CHANCE` refuses a fix. See docs/gauntlet.md for what it refuses."""
LEAST_PREDICTION_CHANCE = 1e-3
"""Probability below which a fix contradicts the declared errors of its prediction: the rate of false alarms.

A tenth of the 1 % of right fixes that all checks together may call suspect. Of 195 right fixes of nominal images of
the gauntlet (seeds 3000 and 6000, errors cut off at 3 sigma) none came to less than 0.06, their median to 0.52.
"""
LEAST_OBJECTIONS_CHANCE = 1e-3
"""Probability below which two of place, figure and prediction together contradict a fix: the rate of false alarms, as
for the prediction, for which both come to less than 0.018.

Of 412 right fixes of disturbed images of the gauntlet from which an answer is demanded (seed 9500) the second least
of their chances comes to 0.049 or more, of 766 of undisturbed images to 0.12. A single one tells less: a Jupiter with
the shadow of a moon on its face came to 2e-5 for the place of right limbs.
"""
LEAST_STRAIN_CHANCE = 1e-4
"""Probability below which a limb is that of another figure.

Of 168 right fixes of nominal images (seeds 3000 and 6000, three estimators), 34 of bodies with relief of 1 % that no
shape holds and 8 with markings of 15 % none came to less than 7e-3. Real limbs are not as good: a Jupiter whose roll is
known to 3 degrees came to 6e-4, a Saturn within its rings to 7e-4. Wrong poles, rolls and axes of ellipsoids that were
``ok`` with large sigmas came to 7e-5 and less. See docs/gauntlet.md for what it refuses.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class QualityChecks(Value):
    """Numbers of a fix from which its quality flags follow; the defaults raise none.

    Parameters
    ----------
    off_px : (2,) float64, px
        Place found less place predicted, of the point for which the search was declared.
    search_px : float, px
        Declared search: largest error of the prediction, in both coordinates.
    range_ratio : float
        Range predicted over range found: 1 + the relative error of the prediction.
    search_range : float
        Declared search: largest relative error of the predicted range; infinite for estimators that keep the range.
    bounded : bool
        True for estimators that cannot leave ``search_px``: a fix at its border may be the flank of a body outside.
    n_used : int
        Observations used.
    n_offered : int
        Observations that were to be used: those, and the ones rejected.
    residuals : float
        Residuals over the largest that noise and the known errors of the model explain; more than 1 is large. Where
        several criteria must agree, the least of their ratios; where one is enough, the largest.
    weakness : float
        Least good score over that of the fix; more than 1 is weak.
    outline_share : float
        Length of outline used over that of the whole outline.
    cut_by_frame : bool
        The body reaches over the edge of the image.
    ambiguous : bool
        Another source as good lies in the search region.
    light_log_odds : float
        Logarithm of the odds that light comes from another side than the Sun's.
    rival_log_odds : float
        Logarithm of the odds that the body is at the best other place in the search region.
    terrain_log_odds : float
        Logarithm of the odds that a limb is that of the smooth body, against that of its height map.
    terrain_misfit : float
        Residuals of a limb with a height map over what noise and the errors of the map come to.
    misfit : float
        Residuals of the body, rendered coarsely, over what noise and the known errors of models come to.
    unexplained : float
        Area with light that neither explains, or that lacks it, over the area that is lit.
    unevenness : float
        Squared difference of the places of neighboring rows or columns of the image, over its variance.
    step : float
        The same of all rows from one on, or columns, and those before, or over the scatter of this elsewhere.
    place_chance, figure_chance, blur_chance, turn_chance, prediction_chance, strain_chance, template_chance : float
        Probabilities that a right fix differs as much from the place that a coarse render asks for, that the parts of
        a right body ask for places as different, that its image is blurred as much beyond the point spread function,
        that its face looks turned by as much, that a right prediction is off by as much, and that the limb of a right
        body, or the whole of it beside its template, looks strained by as much.
    turn_share : float
        Share of the squared residuals of the body that this turn explains.
    growth : float
        Sigma of a center of light with the errors of the figure that a coarse render shows, over that without.
    """

    off_px: Float
    search_px: float
    range_ratio: float = 1.0
    search_range: float = math.inf
    bounded: bool = False
    n_used: int = 1
    n_offered: int = 1
    residuals: float = 0.0
    weakness: float = 0.0
    outline_share: float = 1.0
    cut_by_frame: bool = False
    ambiguous: bool = False
    light_log_odds: float = -math.inf
    rival_log_odds: float = -math.inf
    terrain_log_odds: float = -math.inf
    terrain_misfit: float = 0.0
    misfit: float = 0.0
    unexplained: float = 0.0
    unevenness: float = 0.0
    step: float = 0.0
    place_chance: float = 1.0
    figure_chance: float = 1.0
    blur_chance: float = 1.0
    turn_chance: float = 1.0
    turn_share: float = 0.0
    prediction_chance: float = 1.0
    strain_chance: float = 1.0
    template_chance: float = 1.0
    growth: float = 1.0

    def __post_init__(self) -> None:
        require(0 <= self.n_used <= self.n_offered, f"needed n_used in [0, {self.n_offered}], got {self.n_used}")
        Value.__post_init__(self)

    @property
    def far_from_prediction(self) -> bool:
        """True if the fix lies beyond the declared search, or at the border of a bounded one.

        The limits are those of the options and nothing else. They do not grow with the uncertainty of the fix: what
        is uncertain and far away is not confirmed by being uncertain.
        """
        limit_px = self.search_px * (BORDER_SHARE if self.bounded else 1.0)
        return float(np.max(np.abs(self.off_px))) > limit_px or abs(self.range_ratio - 1.0) > self.search_range

    @property
    def objections_chance(self) -> float:
        """Probability that two of the place, the figure and the prediction of a right fix look as wrong as here.

        That of the second least of three numbers that are uniform between 0 and 1.
        """
        second = sorted((self.place_chance, self.figure_chance, self.prediction_chance))[1]
        return 3.0 * second**2 - 2.0 * second**3

    @property
    def flags(self) -> Quality:
        """The flags that the numbers raise."""
        checks = (
            (Quality.CUT_BY_FRAME, self.cut_by_frame),
            (Quality.SHORT_ARC, self.outline_share < SHORT_ARC_SHARE),
            (Quality.LOW_SCORE, self.weakness > 1.0),
            (Quality.MANY_REJECTED, self.n_used < LEAST_USED_SHARE * self.n_offered),
            (Quality.LARGE_RESIDUALS, self.residuals > 1.0),
            (Quality.FAR_FROM_PREDICTION, self.far_from_prediction),
            (Quality.FAR_FROM_PREDICTION, self.prediction_chance < LEAST_PREDICTION_CHANCE),
            (Quality.AMBIGUOUS, self.ambiguous or self.rival_log_odds > -LIGHT_LOG_ODDS),
            (Quality.WRONG_LIGHT, self.light_log_odds > LIGHT_LOG_ODDS),
            (Quality.UNEXPLAINED_LIGHT, self.misfit > MISFIT or self.unexplained > UNEXPLAINED),
            (Quality.DISAGREEMENT, self.place_chance < LEAST_CHANCE),
            (Quality.DISAGREEMENT, self.objections_chance < LEAST_OBJECTIONS_CHANCE),
            (Quality.WRONG_FIGURE, self.figure_chance < LEAST_CHANCE or self.unevenness > UNEVENNESS),
            (Quality.WRONG_FIGURE, self.step > STEP),
            (Quality.WRONG_FIGURE, self.strain_chance < LEAST_STRAIN_CHANCE),
            (Quality.WRONG_FIGURE, self.template_chance < LEAST_CHANCE),
            (Quality.WRONG_FIGURE, self.terrain_misfit > TERRAIN_MISFIT and self.terrain_log_odds > -LIGHT_LOG_ODDS),
            (Quality.WRONG_FIGURE, self.turn_chance < LEAST_CHANCE and self.turn_share > TURN_SHARE),
            (Quality.WRONG_FIGURE, self.growth > MOST_GROWTH),
            (Quality.BLURRED, self.blur_chance < LEAST_CHANCE),
        )
        flags = Quality.NONE
        for flag, raised in checks:
            if raised:
                flags |= flag
        return flags
