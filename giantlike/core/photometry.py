"""Zero point of a camera: what turns magnitudes of stars and the sunlight on bodies into electrons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_finite, as_floats, require, require_number
from giantlike.core.errors import InputError
from giantlike.core.tables import checked_table
from giantlike.core.values import Value

SUN_MAGNITUDES: Mapping[str, float] = {"Gaia G": -26.90, "V": -26.76}
"""Apparent magnitude of the Sun at 1 au by band: Casagrande and VandenBerg (2018), Willmer (2018); to 0.02 mag."""
SUN_COLOR_BP_RP = 0.82  # Gaia BP-RP of the Sun, mag, Casagrande and VandenBerg (2018)
SUN_W_M2_UM = 1_500.0
"""Mean spectral irradiance of the Sun at 1 au between 0.4 and 0.9 um, W m^-2 um^-1, to 5 %: a blackbody of 5,772 K of
half angle 0.2666 degrees has 1,466 there."""
_PLANCK_J_S = 6.62607015e-34
_LIGHT_M_S = 299_792_458.0
_REFERENCE_COLOR = 1.0  # mag, BP-RP of the stars to which the zero point refers: the middle of catalogs
_KEYS = {
    "zero point": ("zero_point_e_s", "zero_point_mag", "aperture_m2"),
    "aperture": ("shortest_um", "longest_um", "quantum_efficiency"),
    "sigma": ("sigma_mag", "covariance_mag2"),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Photometry(Value):
    """Zero point of a camera: the table ``[photometry]`` of camera, scene and campaign files.

    A star of magnitude m gives ``10**(0.4 (zero_point_mag + color_term (BP-RP - 1) + field term - m))`` electrons per
    second. Electrons are numbers (DN) times the gain of the camera file; without one they are numbers.

    Parameters
    ----------
    zero_point_e_s : float, electron/s
        Signal of a star of magnitude 0 and BP-RP 1 on the optical axis. The default suits the demonstration: a star of
        magnitude 8.5 gives 400 electrons in 5 s.
    band : str; band of the magnitudes
    color_term : float, mag/mag; change with BP-RP
    field_term_mag : float, mag; change at ``field_angle_deg``, quadratic; negative where the field darkens
    field_angle_deg : float, degrees; angle from the axis at which ``field_term_mag`` is stated
    covariance_mag2 : (3, 3), mag^2; covariance of zero point, color term and field term; zeros where they are exact
    scatter_mag : float, mag; standard deviation of single stars about the relation, beyond their noise
    epoch : str; UTC at which it was measured, ISO 8601
    sun_magnitude : float, mag, optional; of the Sun at 1 au in ``band``; by default that of :data:`SUN_MAGNITUDES`

    Raises
    ------
    InputError
        A value is out of range, or the covariance is not one.
    """

    zero_point_e_s: float = 2.0e5
    band: str = "Gaia G"
    color_term: float = 0.0
    field_term_mag: float = 0.0
    field_angle_deg: float = 1.0
    covariance_mag2: Float = field(default_factory=lambda: np.zeros((3, 3)))
    scatter_mag: float = 0.0
    epoch: str = ""
    sun_magnitude: float | None = None

    def __post_init__(self) -> None:
        for name in ("zero_point_e_s", "field_angle_deg"):
            require_number(getattr(self, name), f"[photometry] {name}", above=0.0)
        for name in ("color_term", "field_term_mag"):
            require_number(getattr(self, name), f"[photometry] {name}")
        require_number(self.scatter_mag, "[photometry] scatter_mag", least=0.0)
        if self.sun_magnitude is not None:
            require_number(self.sun_magnitude, "[photometry] sun_magnitude")
        self._keep(covariance_mag2=as_finite(self.covariance_mag2, (3, 3), "[photometry] covariance_mag2"))

    @classmethod
    def from_aperture(
        cls,
        aperture_m2: float,
        *,
        shortest_um: float = 0.4,
        longest_um: float = 0.9,
        quantum_efficiency: float = 0.5,
        **others: Any,
    ) -> Self:
        r"""Build from the aperture and the efficiency of a camera, by the light of the Sun.

        Parameters
        ----------
        aperture_m2 : float, m^2
        shortest_um, longest_um : float, um; pass band
        quantum_efficiency : float; mean over the pass band, with the transmission of the optics
        **others : other fields

        Raises
        ------
        InputError
            A value is out of range, or the magnitude of the Sun in the band is not known.

        Notes
        -----
        The Sun gives :math:`Q \bar E (\lambda_2^2 - \lambda_1^2) / (2 h c) A` electrons per second. Two slips of the
        paper are left out: its eq. 23 has the mean irradiance twice, and its eq. 21 multiplies by the aperture that
        eqs. 22 and 23 multiply by again.

        References
        ----------
        .. [1] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation (ODIN), eqs. 21-23.
        """
        require_number(aperture_m2, "aperture_m2", above=0.0)
        require_number(shortest_um, "shortest_um", above=0.0)
        require_number(longest_um, "longest_um", above=shortest_um)
        require_number(quantum_efficiency, "quantum_efficiency", above=0.0, most=1.0)
        electrons_per_joule = (longest_um**2 - shortest_um**2) * 1e-6 / (2.0 * _PLANCK_J_S * _LIGHT_M_S)
        sun_e_s = quantum_efficiency * SUN_W_M2_UM * electrons_per_joule * aperture_m2
        star = cls(**others)
        return cls(**others, zero_point_e_s=sun_e_s / star.sun_e_s * star.zero_point_e_s)

    @classmethod
    def from_mapping(cls, table: object) -> Self:
        """Build from the fields in a ``[photometry]`` table.

        ``zero_point_mag``, or ``aperture_m2`` with the other arguments of :meth:`from_aperture`, may take the place of
        ``zero_point_e_s``, and ``sigma_mag`` that of ``covariance_mag2``. Raises InputError where a key is unknown or
        missing, two keys exclude each other, or a value is wrong.
        """
        where, names = "[photometry]", [entry.name for entry in fields(cls)]
        values = dict(checked_table(table, where, dict.fromkeys([*names, *sum(_KEYS.values(), ())])))
        for key, value in values.items():
            good, needs = isinstance(value, int | float) and not isinstance(value, bool), "a number"
            if key in ("band", "epoch"):
                good, needs = isinstance(value, str), "a text"
            require(good or key == "covariance_mag2", f"{where}: {key} must be {needs}, got {value!r}")
        for kind in ("zero point", "sigma"):
            both = [key for key in _KEYS[kind] if key in values]
            require(len(both) < 2, f"{where}: give {' or '.join(both)}, not both")
        lens = {key: values.pop(key) for key in ("aperture_m2", *_KEYS["aperture"]) if key in values}
        orphans = ", ".join(lens)
        require("aperture_m2" in lens or not lens, f"{where}: aperture_m2 is missing, to which {orphans} belongs")
        if "zero_point_mag" in values:
            values["zero_point_e_s"] = 10.0 ** (0.4 * values.pop("zero_point_mag"))
        if "sigma_mag" in values:
            require_number(values["sigma_mag"], f"{where} sigma_mag", least=0.0)
            values["covariance_mag2"] = np.diag([values.pop("sigma_mag") ** 2, 0.0, 0.0])
        return cls.from_aperture(**lens, **values) if lens else cls(**values)

    def to_mapping(self) -> dict[str, Any]:
        """Return the ``[photometry]`` table, without fields that are empty."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        values["covariance_mag2"] = self.covariance_mag2.tolist()
        return {key: value for key, value in values.items() if value not in (None, "")}

    @property
    def zero_point_mag(self) -> float:
        """Magnitude of a star that gives 1 electron per second."""
        return float(2.5 * np.log10(self.zero_point_e_s))

    @property
    def sun_e_s(self) -> float:
        """Electrons per second of the Sun at 1 au; its color is that of the zero point where bodies have their own."""
        sun = SUN_MAGNITUDES.get(self.band) if self.sun_magnitude is None else self.sun_magnitude
        if sun is None:
            raise InputError(
                f"[photometry]: the magnitude of the Sun in band {self.band!r} is not known, only in "
                f"{', '.join(SUN_MAGNITUDES)}: give sun_magnitude"
            )
        return float(self.star_rate_e_s(sun, color_bp_rp=SUN_COLOR_BP_RP))

    def star_rate_e_s(
        self, magnitudes: ArrayLike, *, color_bp_rp: ArrayLike = _REFERENCE_COLOR, angle_rad: ArrayLike = 0.0
    ) -> Float:
        """Signal (...), electron/s, of stars of magnitudes (...).

        ``color_bp_rp`` (...), mag, NaN where unknown: then that of the zero point, 1; ``angle_rad`` (...), rad, from
        the optical axis.
        """
        rows = self.partials(color_bp_rp=color_bp_rp, angle_rad=angle_rad)
        change = rows[..., 1:] @ np.array([self.color_term, self.field_term_mag])
        return np.asarray(self.zero_point_e_s * 10.0 ** (0.4 * (change - as_floats(magnitudes, (), "magnitudes"))))

    def body_rate_e_s(
        self, relative_irradiance: ArrayLike, *, sun_distance_au: ArrayLike = 1.0, angle_rad: ArrayLike = 0.0
    ) -> Float:
        """Signal (...), electron/s, of a body, or of a part of it, that reflects sunlight.

        ``relative_irradiance`` (...): irradiance at the camera over that of the Sun at the body; ``sun_distance_au``
        (...), au, of the body; ``angle_rad`` (...), rad, from the optical axis.
        """
        darker = self.star_rate_e_s(0.0, angle_rad=angle_rad) / self.zero_point_e_s
        light = as_floats(relative_irradiance, (), "relative_irradiance")
        return np.asarray(self.sun_e_s * darker * light / as_floats(sun_distance_au, (), "sun_distance_au") ** 2)

    def surface_rate_e_s(
        self,
        radiance_factor: ArrayLike,
        pixel_sr: ArrayLike,
        *,
        sun_distance_au: ArrayLike = 1.0,
        angle_rad: ArrayLike = 0.0,
    ) -> Float:
        """Signal (...), electron/s, of pixels that see a sunlit surface.

        ``radiance_factor`` (...): I/F, the normal albedo times the reflectance law; ``pixel_sr`` (...), sr, solid angle
        of a pixel; ``sun_distance_au`` (...), au, of the body; ``angle_rad`` (...), rad, from the optical axis.
        """
        light = as_floats(radiance_factor, (), "radiance_factor") * as_floats(pixel_sr, (), "pixel_sr") / np.pi
        return self.body_rate_e_s(light, sun_distance_au=sun_distance_au, angle_rad=angle_rad)

    def disk_rate_e_s(
        self,
        radiance_factor: ArrayLike,
        half_angle_rad: ArrayLike,
        *,
        sun_distance_au: ArrayLike = 1.0,
        angle_rad: ArrayLike = 0.0,
    ) -> Float:
        """Signal (...), electron/s, of a whole body.

        ``radiance_factor`` (...): mean I/F of the disk, lit or not; of a sphere, its normal albedo times
        :func:`giantlike.ray_tracing.disk_integrated`, which is the geometric albedo times the phase function;
        ``half_angle_rad`` (...), rad, apparent angular radius; ``sun_distance_au`` (...), au, of the body;
        ``angle_rad`` (...), rad, from the optical axis.
        """
        light = as_floats(radiance_factor, (), "radiance_factor") * np.sin(half_angle_rad) ** 2
        return self.body_rate_e_s(light, sun_distance_au=sun_distance_au, angle_rad=angle_rad)

    def magnitude(
        self, rate_e_s: ArrayLike, *, color_bp_rp: ArrayLike = SUN_COLOR_BP_RP, angle_rad: ArrayLike = 0.0
    ) -> Float:
        """Magnitude (...) of a source of a known signal (...), electron/s; NaN where the signal is not positive.

        ``color_bp_rp`` (...), mag, by default that of sunlight; ``angle_rad`` (...), rad, from the optical axis.
        """
        rate = as_floats(rate_e_s, (), "rate_e_s")
        ratio = self.star_rate_e_s(0.0, color_bp_rp=color_bp_rp, angle_rad=angle_rad) / np.where(rate > 0, rate, np.nan)
        return np.asarray(2.5 * np.log10(ratio))

    def sigma_mag(self, *, color_bp_rp: ArrayLike = SUN_COLOR_BP_RP, angle_rad: ArrayLike = 0.0) -> Float:
        """Standard deviation (...), mag, of the zero point for a source, by ``covariance_mag2`` alone."""
        rows = self.partials(color_bp_rp=color_bp_rp, angle_rad=angle_rad)
        return np.asarray(np.sqrt(np.einsum("...i,ij,...j", rows, self.covariance_mag2, rows)))

    def partials(self, *, color_bp_rp: ArrayLike, angle_rad: ArrayLike) -> Float:
        """Derivatives (..., 3) of the magnitude of one electron per second by zero point, color term and field term."""
        color = as_floats(color_bp_rp, (), "color_bp_rp") - _REFERENCE_COLOR
        off_axis = as_floats(angle_rad, (), "angle_rad") / np.radians(self.field_angle_deg)
        color, off_axis = np.broadcast_arrays(np.where(np.isnan(color), 0.0, color), off_axis)
        return np.stack([np.ones_like(color), color, off_axis**2], axis=-1)
