"""Rich star fields with truth, for the benchmarks of speed: not a benchmark itself.

Stars and their images come from ``giantlike.independent``. The camera sees fainter stars than the catalog holds, as
real ones do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.catalogs import MemoryCatalog, StarCatalog, apparent_directions
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.time import time_from_et
from giantlike.gauntlet.stage import catalog_of
from giantlike.image import Image, ObserverState
from giantlike.independent import PinholeView, Recorder, StarField, background, random_stars, record, star_image

SIZE, FOCAL_PX = 1024, 5000.0
VIEW = PinholeView(FOCAL_PX, (513.0, 509.0), SIZE, SIZE)
EPOCH = time_from_et(5.05e8)  # 2016.0, the epoch of the catalog
READ_NOISE_DN, LEVEL_DN = 5.0, 50.0
FAINTEST = 9.8  # mag of a star at the detection limit, 5 sigma
UNKNOWN_MAGNITUDES = 0.6  # by which the catalog ends before: it then holds half of the stars seen
SPARE = 1.9  # stars of the cap over those in the frame
CAMERA = Camera(
    name="rich",
    columns=SIZE,
    rows=SIZE,
    model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=VIEW.center_px[0], cy_px=VIEW.center_px[1]),
    psf=GaussianPsf(sigma_px=0.7),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=READ_NOISE_DN),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class RichField:
    """An image of many stars, the catalog that knows some of them, and the true attitude."""

    image: Image
    catalog: MemoryCatalog
    attitude: Rotation
    places_px: Float


def rich_field(seed: int, stars: int = 2000) -> RichField:
    """Draw a new sky, attitude and noise; some ``stars`` lie in the frame above the detection limit."""
    rng = np.random.default_rng([seed, stars, 13])
    attitude = Rotation.random(rng=rng)
    axis = attitude.inv().as_matrix()[:, 2]
    reach = 1.1 * math.atan(SIZE / FOCAL_PX / math.sqrt(2.0))
    field = random_stars(rng, math.ceil(SPARE * stars), axis=axis, radius_rad=reach, magnitudes=(2.0, FAINTEST))
    signal, places = star_image(field, VIEW, attitude)
    shot = record(signal + background(signal.shape, constant_dn=LEVEL_DN), rng, Recorder(read_noise_e=READ_NOISE_DN))
    known = field.magnitudes <= FAINTEST - UNKNOWN_MAGNITUDES
    image = Image(
        pixels=np.clip(shot.pixels, 0, 65535).astype(np.uint16),
        epoch=EPOCH,
        camera_from_inertial=Rotation.from_rotvec(np.radians(0.05) * rng.normal(size=3)) * attitude,
        observer=ObserverState(position_km=np.array([1e15, 0.0, 0.0]), velocity_km_s=np.zeros(3)),
        name=f"{stars} stars, seed {seed}",
    )
    catalog = catalog_of(StarField(directions=field.directions[known], magnitudes=field.magnitudes[known]))
    return RichField(image=image, catalog=catalog, attitude=attitude, places_px=places[np.isfinite(places).all(axis=1)])


def real_field(seed: int, catalog: StarCatalog) -> tuple[Image, Rotation]:
    """Draw an image of the stars of a catalog in a random direction, without an a priori attitude."""
    rng = np.random.default_rng([seed, 17])
    attitude = Rotation.random(rng=rng)
    stars = catalog.cone(attitude.inv().as_matrix()[:, 2], 0.2)
    field = StarField(directions=apparent_directions(stars, 5.05e8), magnitudes=stars.magnitude)
    signal, _ = star_image(field, VIEW, attitude)
    shot = record(signal + background(signal.shape, constant_dn=LEVEL_DN), rng, Recorder(read_noise_e=READ_NOISE_DN))
    return Image(pixels=np.clip(shot.pixels, 0, 65535).astype(np.uint16), epoch=EPOCH, name=f"real {seed}"), attitude
