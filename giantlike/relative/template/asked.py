"""What the residuals of a fitted template ask for: another figure, or a motion during the exposure."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.values import Value
from giantlike.image_model.columns import Block, Prior
from giantlike.relative.template.covariance import LinearFit
from giantlike.relative.verification.checks import chance_of

_STRAINS = 3
UNLIKELY = 0.01
_NOTHING = np.zeros(3)  # center and logarithm of the range
_STRAINED = 0.3
"""Strain a priori, and smear over the square of the radius of the light: far beyond what is linear."""
_CONDITION_LIMIT = 1e8
"""Condition number of the scaled normal matrix beyond which residuals ask for nothing: other unknowns explain it."""
_RELIEF = 0.01
"""Standard deviation of limb and terminator about those of the model, over the radius, as of the coarse render: where
relief moves them to and fro along one direction they look smeared. A right Vesta asks for 1.5 px^2 at a radius of some
250 px."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asked(Value):
    """What residuals ask for beside the parameters of a fit; nothing by default.

    Parameters
    ----------
    strain : (3,) float64
        Motion along rows and along columns in proportion to the place along the other axis, and growth along rows with
        shrinking along columns; relative.
    strain_covariance : (3, 3) float64
        From noise, and from errors of the model as a jackknife shows them.
    smear_px2 : (2,) float64, px^2
        Half of the variance along x less that along y, and the covariance of x and y, of a motion: as those of
        :class:`~giantlike.relative.template.smear.Smear`.
    smear_covariance : (2, 2) float64, px^4
    moved : (3,) float64
        By how much center, px, and logarithm of the range would change.
    """

    strain: Float = field(default_factory=_NOTHING.copy)
    strain_covariance: Float = field(default_factory=lambda: np.eye(_STRAINS))
    smear_px2: Float = field(default_factory=lambda: np.zeros(2))
    smear_covariance: Float = field(default_factory=lambda: np.eye(2))
    moved: Float = field(default_factory=_NOTHING.copy)

    def on_pixels(self, size: int) -> Asked:
        """Return the same in pixels, of a fit to blocks of so many pixels along each side."""
        return Asked(
            strain=self.strain,
            strain_covariance=self.strain_covariance,
            smear_px2=size**2 * self.smear_px2,
            smear_covariance=size**4 * self.smear_covariance,
            moved=np.array([size, size, 1.0]) * self.moved,
        )

    def strain_chance(self, known: Float) -> float:
        """Probability that a right body looks strained by as much, of which a covariance (3, 3) is known."""
        return chance_of(self.strain, self.strain_covariance + known)

    def smear_chance(self, sigma_px2: float, radius_px: float) -> float:
        """Probability that the image of a body at rest looks smeared by as much.

        Parameters
        ----------
        sigma_px2 : float, px^2
            Standard deviation of the variance of the point spread function along an axis.
        radius_px : float, px
            Of the body.

        Returns
        -------
        float
        """
        known_px4 = 0.5 * sigma_px2**2 + (_RELIEF * radius_px) ** 4
        return chance_of(self.smear_px2, self.smear_covariance + known_px4 * np.eye(2))

    def error(self, known: Float) -> Float:
        """Covariance (3, 3) of center and logarithm of the range by a strain that is no right body's."""
        unlikely = self.strain_chance(known) < UNLIKELY
        return np.outer(self.moved, self.moved) * float(unlikely)


def known_strain(turn_rad: float, *, attitude_known: bool) -> Float:
    """Covariance of the strain of a right body.

    Parameters
    ----------
    turn_rad : float, rad
        Standard deviation of its orientation in the image, as declared; a strain by something else counts alike.
    attitude_known : bool
        Whether the error of the attitude is declared; else any roll of the camera is right.

    Returns
    -------
    (3, 3) float64
    """
    roll = np.array([-1.0, 1.0, 0.0]) * (0.0 if attitude_known else _STRAINED)
    return turn_rad**2 * np.eye(_STRAINS) + np.outer(roll, roll)


def asked_beside(
    fit: LinearFit,
    *,
    strain: Float,
    smear: Float | None,
    considered: Block | None,
    radius_px: float,
    noise: Float,
    error: Float,
    blur_px: float,
    block_px: int,
) -> Asked:
    """Ask residuals for a strain and, where the fit has none, a smear.

    What noise alone may ask for is not looked at further. Beyond, errors of the model that are alike over parts of the
    body (markings, other laws) ask for it too, in some of its parts: the scatter between these is in the covariance.

    Parameters
    ----------
    fit : LinearFit
    strain : (3, h, w) float64
        Changes of the model by the parameters of the strain.
    smear : (2, h, w) float64, optional
        Changes of the model by the variances of a smear, px^2.
    considered : Block, optional
        Errors of the model that are known, as of the limb in haze.
    radius_px : float, px
        Of the light.
    noise, error, blur_px, block_px
        As of :meth:`~giantlike.relative.template.covariance.LinearFit.full_covariance`.

    Returns
    -------
    Asked
    """
    blocks = [_block("strain", strain, _STRAINED)]
    blocks += [] if smear is None else [_block("smear", smear, _STRAINED * radius_px**2)]
    score = fit.score_omitted(*blocks)
    if score.condition > _CONDITION_LIMIT or chance_of(score.values, score.covariance) > UNLIKELY:
        return Asked()
    columns = fit.columns.extended(blocks)
    beside = LinearFit(columns, np.concatenate([fit.values + score.step, score.values]))
    whole = beside.full_covariance(error, of_noise=beside.noise_covariance(noise), blur_px=blur_px, block_px=block_px)
    whole = whole if considered is None else whole + columns.consider(considered)
    moved = score.step[columns.layout.span("center", "range")]
    spans = [columns.layout.span(block.effect) for block in blocks]
    (strain, strain_covariance), *rest = [(beside.values[span], whole[span, span]) for span in spans]
    asked = Asked(moved=moved, strain=strain, strain_covariance=strain_covariance)
    return replace(asked, smear_px2=rest[0][0], smear_covariance=rest[0][1]) if rest else asked


def _block(effect: str, matrix: Float, sigma: float) -> Block:
    """Unknowns of a figure or of an exposure that the fit leaves out."""
    return Block(effect=effect, cause=Cause.RELIEF, matrix=matrix, prior=Prior.of_sigmas([sigma] * len(matrix)))
