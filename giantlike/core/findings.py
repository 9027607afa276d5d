"""Results of a fix other than the position: corrections estimated from the image, and outcomes of its checks."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float

_ROOM_PX = 4  # padding around images, besides the length of the motion blur, against wrap-around


@dataclass(frozen=True, slots=True, kw_only=True)
class _Stated:
    """Base of values that provenance states: figures with as many digits as the metadata of their fields have."""

    @property
    def texts(self) -> dict[str, str]:
        """Texts of the values that are known, by name."""
        texts = ((one.name, _text(getattr(self, one.name), one.metadata.get("digits"))) for one in fields(self))
        return {name: text for name, text in texts if text}

    def __str__(self) -> str:
        return " ".join(f"{name}={text}" for name, text in self.texts.items())


def _text(value: Any, digits: int | None) -> str:
    """Text of a figure, of named figures or of anything else; empty where it is not known."""
    if value is None:
        return ""
    if isinstance(value, Mapping):
        return " ".join(f"{name}={number:.{digits}g}" for name, number in value.items())
    return str(value) if digits is None else f"{value:.{digits}g}"


def _round_value(value: Any, digits: int | None) -> Any:
    """A number rounded to the digits with which it is reported; a value with all of its numbers rounded."""
    if isinstance(value, _Stated):
        known = {one.name: _round_value(getattr(value, one.name), one.metadata.get("digits")) for one in fields(value)}
        return replace(value, **known)
    return value if value is None or digits is None else float(f"{value:.{digits}g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Response(_Stated):
    """Light as a parabola of the values of an image: exact for tables of square roots, near for other tables.

    bend: quadratic coefficient: 0 for a linear response, 1 where values are square roots of the signal.
    dark_dn, bright_dn: values that remain unchanged: of the sky, and of the brightest signal; ``bend`` acts between
        them.

    >>> table = Response(bend=1.0, dark_dn=0.0, bright_dn=100.0)
    >>> [float(light) for light in table.light_dn(np.array([0.0, 10.0, 50.0, 100.0]))]
    [0.0, 1.0, 25.0, 100.0]
    """

    bend: float = field(metadata={"digits": 4})
    dark_dn: float = field(metadata={"digits": 6})
    bright_dn: float = field(metadata={"digits": 6})

    def light_dn(self, values_dn: Float) -> Float:
        """Return the linear signal of values. ``values_dn`` (...); returns (...)."""
        span_dn = self.bright_dn - self.dark_dn
        lowest_dn = -0.5 * (1.0 - self.bend) / max(self.bend, 1e-9) * span_dn
        above = np.maximum(values_dn - self.dark_dn, lowest_dn)
        return np.asarray(self.dark_dn + above + self.bend * above * (above / span_dn - 1.0))

    def slope_at(self, light_dn: Float) -> Float:
        """Return the derivative (...) of :meth:`light_dn` at the values of a linear signal (...), DN."""
        share = (light_dn - self.dark_dn) / (self.bright_dn - self.dark_dn)
        return np.sqrt(np.maximum((1.0 - self.bend) ** 2 + 4.0 * self.bend * share, 0.0))

    def changes_dn(self, light_dn: Float) -> Float:
        """Derivatives (2, ...) of :meth:`light_dn` by ``bend``, and by that of a cubic that vanishes half way."""
        span_dn, straight = self.bright_dn - self.dark_dn, 1.0 - self.bend
        light = light_dn - self.dark_dn
        above = 2.0 * light / np.maximum(straight + self.slope_at(light_dn), 1e-9)
        square = above * (above / span_dn - 1.0)
        return np.stack([square, square * (2.0 * above / span_dn - 1.0)])


@dataclass(frozen=True, slots=True, kw_only=True)
class Smear(_Stated):
    """Uniform motion during the exposure, as the variance it adds to the point spread function.

    straight_px2, oblique_px2: half of (variance along x minus variance along y), and the covariance of x and y; with an
        isotropic part they are the second moments of a line.

    By 3 px along x and 4 px along y:

    >>> smear = Smear(straight_px2=(3**2 - 4**2) / 24, oblique_px2=3 * 4 / 12)
    >>> round(smear.length_px, 12), [round(along, 12) for along in smear.direction]
    (5.0, [0.6, 0.8])
    """

    straight_px2: float = field(default=0.0, metadata={"digits": 4})
    oblique_px2: float = field(default=0.0, metadata={"digits": 4})

    def on_blocks(self, size: float) -> Smear:
        """Return the same motion in an image of blocks of pixels."""
        return Smear(straight_px2=self.straight_px2 / size**2, oblique_px2=self.oblique_px2 / size**2)

    def subtract(self, other: Smear) -> Smear:
        """Return the difference to another smear."""
        return Smear(
            straight_px2=self.straight_px2 - other.straight_px2, oblique_px2=self.oblique_px2 - other.oblique_px2
        )

    @property
    def size_px2(self) -> float:
        """Half of the variance along the motion, px^2."""
        return math.hypot(self.straight_px2, self.oblique_px2)

    @property
    def length_px(self) -> float:
        """Length of the motion, px."""
        return math.sqrt(24.0 * self.size_px2)

    @property
    def direction(self) -> tuple[float, float]:
        """Unit vector along the motion."""
        angle = 0.5 * math.atan2(self.oblique_px2, self.straight_px2)
        return math.cos(angle), math.sin(angle)

    @property
    def blur_px2(self) -> Float:
        """Variance that it adds to the point spread function, (3,): xx, xy and yy, px^2."""
        even = self.size_px2
        return np.array([even + self.straight_px2, self.oblique_px2, even - self.straight_px2])

    def blur(self, images: Float) -> Float:
        """Return images (..., h, w) blurred by the motion; edge values are repeated beyond them."""
        return self._filter(images, lambda along: np.sinc(self.length_px * along))

    def blur_double_exposure(self, images: Float, share: float) -> Float:
        """Blur images (..., h, w) by two exposures of the same second moments, the second with a share of the light."""
        apart = math.sqrt(2.0 * self.size_px2 / (share * (1.0 - share)))
        first, second = (2j * math.pi * apart * place for place in (share, share - 1.0))
        return self._filter(
            images, lambda along: (1.0 - share) * np.exp(first * along) + share * np.exp(second * along)
        )

    def _filter(self, images: Float, transfer: Callable[[Float], Any]) -> Float:
        """Images (..., h, w) filtered by a function of the frequency along the motion, cycles per pixel."""
        from scipy.fft import irfft2, next_fast_len, rfft2

        room = _ROOM_PX + math.ceil(self.length_px)
        height, width = images.shape[-2:]
        size = [next_fast_len(each + 2 * room, real=True) for each in (height, width)]
        ends = [(room, total - each - room) for each, total in zip((height, width), size, strict=True)]
        padded = np.pad(images, [*[(0, 0)] * (images.ndim - 2), *ends], mode="edge")
        x, y = self.direction
        along = np.fft.rfftfreq(size[1]) * x + np.fft.fftfreq(size[0])[:, None] * y
        spread = irfft2(rfft2(padded) * transfer(along), s=size)
        return np.asarray(spread[..., room : room + height, room : room + width], dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trails(_Stated):
    """Charge-transfer trails: shares of the charge that arrive late, positive toward higher columns and rows."""

    along_rows: float = field(default=0.0, metadata={"digits": 4})
    along_columns: float = field(default=0.0, metadata={"digits": 4})


@dataclass(frozen=True, slots=True, kw_only=True)
class Turn(_Stated):
    """Rotation from the declared to the estimated orientation of a body: rotation vector in camera axes, rad."""

    x_rad: float = field(default=0.0, metadata={"digits": 4})
    y_rad: float = field(default=0.0, metadata={"digits": 4})
    z_rad: float = field(default=0.0, metadata={"digits": 4})

    @classmethod
    def of_rotation(cls, rotation: Rotation) -> Turn:
        """Return the turn by a rotation."""
        x, y, z = rotation.as_rotvec().tolist()
        return cls(x_rad=x, y_rad=y, z_rad=z)

    @property
    def rotation(self) -> Rotation:
        """The rotation."""
        return Rotation.from_rotvec([self.x_rad, self.y_rad, self.z_rad])


@dataclass(frozen=True, slots=True, kw_only=True)
class Corrections(_Stated):
    """Effects in an image, other than the position of a body, that a fix corrects for; None where it does not.

    Numbers are rounded to the digits with which the provenance of the fix reports them, so that a fix recomputed from
    its provenance is the same. ``one | other`` has the corrections of both; the second takes precedence.
    """

    response: Response | None = None  # response by which values were linearized
    smear: Smear | None = None  # motion of the body in the image during the exposure
    trails: Trails | None = None  # charge that arrives late
    turn: Turn | None = None  # rotation of the body from its declared orientation
    # altitude above the shape at which the limb is seen
    limb_altitude_km: float | None = field(default=None, metadata={"digits": 6})
    # standard deviation of the altitude, by haze or an atmosphere
    altitude_sigma_km: float | None = field(default=None, metadata={"digits": 6})
    # variance of the blur of the limb in excess of the camera's
    limb_blur_px2: float | None = field(default=None, metadata={"digits": 4})
    # ratio of the size of the body to its size at the predicted range, of fixes without a range
    seen_size: float | None = field(default=None, metadata={"digits": 6})

    def __post_init__(self) -> None:
        for one in fields(self):
            object.__setattr__(self, one.name, _round_value(getattr(self, one.name), one.metadata.get("digits")))

    def __or__(self, other: Corrections) -> Corrections:
        known = {one.name: getattr(other, one.name) for one in fields(other)}
        return replace(self, **{name: value for name, value in known.items() if value is not None})


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings(_Stated):
    """Outcomes of the checks of a fix; None, or empty, for checks that were not made."""

    # mean altitude, by a height map, of the ground at the limb
    terrain_mean_km: float | None = field(default=None, metadata={"digits": 6})
    # logarithm of the Bayes factor of the height map against a smooth limb
    terrain_log_odds: float | None = field(default=None, metadata={"digits": 3})
    # RMS of the limb residuals, normalized by noise and the errors of the height map
    terrain_misfit: float | None = field(default=None, metadata={"digits": 3})
    # statistics of the tests made on every fix, see ``giantlike.relative.judge.Judgement``, and the variance inflation
    # factor that they gave (``tension``)
    checks: Mapping[str, float] = field(default_factory=dict, metadata={"digits": 3})
    chosen: str = ""  # chosen, because: estimator that ``auto`` chose, and the reason
    because: str = ""
    checked_by: str = ""  # estimators whose fixes confirm the chosen one
    # p-value of the difference of these two fixes
    agreement: float | None = field(default=None, metadata={"digits": 3})
    weight: float | None = field(default=None, metadata={"digits": 3})  # weight of the first of two fixes in their mean
