"""Files of an adjusted network: its summary, and tables of its points and poses."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from giantlike._system.atomic import make_folder, write_text_atomic
from giantlike.core.errors import InputError
from giantlike.network.landmarks import move_landmarks
from giantlike.network.result import NetworkFix
from giantlike.network.spc import pck_of, write_spc
from giantlike.shapes.landmarks import LandmarkCatalog, save_landmarks

RESULT_FILE = "result.json"


def write_network(
    folder: str | Path,
    fix: NetworkFix,
    more: Mapping[str, Any] | None = None,
    *,
    naif_id: int | None = None,
    catalog: LandmarkCatalog | None = None,
) -> None:
    """Write ``result.json``, ``points.csv`` and ``poses.csv``, and what else the network gives.

    With the Sun of all images ``SUMFILES`` and ``LMKFILES`` (or ``result.json`` says why not); with a rotation and a
    code ``rotation.tpc``; with the landmarks of a shape ``landmarks.npz``, moved to the adjusted points.

    Parameters
    ----------
    folder : path-like; is made if it does not exist
    fix : NetworkFix
    more : mapping, optional; further content of ``result.json``
    naif_id : int, optional; code of the body
    catalog : LandmarkCatalog, optional; landmarks whose names the points have

    Raises
    ------
    DataError
        A file cannot be written.
    """
    folder = make_folder(folder)
    summary = {"status": "ok", **fix.summary(), **(more or {})}
    write_text_atomic(folder / "points.csv", "\n".join(_point_rows(fix)) + "\n")
    write_text_atomic(folder / "poses.csv", "\n".join(_pose_rows(fix)) + "\n")
    if naif_id is not None and fix.body is not None:
        write_text_atomic(folder / "rotation.tpc", pck_of(fix, naif_id))
    if catalog is not None:
        save_landmarks(move_landmarks(catalog, fix), folder / "landmarks.npz", overwrite=True)
    if all(photo.sun_direction is not None for photo in fix.photos):
        try:
            write_spc(folder, fix, catalog)
        except InputError as error:
            summary["not_written"] = f"SUMFILES, LMKFILES: {error}"
    write_text_atomic(folder / RESULT_FILE, json.dumps(summary, indent=1) + "\n")


def _point_rows(fix: NetworkFix) -> list[str]:
    rows = ["point,status,views,used,x_km,y_km,z_km,xx_km2,xy_km2,xz_km2,yy_km2,yz_km2,zz_km2"]
    used = np.bincount(fix.tracks.point, fix.used, len(fix.tracks.names)).astype(int)
    upper = np.triu_indices(3)
    for k, name in enumerate(fix.tracks.names):
        numbers = [*fix.points_km[k], *fix.covariance_points_km2[k][upper]]
        rows.append(f"{name},{fix.point_status[k]},{fix.tracks.views[k]},{used[k]}," + _csv(numbers))
    return rows


def _pose_rows(fix: NetworkFix) -> list[str]:
    upper = [f"c{i}{j}" for i, j in zip(*np.triu_indices(6), strict=True)]
    rows = ["image,et,qx,qy,qz,qw,x_km,y_km,z_km," + ",".join(upper)]
    for photo, covariance in zip(fix.photos, fix.covariance_poses, strict=True):
        quaternion = photo.camera_from_inertial.as_quat(canonical=True)
        numbers = [photo.et, *quaternion, *photo.position_km, *covariance[np.triu_indices(6)]]
        rows.append(f"{photo.name}," + _csv(numbers))
    return rows


def _csv(numbers: Iterable[float]) -> str:
    return ",".join("" if math.isnan(value) else f"{value:.15g}" for value in numbers)
