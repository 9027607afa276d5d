"""Images that may be taken: from a table of geometry, or at epochs of a window with the camera pointed at a body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float, require, require_number, unit
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import camera_from_inertial_of_pointing, radec_from_direction, rotate, turn_between
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.time import time_from_et
from giantlike.core.values import Value
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image, ObserverState
from giantlike.io.geometry_table import GeometryTable
from giantlike.scene import Scene
from giantlike.simulation import Shot

if TYPE_CHECKING:
    from astropy.time import Time

_NO_PIXELS = np.zeros((1, 1), np.uint16)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate(Value):
    """An image that may be taken.

    Parameters
    ----------
    name : str; file of the image
    epoch : astropy Time, optional; mid-exposure
    exposure_s : float, s, optional; exposure time; by default the best of the ``exposures_s`` of the plan
    camera_from_inertial : Rotation, optional; attitude
    observer : ObserverState, optional; spacecraft, with respect to the solar system barycenter
    angular_rate_camera_rad_s : (3,) float64, rad/s, camera axes; angular velocity of the camera
    places : mapping of str to ApparentGeometry; geometry of targets, in place of their ephemerides in the scene
    failure : Failure, optional; reason for which there is no geometry

    Raises
    ------
    InputError
        The exposure time is not positive and finite.
    """

    name: str
    epoch: Time | None = None
    exposure_s: float | None = None
    camera_from_inertial: Rotation | None = None
    observer: ObserverState | None = None
    angular_rate_camera_rad_s: Float = field(default_factory=lambda: np.zeros(3))
    places: Mapping[str, ApparentGeometry] = field(default_factory=dict)
    failure: Failure | None = None

    def __post_init__(self) -> None:
        if self.exposure_s is not None:
            require_number(self.exposure_s, f"{self.name}: exposure_s", above=0.0)
        Value.__post_init__(self)

    def image(self, exposure_s: float | None = None, pixels: NDArray[Any] = _NO_PIXELS) -> Image:
        """Return an image with the epoch and the pose of the candidate; by default of one black pixel.

        ``exposure_s`` is that of the candidate by default; ``pixels`` (rows, columns), DN.
        """
        return Image(
            pixels=pixels,
            name=self.name,
            epoch=self.epoch,
            exposure_s=self.exposure_s if exposure_s is None else exposure_s,
            camera_from_inertial=self.camera_from_inertial,
            observer=self.observer,
        )

    def shot(self, exposure_s: float) -> Shot:
        """Return the exposure to simulate; InputError where the candidate has no epoch or attitude."""
        if self.epoch is None or self.camera_from_inertial is None:
            raise InputError(f"{self.name}: an exposure needs an epoch and an attitude")
        return Shot(
            name=self.name,
            epoch=self.epoch,
            exposure_s=exposure_s,
            camera_from_inertial=self.camera_from_inertial,
            observer=self.observer,
            angular_rate_camera_rad_s=self.angular_rate_camera_rad_s,
        )

    def scene(self, scene: Scene) -> Scene:
        """Return a scene with the geometry of this candidate; the same scene where the candidate has no places."""
        if not self.places:
            return scene
        return replace(
            scene,
            targets=tuple(
                replace(body, ephemeris=self.places.get(body.name, body.ephemeris)) for body in scene.targets
            ),
        )


def candidates_from_table(table: GeometryTable) -> list[Candidate]:
    """Return the images of a geometry table.

    Parameters
    ----------
    table : GeometryTable; from :func:`~giantlike.io.geometry_table.read_geometry`

    Returns
    -------
    list of Candidate
        One a file, in the order of the table; those without an attitude have a failure.

    Raises
    ------
    InputError
        An exposure time is not positive.
    """
    candidates = []
    for name in dict.fromkeys(row.file for row in table.rows):
        known = table.image(name)
        assert known is not None
        missing = [
            text
            for text, value in (("an epoch", known.epoch), ("an attitude", known.camera_from_inertial))
            if value is None
        ]
        places = {
            body: ApparentGeometry(
                position_inertial_km=row.target_position_inertial_km,
                inertial_from_body=row.body_from_inertial.inv() if row.body_from_inertial else Rotation.identity(),
                sun_direction_inertial=row.sun_direction_inertial,
                velocity_inertial_km_s=row.target_velocity_inertial_km_s,
            )
            for body, row in known.targets.items()
            if row.target_position_inertial_km is not None
        }
        candidates.append(
            Candidate(
                name=name,
                epoch=known.epoch,
                exposure_s=known.exposure_s,
                camera_from_inertial=known.camera_from_inertial,
                observer=known.observer,
                places=places,
                failure=Failure(Reason.NO_GEOMETRY, f"{name}: {table.path.name} lacks {' and '.join(missing)} of it")
                if missing
                else None,
            )
        )
    return candidates


def candidates_in_window(
    epochs_et: Sequence[float],
    camera: Camera,
    scene: Scene,
    *,
    target: str | None = None,
    at_px: tuple[float, float] | None = None,
    roll_deg: float = 0.0,
    exposure_s: float | None = None,
    prefix: str = "image",
) -> list[Candidate]:
    """Return images at given epochs, with the camera pointed so that a body is at a given pixel.

    Parameters
    ----------
    epochs_et : sequence of float, TDB seconds past J2000; mid-exposures
    camera : Camera
    scene : Scene; with an observer and geometric ephemerides, such as :class:`~giantlike.ephemeris.SpiceEphemeris`
    target : str, optional; body that the camera points at; may be left out when there is only one
    at_px : (float, float), px, optional; pixel of its center; by default that of the image
    roll_deg : float, deg; position angle of up in the image, before the body leaves the boresight
    exposure_s : float, s, optional; exposure time
    prefix : str; beginning of the names

    Returns
    -------
    list of Candidate
        Those whose epoch the ephemerides do not cover have a failure. The attitude is fixed in inertial axes during
        an exposure.

    Raises
    ------
    InputError
        The scene has no observer, or no such target.
    """
    body, observer = scene.target(target), scene.observer
    require(observer is not None, "images of a window need the ephemeris of the spacecraft: give the scene an observer")
    assert observer is not None
    sight = camera.model.unproject(np.array(camera.center_px if at_px is None else at_px))
    require(bool(np.isfinite(sight).all()), f"at_px: the camera sees nothing at {at_px}")
    digits, candidates = len(str(len(epochs_et))), []
    for number, et in enumerate(epochs_et, start=1):
        plain = Candidate(
            name=f"{prefix}_{number:0{digits}d}.fits", epoch=time_from_et(float(et)), exposure_s=exposure_s
        )
        try:
            position, velocity = observer.state(float(et))
            seen = scene.apparent(plain.image(), body)
        except (InputError, DataError) as error:
            candidates.append(replace(plain, failure=Failure(Reason.NO_GEOMETRY, f"{plain.name}: {error}")))
            continue
        if isinstance(seen, Failure):
            candidates.append(replace(plain, failure=seen))
            continue
        direction = unit(seen.position_inertial_km)
        ra_deg, dec_deg = radec_from_direction(direction)
        centered = camera_from_inertial_of_pointing(float(ra_deg), float(dec_deg), roll_deg)
        turn = turn_between(rotate(centered, direction), unit(sight))
        state = ObserverState(position_km=position, velocity_km_s=velocity)
        candidates.append(replace(plain, camera_from_inertial=turn * centered, observer=state))
    return candidates
