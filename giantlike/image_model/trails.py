"""Charge-transfer trails as an effect: charge that traps of the detector release late, along rows or columns."""

from __future__ import annotations

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.findings import Trails
from giantlike.image_model.columns import Block, Prior, Use

LENGTHS_PX = (2.4, 7.7)
"""Decay lengths of trails, whose mixtures stand for lengths around them: the release time, in transfers, of the densest
traps of HST's ACS in the model of ArCTIc (README of jkeger/arctic: 0.74, 7.7 and 37 transfers), and the geometric mean
of that and the shorter one, which by itself is as good as a shift."""
SHARE_SIGMA = 0.02  # A priori standard deviation of the share of the charge that arrives late, along each axis: a guess


def trails_of_image(light: Float, block_px: int, known: Trails | None = None) -> Block:
    """Return the change of light (h, w), on blocks of pixels, by trails along rows and along columns.

    With known directions for both lengths; else the odd part of the long trails, as the even part, which widens the
    point spread function, does not change its sign with the share.
    """
    signs = (1.0, 1.0) if known is None else np.sign([known.along_rows, known.along_columns])
    lengths = LENGTHS_PX[-1:] if known is None else LENGTHS_PX
    change = _odd_part if known is None else _change
    matrix = [
        change(light, sign * length / block_px) if along == 0 else change(light.T, sign * length / block_px).T
        for along, sign in enumerate(signs)
        for length in lengths
    ]
    prior = Prior.of_sigmas([SHARE_SIGMA] * len(matrix))
    return Block(effect="trails", cause=Cause.PSF, matrix=np.stack(matrix), prior=prior, use=Use.WHEN_SEEN)


def trails_of_lines(values: Float, normals_px: Float, step_px: float) -> Float:
    """Derivatives (2, n, m) of profiles along unit normals (n, 2) by the shares along rows and along columns."""
    return np.stack([_odd_part(values, LENGTHS_PX[-1] / step_px * along[:, None]) for along in normals_px.T])


def _odd_part(values: Float, lengths: Float | float) -> Float:
    """Half the difference of the changes of values (n, m) by trails forward and backward."""
    return 0.5 * (_change(values, lengths) - _change(values, -lengths))


def _change(values: Float, lengths: Float | float) -> Float:
    """Change of values (n, m) by trails of signed decay lengths, samples, all or (n, 1); the ends are continued."""
    late, back = np.where(np.less(lengths, 0.0), values[:, ::-1], values), np.less(lengths, 0.0)
    decay = np.broadcast_to(np.exp(-1.0 / np.maximum(np.abs(lengths), 1e-3)), (len(values), 1))[:, 0]
    for k in range(1, late.shape[1]):
        late[:, k] += decay * (late[:, k - 1] - late[:, k])
    return np.where(back, late[:, ::-1], late) - values
