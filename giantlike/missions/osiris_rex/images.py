"""Pairs of a long exposure for the stars and a short one for Bennu: with their truth and the declared values."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.catalogs import MemoryCatalog
from giantlike.core.arrays import Float, unit
from giantlike.core.frames import camera_from_inertial_of_pointing, radec_from_direction, rotate
from giantlike.core.time import time_from_et
from giantlike.core.units import RAD_PER_ARCSEC, RAD_PER_DEG
from giantlike.core.values import Value
from giantlike.ephemeris import ApparentGeometry, FixedEphemeris
from giantlike.gauntlet.stage import catalog_of
from giantlike.image import ObserverState
from giantlike.independent import random_stars
from giantlike.independent.sky import DECADE_PER_MAGNITUDE, StarField
from giantlike.missions.osiris_rex.setup import CameraSetup, MissionSetup, PhaseSetup
from giantlike.missions.osiris_rex.trajectory import BennuVisit, VisitedBody
from giantlike.ray_tracing import reflectance_from_mapping
from giantlike.scene import Scene, Target
from giantlike.shapes import TriangleMesh
from giantlike.simulation import Shot
from giantlike.simulation.approach import ApproachFrame
from giantlike.simulation.detector import DetectorModel, HotPixels
from giantlike.simulation.effects import FlatField
from giantlike.simulation.incident import visible_peak
from giantlike.simulation.shot import Photometry, make_black_image

TARGET = "BENNU"
DEEPEST_DEFAULT = 10.0
"""Faintest magnitude that the default catalog reaches; a camera that sees fainter stars gets a made-up sky."""
_STARS_PER_DEG2 = 11.7
"""Stars down to magnitude 10 in a square degree: 482,000 of the default catalog over the sky."""
_BRIGHTEST = 5.0
"""Magnitude of the brightest star of a made-up sky, of which there is one in 30 square degrees."""
BEYOND_LIMIT = 0.5
"""Magnitudes by which the sky of images is deeper than the stars used: fainter light is in images too [assumed]."""
_SKY_MARGIN = 1.3
"""Radius of a made-up sky around an image, / half the diagonal of the frame: margin for errors of the pointing."""
_PEAK_OF_FULL_SCALE = 0.7
"""Signal of the brightest pixel of Bennu in short exposures, as a fraction of full scale above bias [assumed]."""
_SHORTEST_S = 1e-4
"""Shortest exposure, s [assumed]."""
_USED_PART = 0.6
"""Fraction of the free half frame over which Bennu is placed [assumed]."""
_MARGIN_PX = 30.0
"""Distance that Bennu keeps from the edge of the frame where it fits, px [assumed]."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Planner(Value):
    """Plan of the images of one camera in one phase.

    camera: the true one.
    """

    mission: MissionSetup
    setup: CameraSetup
    camera: Camera
    truth: TriangleMesh
    phase: PhaseSetup
    seed: int

    @property
    def photometry(self) -> Photometry:
        """Brightness of stars and of Bennu."""
        return Photometry(
            zero_point_e_s=self.setup.zero_point_e_s, albedo=self.mission.body.radiance_factor, sun_distance_au=1.0
        )

    def frames(self, visits: Sequence[BennuVisit]) -> Iterator[ApproachFrame]:
        """Yield a long and a short exposure of each visit."""
        for number, visit in enumerate(visits):
            yield from self._pair(number, visit, np.random.default_rng([self.seed, 10, number]))

    def _pair(self, number: int, visit: BennuVisit, rng: np.random.Generator) -> Iterator[ApproachFrame]:
        mission, pointing = self.mission, self.mission.pointing
        body = VisitedBody(orbit=mission.orbit, visit=visit)
        law = reflectance_from_mapping(dict(mission.body.law))
        target = Target(name=TARGET, shape=self.truth, ephemeris=body, reflectance=law)
        scene = Scene(targets=(target,), light=FixedEphemeris())
        rate = pointing.rate_arcsec_s * RAD_PER_ARCSEC * unit(rng.normal(size=3))
        short = Shot(
            name=f"{self.setup.key}_{number + 1:02d}_short.fits",
            epoch=time_from_et(visit.et),
            exposure_s=self.setup.longest_short_s,
            camera_from_inertial=Rotation.identity(),
            observer=_observer(visit, body, visit.et),
            angular_rate_camera_rad_s=rate,
        )
        short = dataclasses.replace(short, camera_from_inertial=self._attitude(short, scene, rng))
        short = dataclasses.replace(short, exposure_s=self._short_exposure_s(short, scene))
        back = Rotation.from_rotvec(pointing.pair_gap_s * rate)  # takes the short exposure's axes to the long one's
        jitter = pointing.jitter_arcsec_per_sqrt_s * math.sqrt(pointing.pair_gap_s) * rng.normal(size=3)
        long = dataclasses.replace(
            short,
            name=short.name.replace("short", "long"),
            epoch=time_from_et(visit.et - pointing.pair_gap_s),
            exposure_s=self.setup.long_exposure_s,
            camera_from_inertial=Rotation.from_rotvec(jitter * RAD_PER_ARCSEC) * back * short.camera_from_inertial,
            observer=_observer(visit, body, visit.et - pointing.pair_gap_s),
        )
        wrong = Rotation.from_rotvec(pointing.attitude_error_deg * RAD_PER_DEG * rng.normal(size=3))
        error_km = self._position_error_km(short, scene, rng)
        for shot, turn in ((long, back * short.camera_from_inertial), (short, short.camera_from_inertial)):
            yield self._frame(shot, scene, wrong * turn, error_km, (self.seed, int(rng.integers(2**31))))

    def _frame(
        self, shot: Shot, scene: Scene, apriori: Rotation, error_km: Float, seed: tuple[int, int]
    ) -> ApproachFrame:
        """An exposure with its declared values: position, attitude and prime meridian in error."""
        apparent, observer = apparent_of(scene, shot, self.camera), shot.observer
        body = scene.target(TARGET).ephemeris
        assert observer is not None
        assert isinstance(body, VisitedBody)
        meridian = Rotation.from_rotvec([0.0, 0.0, self.phase.model.meridian_deg * RAD_PER_DEG])
        return ApproachFrame(
            shot=shot,
            scene=scene,
            target=TARGET,
            star_image=shot.exposure_s == self.setup.long_exposure_s,
            seed=seed,
            apriori_camera_from_inertial=apriori,
            apriori_observer=dataclasses.replace(observer, position_km=observer.position_km - error_km),
            apriori_geometry=dataclasses.replace(
                apparent,
                position_inertial_km=apparent.position_inertial_km + error_km,
                inertial_from_body=apparent.inertial_from_body * meridian,
                velocity_inertial_km_s=body.state(body.visit.et)[1],
            ),
        )

    def _attitude(self, shot: Shot, scene: Scene, rng: np.random.Generator) -> Rotation:
        """Attitude that shows Bennu at a random position in the frame, rotated at random about the boresight."""
        vector_km = apparent_of(scene, shot, self.camera).position_inertial_km
        range_km = float(np.linalg.norm(vector_km))
        reach_px = self.camera.model.focal_length_px * self.truth.circumscribing_radius_km / range_km
        free_px = max(min(self.camera.columns, self.camera.rows) / 2.0 - reach_px - _MARGIN_PX, 0.0)
        place_px = self.camera.center_px + _USED_PART * free_px * rng.uniform(-1.0, 1.0, 2)
        ra_deg, dec_deg = radec_from_direction(vector_km)
        at_boresight = camera_from_inertial_of_pointing(float(ra_deg), float(dec_deg), rng.uniform(0.0, 360.0))
        onto, _ = Rotation.align_vectors(self.camera.model.unproject(place_px)[None], np.array([[0.0, 0.0, 1.0]]))
        return onto * at_boresight

    def _short_exposure_s(self, shot: Shot, scene: Scene) -> float:
        """Exposure that brings the brightest pixel of Bennu to the wanted part of full scale, s."""
        detector = self.camera.detector
        wanted_e = _PEAK_OF_FULL_SCALE * (detector.saturation_dn - detector.bias_dn) * detector.gain_e_per_dn
        rate_e_s = visible_peak(shot, self.camera, scene, TARGET) * self.photometry.surface_rate_e_s(self.camera)
        return float(f"{min(max(wanted_e / rate_e_s, _SHORTEST_S), self.setup.longest_short_s):.3g}")

    def _position_error_km(self, shot: Shot, scene: Scene, rng: np.random.Generator) -> Float:
        """Error (3,) of the predicted vector from camera to Bennu, km, inertial axes."""
        vector_km = apparent_of(scene, shot, self.camera).position_inertial_km
        range_km, away = float(np.linalg.norm(vector_km)), unit(vector_km)
        across = rng.normal(size=3) * self.phase.position_error_px / self.camera.model.focal_length_px
        across -= away * float(across @ away)
        return range_km * (across + self.phase.range_error * rng.normal() * away)


def detector_model(mission: MissionSetup, setup: CameraSetup, *, seed: int) -> DetectorModel:
    """Return the detector of a camera with its uneven response and hot pixels."""
    rng = np.random.default_rng([seed, 11, setup.columns])
    response = 1.0 + mission.detector.response_rms * rng.standard_normal((setup.rows, setup.columns))
    hot = HotPixels.draw(
        mission.detector.hot_pixels, setup.columns, setup.rows, rng, median_e_s=mission.detector.hot_pixel_e_s
    )
    return DetectorModel(flat=FlatField(response=response), hot_pixels=hot, bits=12)


def apparent_of(scene: Scene, shot: Shot, camera: Camera) -> ApparentGeometry:
    """Apparent geometry of Bennu in an exposure, inertial axes."""
    apparent = scene.apparent(make_black_image(shot, camera), scene.target(TARGET))
    assert isinstance(apparent, ApparentGeometry)
    return apparent


def _observer(visit: BennuVisit, body: VisitedBody, et: float) -> ObserverState:
    position, velocity = body.state(et)
    away_km = visit.from_body_km + (et - visit.et) * visit.velocity_km_s
    return ObserverState(position_km=position + away_km, velocity_km_s=velocity + visit.velocity_km_s)


def sky_for(mission: MissionSetup, key: str, attitudes: Sequence[Rotation], *, seed: int) -> MemoryCatalog | None:
    """Make up the stars that a camera sees where the default catalog is not deep enough.

    Returns None where the default catalog serves.
    """
    if mission.max_magnitude(key) <= DEEPEST_DEFAULT:
        return None
    limit = mission.max_magnitude(key) + BEYOND_LIMIT
    radius_rad = _SKY_MARGIN * mission.true_camera(key).half_diagonal_rad
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
