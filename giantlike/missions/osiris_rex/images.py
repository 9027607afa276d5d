"""Exposures of stars and of Bennu by the independent renderer, and what is declared to navigation beforehand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.catalogs import MemoryCatalog, load_catalog
from giantlike.core.arrays import Float, unit
from giantlike.core.frames import camera_from_inertial_of_pointing, direction_from_radec, radec_from_direction, rotate
from giantlike.core.time import time_from_et
from giantlike.core.units import AU_KM, RAD_PER_ARCSEC, RAD_PER_DEG, SECONDS_PER_DAY
from giantlike.core.values import Value
from giantlike.gauntlet.stage import catalog_of
from giantlike.independent import (
    Body,
    EllipsoidBody,
    Motion,
    Pose,
    Psf,
    Recorder,
    ReliefBody,
    Sampling,
    StarField,
    apparent_geometry,
    random_stars,
    record,
    render_body,
    star_image,
)
from giantlike.independent.laws import Law, hapke
from giantlike.independent.sky import DECADE_PER_MAGNITUDE
from giantlike.io import navigation_header
from giantlike.io.decoded import HeaderValue
from giantlike.io.geometry_table import GeometryRow
from giantlike.missions.osiris_rex.setup import CameraSetup, MissionSetup, PhaseSetup, mission
from giantlike.missions.osiris_rex.trajectory import Flight

TARGET = "BENNU"
DEEPEST_DEFAULT = 10.0
"""Faintest magnitude that the default catalog reaches; a camera that sees fainter stars gets a made-up sky."""
_STARS_PER_DEG2 = 11.7  # stars down to magnitude 10 in a square degree: 482,000 of the default catalog over the sky
_BRIGHTEST = 5.0  # magnitude of the brightest star of a made-up sky, of which there is one in 30 square degrees
BEYOND_LIMIT = 0.5
"""Magnitudes by which the sky of images is deeper than the stars used: fainter light is in images too [assumed]."""
_SKY_MARGIN = 1.3
"""Radius of a made-up sky around an image, / half the diagonal of the frame: margin for errors of the pointing."""
_SUN_MAGNITUDE = -26.74  # of the Sun at 1 au, V: 2.5 log10 of the ratio to the zero point
_PEAK_OF_FULL_SCALE = 0.7
"""Signal of the brightest pixel of Bennu in short exposures, as a fraction of full scale above bias [assumed]."""
_SHORTEST_S = 1e-4  # shortest exposure, s [assumed]
_USED_PART = 0.6  # fraction of the free half frame over which Bennu is placed [assumed]
_MARGIN_PX = 30.0  # distance that Bennu keeps from the edge of the frame where it fits, px [assumed]
_LARGE_PX = 200.0
"""Apparent diameter from which two cells along the side of a pixel are enough: its edges get eight rays."""
_SATURATED = Sampling(cells=1, edge_rays=2)
"""Rays of Bennu in star images, where it is saturated: the ellipsoid that its relief lies on."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exposure(Value):
    """An exposure as it was made."""

    name: str
    et: float
    exposure_s: float  # 0 where it follows from the brightness of Bennu
    camera_from_inertial: Rotation
    state_km: Float  # (6,), km and km/s, ICRF axes; of the spacecraft from Bennu
    rate_rad_s: Float  # (3,), camera axes


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Taker(Value):
    """A camera that takes images: optics of Table 1, detector with uneven response and hot pixels, sky and Bennu."""

    key: str
    catalog: MemoryCatalog
    body: ReliefBody | None
    seed: int

    @property
    def mission(self) -> MissionSetup:
        """The mission, read anew in each process."""
        return mission()

    @property
    def setup(self) -> CameraSetup:
        """The camera."""
        return mission().cameras[self.key]

    @cached_property
    def _fixed_pattern(self) -> tuple[Float, Float]:
        """Response, and signal of hot pixels in DN/s, each (rows, columns)."""
        detector, shape = self.mission.detector, (self.setup.rows, self.setup.columns)
        rng = np.random.default_rng([self.seed, 11, self.setup.columns])
        hot = np.zeros(shape)
        places = rng.integers(shape, size=(detector.hot_pixels, 2))
        hot[tuple(places.T)] = rng.exponential(detector.hot_pixel_e_s, detector.hot_pixels) / detector.gain_e_per_dn
        return 1.0 + detector.response_rms * rng.standard_normal(shape), hot

    def take(
        self, exposure: Exposure, seed: Sequence[int], temperature_c: float = 0.0
    ) -> tuple[NDArray[np.uint16], float]:
        """Take an image: pixels (rows, columns), DN, and the exposure time, s."""
        orex, setup, detector = self.mission, self.setup, self.mission.detector
        view = setup.view(temperature_c)
        body_km, body_km_s = orex.orbit.state(exposure.et)
        velocity = body_km_s + exposure.state_km[3:]
        psf, seconds = Psf(sigma_px=detector.psf_sigma_px), exposure.exposure_s
        light = np.zeros((setup.rows, setup.columns))
        if self.body is not None:
            axes = exposure.camera_from_inertial
            range_km = float(np.linalg.norm(exposure.state_km[:3]))
            emitted = exposure.et - range_km / 299_792.458
            pose = Pose(
                position_camera_km=axes.apply(-exposure.state_km[:3]),
                camera_from_body=axes * orex.orbit.inertial_from_body(emitted),
                sun_direction_camera=axes.apply(-unit(body_km)),
                motion=Motion(axes.apply(velocity), axes.apply(body_km_s)),
            )
            law: Law = partial(hapke, **orex.body.law)
            scale = float(law(np.ones(1), np.ones(1), np.ones(1))[0])
            across_px = 2.0 * orex.body.mean_radius_km * view.focal_px / range_km
            large = Sampling(cells=2, edge_rays=4) if across_px > _LARGE_PX else None
            body: Body = EllipsoidBody(self.body.radii_km) if seconds else self.body
            light = render_body(
                body, view, pose, law=law, peak_dn=None, psf=psf, sampling=_SATURATED if seconds else large
            )
            # Flux of the body over that of the Sun: geometric albedo times solid angle over pi.
            albedo = orex.body.radiance_factor / (scale * math.pi * view.focal_px**2 * view.aspect)
            sun_e_s = setup.zero_point_e_s * 10.0 ** (-0.4 * _SUN_MAGNITUDE) * (AU_KM / np.linalg.norm(body_km)) ** 2
            light *= albedo * sun_e_s / detector.gain_e_per_dn
            wanted = _PEAK_OF_FULL_SCALE * (detector.saturation_dn - detector.bias_dn)
            seconds = seconds or float(f"{min(max(wanted / light.max(), _SHORTEST_S), setup.longest_short_s):.3g}")
        axis = rotate(exposure.camera_from_inertial.inv(), np.array([0.0, 0.0, 1.0]))
        stars, _ = star_image(
            self._stars(axis, exposure.et, body_km + exposure.state_km[:3]),
            view,
            exposure.camera_from_inertial,
            observer_velocity_km_s=velocity,
            psf=dataclasses.replace(psf, motion_px=self._motion_px(exposure.rate_rad_s * seconds, view.focal_px)),
            zero_point_dn=setup.zero_point_e_s * seconds / detector.gain_e_per_dn,
        )
        response, hot = self._fixed_pattern
        recorder = Recorder(
            gain_e_per_dn=detector.gain_e_per_dn,
            read_noise_e=detector.read_noise_e,
            bias_dn=detector.bias_dn,
            saturation_dn=detector.saturation_dn,
        )
        signal = (light * seconds + stars) * response + hot * seconds
        pixels = record(signal, np.random.default_rng(list(seed)), recorder).pixels
        return pixels.astype(np.uint16), seconds

    @staticmethod
    def _motion_px(turn_rad: Float, focal_px: float) -> tuple[float, float]:
        """Path of stars by a small rotation of the camera, px."""
        return float(-turn_rad[1] * focal_px), float(turn_rad[0] * focal_px)

    def _stars(self, axis: Float, et: float, observer_km: Float) -> StarField:
        """Stars around an axis, moved by proper motion and parallax, without aberration."""
        limit = self.mission.max_magnitude(self.setup.key) + BEYOND_LIMIT
        stars = self.catalog.cone(
            axis, _SKY_MARGIN * self.mission.half_diagonal_rad(self.setup.key), max_magnitude=limit
        )
        years = et / (365.25 * SECONDS_PER_DAY) + 2000.0 - stars.epoch_jyear
        directions = direction_from_radec(stars.ra_deg, stars.dec_deg)
        east = unit(np.cross([0.0, 0.0, 1.0], directions))
        mas = 1e-3 * RAD_PER_ARCSEC
        moved = (
            stars.pm_ra_mas_yr[:, None] * east + stars.pm_dec_mas_yr[:, None] * np.cross(directions, east)
        ) * years[:, None]
        apart = np.nan_to_num(stars.parallax_mas)[:, None] * observer_km / AU_KM
        return StarField(directions=unit(directions + mas * (np.nan_to_num(moved) - apart)), magnitudes=stars.magnitude)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Planner(Value):
    """Plan of the images of one camera in one phase: pairs of a long exposure for the stars and a short one."""

    mission: MissionSetup
    setup: CameraSetup
    phase: PhaseSetup
    reach_km: float
    seed: int

    def exposures(self, et: float, flight: Flight) -> tuple[Exposure, Exposure]:
        """Long and short exposure at a time; Bennu is at a random position in the frame, rotated at random."""
        pointing, rng = self.mission.pointing, self._rng(et)
        rate = pointing.rate_arcsec_s * RAD_PER_ARCSEC * unit(rng.normal(size=3))
        short = Exposure(
            name=f"{self.setup.key}_{time_from_et(et).utc.strftime('%m%d_%H%M')}_short.fits",
            et=et,
            exposure_s=0.0,
            camera_from_inertial=self._attitude(et, flight.states[et], rng),
            state_km=flight.states[et],
            rate_rad_s=rate,
        )
        back = Rotation.from_rotvec(pointing.pair_gap_s * rate)  # takes the short exposure's axes to the long one's
        jitter = pointing.jitter_arcsec_per_sqrt_s * math.sqrt(pointing.pair_gap_s) * rng.normal(size=3)
        before = et - pointing.pair_gap_s
        return dataclasses.replace(
            short,
            name=short.name.replace("short", "long"),
            et=before,
            exposure_s=self.setup.long_exposure_s,
            camera_from_inertial=Rotation.from_rotvec(jitter * RAD_PER_ARCSEC) * back * short.camera_from_inertial,
            state_km=flight.states[before],
        ), short

    def predict(self, pair: Sequence[Exposure]) -> Iterator[tuple[GeometryRow, dict[str, HeaderValue]]]:
        """What navigation gets of a pair beforehand, by earlier fits [assumed]: row of geometry and header."""
        long, short = pair
        pointing, rng = self.mission.pointing, self._rng(short.et + 1.0)
        away, focal_px = unit(short.state_km[:3]), self.setup.model.focal_length_px
        range_km = float(np.linalg.norm(short.state_km[:3]))
        across = rng.normal(size=3) * self.phase.position_error_px / focal_px
        across -= away * float(across @ away)
        error_km = range_km * (across + self.phase.range_error * rng.normal() * away)
        wrong = Rotation.from_rotvec(pointing.attitude_error_deg * RAD_PER_DEG * rng.normal(size=3))
        back = Rotation.from_rotvec(pointing.pair_gap_s * short.rate_rad_s)
        meridian = Rotation.from_rotvec([0.0, 0.0, self.phase.model.meridian_deg * RAD_PER_DEG])
        orbit = self.mission.orbit
        for each, turn in ((long, back), (short, Rotation.identity())):
            body_km, body_km_s = orbit.state(each.et)
            observer_km, velocity = body_km + each.state_km[:3] - error_km, body_km_s + each.state_km[3:]
            seen, emitted = apparent_geometry(lambda et: orbit.state(et)[0], observer_km, velocity, each.et)
            row = GeometryRow(
                file=each.name,
                camera_from_inertial=wrong * turn * short.camera_from_inertial,
                target=TARGET,
                target_position_inertial_km=seen * (each.et - emitted) * 299_792.458,
                body_from_inertial=(orbit.inertial_from_body(emitted) * meridian).inv(),
                sun_direction_inertial=-unit(body_km),
                target_velocity_inertial_km_s=body_km_s,
            )
            yield (
                row,
                navigation_header(
                    epoch=time_from_et(each.et),
                    exposure_s=each.exposure_s,
                    observer_position_km=observer_km,
                    observer_velocity_km_s=velocity,
                ),
            )

    def _rng(self, et: float) -> np.random.Generator:
        return np.random.default_rng([self.seed, 10, self.setup.columns, int(et)])

    def _attitude(self, et: float, state_km: Float, rng: np.random.Generator) -> Rotation:
        body_km, body_km_s = self.mission.orbit.state(et)
        seen, _ = apparent_geometry(
            lambda when: self.mission.orbit.state(when)[0], body_km + state_km[:3], body_km_s + state_km[3:], et
        )
        model, setup = self.setup.model, self.setup
        reach_px = model.focal_length_px * self.reach_km / float(np.linalg.norm(state_km[:3]))
        free_px = max(min(setup.columns, setup.rows) / 2.0 - reach_px - _MARGIN_PX, 0.0)
        middle = np.array([setup.columns - 1, setup.rows - 1]) / 2.0
        place_px = middle + _USED_PART * free_px * rng.uniform(-1.0, 1.0, 2)
        ra_deg, dec_deg = radec_from_direction(seen)
        at_boresight = camera_from_inertial_of_pointing(float(ra_deg), float(dec_deg), rng.uniform(0.0, 360.0))
        onto, _ = Rotation.align_vectors(unit(setup.view().directions(place_px))[None], np.array([[0.0, 0.0, 1.0]]))
        return onto * at_boresight


def sky_for(mission: MissionSetup, key: str, attitudes: Sequence[Rotation], *, seed: int) -> MemoryCatalog:
    """Return the stars that a camera sees: the default catalog, or where it is not deep enough a made-up sky."""
    if mission.max_magnitude(key) <= DEEPEST_DEFAULT:
        return load_catalog("default")
    limit = mission.max_magnitude(key) + BEYOND_LIMIT
    radius_rad = _SKY_MARGIN * mission.half_diagonal_rad(key)
    density = _STARS_PER_DEG2 * 10.0 ** (DECADE_PER_MAGNITUDE * (limit - DEEPEST_DEFAULT))
    count = round(density * math.pi * math.degrees(radius_rad) ** 2)
    rng = np.random.default_rng([seed, 12])
    made: list[StarField] = []
    axes: list[Float] = []
    for attitude in attitudes:
        axis = rotate(attitude.inv(), np.array([0.0, 0.0, 1.0]))
        field = random_stars(rng, count, axis=axis, radius_rad=radius_rad, magnitudes=(_BRIGHTEST, limit))
        new = np.ones(count, dtype=bool)
        for other in axes:  # whose stars are there already
            new &= field.directions @ other < math.cos(radius_rad)
        made.append(StarField(directions=field.directions[new], magnitudes=field.magnitudes[new]))
        axes.append(axis)
    return catalog_of(
        StarField(
            directions=np.concatenate([each.directions for each in made]),
            magnitudes=np.concatenate([each.magnitudes for each in made]),
        )
    )
