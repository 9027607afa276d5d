"""A priori poses of the images of a run, for networks."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.campaign.store.results import RunResult, camera_of_run
from giantlike.core.arrays import require
from giantlike.core.frames import rotate
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.network import Photo
from giantlike.scene import TargetUncertainty


def photos_of_run(run: RunResult, target: str | None = None) -> list[Photo]:
    """Return the a priori poses of the images in which a run looked for a target, for :mod:`giantlike.network`.

    Parameters
    ----------
    run : RunResult
    target : str, optional; may be left out where the run has one

    Returns
    -------
    list of Photo
        In input order; images without an attitude, or whose geometry was not known, are left out. Aberration of the
        camera relative to the body, 1e-5 rad at 3 km/s, is in the orientation of the body.

    Raises
    ------
    InputError
        The run has no such target, or several and no name was given.
    """
    names = list(dict.fromkeys(one.target for one in run.observations))
    require(target in names or (target is None and len(names) == 1), f"target: name one of {', '.join(names)}")
    target, camera, photos = target or names[0], camera_of_run(run.folder), list[Photo]()
    known = {record.file: record for record in run.attitudes}
    for image in run.bodies:
        record = known[image.file]
        sightings = [one for one in image.sightings if one.target == target]
        places = [
            one for one in image.observations if one.target == target and one.predicted_camera_km and one.attitude
        ]
        if not sightings or not places or places[0].attitude is None:
            continue
        sighting, attitude = sightings[0], places[0].attitude
        position_km = np.array(places[0].predicted_camera_km)
        light_time_s = sighting.light_time_s or float(np.linalg.norm(position_km)) / SPEED_OF_LIGHT_KM_S
        declared = TargetUncertainty(
            ephemeris_km=sighting.ephemeris_sigma_km, ephemeris_icrf_km2=sighting.ephemeris_icrf_km2
        ).covariance_ephemeris_km2
        covariance = np.diag([np.inf] * 6)
        if attitude.covariance_rad2 is not None:
            covariance[:3, :3] = attitude.covariance_rad2
        if declared.any():
            covariance[3:, 3:] = declared
        back = attitude.rotation.inv()
        photos.append(
            Photo(
                name=image.file,
                model=camera.model,
                camera_from_inertial=attitude.rotation,
                position_km=-rotate(back, position_km),
                covariance_pose=covariance,
                inertial_from_body=back * Rotation.from_quat(sighting.camera_from_body_xyzw),
                et=(record.et or 0.0) - light_time_s,
                columns=camera.columns,
                rows=camera.rows,
            )
        )
    return photos
