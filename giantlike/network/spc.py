"""Files of stereophotoclinometry (SPC): SUMFILEs and LMK files as networks, and networks as such files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import make_folder
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, require, require_number, unit
from giantlike.core.errors import DataError
from giantlike.core.frames import rotate
from giantlike.core.time import et_from_time, time_from_et
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.io.spc_geometry import read_sumfile_camera
from giantlike.io.spc_lmk import Lmk, read_lmks, write_lmk
from giantlike.io.spc_sumfile import Sumfile, read_sumfile, write_sumfile
from giantlike.network.photos import Photo, Tracks
from giantlike.network.result import NetworkFix
from giantlike.shapes.landmarks import LandmarkCatalog

_PIXELS_PER_MM = 100.0  # of the focal plane of a file: only focal length times pitch matters
_LARGEST_DN = 65535


def read_spc(
    sumfiles: str | Path, lmkfiles: str | Path | None = None, *, sigma_px: float = 0.5
) -> tuple[list[Photo], Tracks]:
    """Read SUMFILEs, with the LMK files of their landmarks where there are any.

    Parameters
    ----------
    sumfiles : path-like; folder of ``*.SUM``
    lmkfiles : path-like, optional; folder of ``*.LMK``; places in images have to be those of the SUMFILEs
    sigma_px : float, px; standard deviation of the places, per axis, which the files do not have

    Returns
    -------
    list of Photo, Tracks
        Body axes are the reference axes. ``SIGMA_VSO`` and ``SIGMA_PTG`` are the a priori covariance, zeros leave the
        pose free; places of landmarks are a start only, since they follow from the same measures.

    Raises
    ------
    DataError
        A file is damaged, a camera is mirrored or distorted by K, a landmark names an image without SUMFILE, or no
        landmark is in two images.
    """
    require_number(sigma_px, "sigma_px", above=0.0)
    folder = Path(sumfiles)
    files = sorted(path for path in folder.iterdir() if path.suffix.upper() == ".SUM") if folder.is_dir() else []
    if not files:
        raise DataError(folder, "there is no file *.SUM")
    contents = [read_sumfile(path) for path in files]
    photos = [_photo(path, content) for path, content in zip(files, contents, strict=True)]
    places = {} if lmkfiles is None else {
        name: lmk.position_body_km for name, lmk in read_lmks(lmkfiles, folder).items()
    }  # fmt: skip
    found: dict[str, list[tuple[int, Float]]] = {}
    for k, content in enumerate(contents):
        for name, pixel in content.landmarks_px.items():
            found.setdefault(name, []).append((k, pixel))
    names = [name for name, views in found.items() if len(views) >= 2 and (not places or name in places)]
    if not names:
        raise DataError(folder, "no landmark is in two images")
    measures = [(i, k, pixel) for i, name in enumerate(names) for k, pixel in found[name]]
    return photos, Tracks(
        names=tuple(names),
        point=np.array([i for i, *_ in measures]),
        photo=np.array([k for _, k, _ in measures]),
        points_px=np.array([pixel for *_, pixel in measures]),
        sigma_px=np.array(sigma_px),
        points_km=np.array([places.get(name, np.full(3, np.nan)) for name in names]),
    )


def _photo(path: Path, content: Sumfile) -> Photo:
    camera = read_sumfile_camera(path)
    if camera.rows_reversed:
        raise DataError(path, "line 10: K is of a mirrored image: its first and fifth number must have the same sign")
    turn = camera.camera_from_mission.as_matrix()
    covariance = np.diag([np.inf] * 6)
    if content.sigma_pointing_rad.any():
        covariance[:3, :3] = turn * np.square(content.sigma_pointing_rad) @ turn.T
    if content.sigma_target_km.any():
        covariance[3:, 3:] = np.diag(np.square(content.sigma_target_km))
    return Photo(
        name=content.name,
        model=camera.model,
        camera_from_inertial=camera.camera_from_mission * content.camera_from_body,
        position_km=-content.target_km,
        covariance_pose=covariance,
        et=et_from_time(content.epoch) - float(np.linalg.norm(content.target_km)) / SPEED_OF_LIGHT_KM_S,
        columns=content.columns,
        rows=content.rows,
        sun_direction=content.sun_direction_body,
    )


def write_spc(folder: str | Path, fix: NetworkFix, catalog: LandmarkCatalog | None = None) -> None:
    """Write a SUMFILE of each image and an LMK file of each point of an adjusted network.

    Parameters
    ----------
    folder : path-like; gets ``SUMFILES`` and ``LMKFILES``
    fix : NetworkFix
    catalog : LandmarkCatalog, optional; landmarks whose names the points have, for the axes and sizes of their maps

    Raises
    ------
    InputError
        The Sun or the size of an image is not known, a name is too long, or two images have one in SPC.
    DataError
        A file cannot be written.

    Notes
    -----
    Distortion is removed from the places, since these files hold none that is ours; rejected measures are left out.
    """
    names = [PurePath(photo.name).stem.replace(" ", "_")[:12] for photo in fix.photos]
    require(len(set(names)) == len(names), "the first 12 characters of the names of images must differ in SPC")
    tracks, maps = fix.tracks, {} if catalog is None else {one.name: one.map for one in catalog.landmarks}
    pixels = np.empty_like(np.asarray(tracks.points_px))
    known = np.asarray(np.isfinite(fix.points_km).all(axis=1))
    good = fix.used & known[tracks.point]
    for k, photo in enumerate(fix.photos):
        mine = tracks.photo == k
        center, k_matrix = _plane(photo.model)
        look = photo.model.unproject(tracks.points_px[mine])
        pixels[mine] = np.round(center + look[:, :2] / look[:, 2:] @ k_matrix.T, 3)
    for part in ("SUMFILES", "LMKFILES"):
        make_folder(Path(folder) / part)
    for k, photo in enumerate(fix.photos):
        seen = np.flatnonzero(good & (tracks.photo == k))
        places = {tracks.names[tracks.point[n]]: pixels[n] for n in seen}
        write_sumfile(Path(folder) / "SUMFILES" / f"{names[k]}.SUM", _sumfile(names[k], photo, places))
    for i in np.flatnonzero(known):
        seen = np.flatnonzero(good & (tracks.point == i))
        here, name, sigma = maps.get(tracks.names[i]), tracks.names[i], np.diagonal(fix.covariance_points_km2[i])
        write_lmk(
            Path(folder) / "LMKFILES" / f"{name}.LMK",
            Lmk(
                name=name,
                has_topography=here is not None,
                half_size=1 if here is None else max(here.heights_km.shape) // 2,
                scale_km=1e-3 if here is None else here.spacing_km,
                position_body_km=fix.points_km[i],
                body_from_local=_outward(fix.points_km[i]) if here is None else here.body_from_map,
                sigma_km=float(np.sqrt(sigma.sum())),
                sigma_body_km=np.sqrt(sigma),
                pictures_px={names[tracks.photo[n]]: pixels[n] for n in seen},
            ),
        )


def _plane(model: CameraModel) -> tuple[Float, Float]:
    """Principal point (2,) and matrix (2, 2) of focal lengths, px, of a camera without its distortion."""
    named = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    pinhole = {"fx_px", "fy_px", "cx_px", "cy_px"} <= set(named)
    require(pinhole, f"SPC needs a camera with a principal point and focal lengths, not {type(model).__name__}")
    center = np.array([named["cx_px"], named["cy_px"]])
    return center, np.array([[named["fx_px"], named.get("skew_px", 0.0)], [0.0, named["fy_px"]]])


def _sumfile(name: str, photo: Photo, places: dict[str, Float]) -> Sumfile:
    require(photo.sun_direction is not None, f"{photo.name}: a SUMFILE needs the direction to the Sun")
    assert photo.sun_direction is not None
    require(photo.columns > 0 < photo.rows, f"{photo.name}: a SUMFILE needs the size of the image")
    center, k_matrix = _plane(photo.model)
    body, covariance = photo.inertial_from_body.inv(), np.asarray(photo.covariance_pose)
    turn, focal_mm = body.as_matrix(), float(k_matrix[0, 0]) / _PIXELS_PER_MM
    return Sumfile(
        name=name,
        epoch=time_from_et(photo.et + float(np.linalg.norm(photo.position_km)) / SPEED_OF_LIGHT_KM_S),
        columns=photo.columns,
        rows=photo.rows,
        thresholds_dn=(0, _LARGEST_DN),
        focal_length_mm=focal_mm,
        center_px=center,
        pixels_per_mm=np.hstack([k_matrix / focal_mm, np.zeros((2, 1))]),
        target_km=-rotate(body, photo.position_km),
        camera_from_body=photo.camera_from_inertial * photo.inertial_from_body,
        sun_direction_body=rotate(body, photo.sun_direction),
        sigma_target_km=np.sqrt(np.diagonal(turn @ covariance[3:, 3:] @ turn.T)),
        sigma_pointing_rad=np.sqrt(np.diagonal(covariance)[:3]),
        landmarks_px=places,
    )


def _outward(point: Float) -> Rotation:
    """Axes of a landmark without a map: x to the south, y to the east, z away from the center."""
    up = unit(point)
    east = np.cross([0.0, 0.0, 1.0], up)
    east = unit(east) if float(np.linalg.norm(east)) > 1e-6 else np.array([0.0, 1.0, 0.0])
    return Rotation.from_matrix(np.stack([np.cross(east, up), east, up], axis=1))


def pck_of(fix: NetworkFix, naif_id: int, lines: Sequence[str] = ()) -> str:
    """Return a text PCK of the adjusted rotation, with the covariance at J2000 in its comments.

    Parameters
    ----------
    fix : NetworkFix; with a rotation
    naif_id : int; code of the body
    lines : sequence of str; further comments

    Raises
    ------
    InputError
        The network has no rotation.
    """
    require(fix.body is not None, "a PCK needs a network with a rotation: adjust it with body=Rotating(...)")
    assert fix.body is not None
    covariance = fix.body.covariance_j2000
    rows = [] if covariance is None else [" ".join(f"{value:.15e}" for value in row) for row in covariance]
    text = ["KPL/PCK", "", f"Rotation of body {naif_id} by landmarks in {len(fix.photos)} images.", *lines]
    text += ["Covariance (deg^2, deg^2/day) of POLE_RA, POLE_DEC, PM at J2000, rate (deg/day):", *rows] if rows else []
    text += ["", "\\begindata", ""]
    for name, values in (("POLE_RA", fix.body.pole_ra_deg), ("POLE_DEC", fix.body.pole_dec_deg),
                         ("PM", fix.body.pm_deg)):  # fmt: skip
        text.append(f"BODY{naif_id}_{name} = ( " + " ".join(f"{value:.17g}" for value in values) + " )")
    return "\n".join([*text, "", "\\begintext", ""])
