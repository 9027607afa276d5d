"""SUMFILEs as a priori geometry of images: all in axes of the body, as :mod:`giantlike.io.spc_sumfile` has them.

``SCOBJ`` is taken as seen: the pixels of a SUMFILE's landmarks follow from it without light time or aberration.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError
from giantlike.core.frames import rotate
from giantlike.io.geometry_table import GeometryTable, ImageGeometry
from giantlike.io.mission_frame import ImportedCamera, from_mission_frame
from giantlike.io.spc_sumfile import Sumfile, read_sumfile
from giantlike.io.viewing_geometry import StatedGeometry


def read_sumfiles(
    folder: Path, images: Sequence[Path], targets: Sequence[str], size: tuple[int, int] | None = None
) -> GeometryTable:
    """Read the geometry of images from the SUMFILEs of a folder.

    A SUMFILE belongs to the image named in its first line, in any case, whatever its ending; its body is the only
    target, else the one with which the name of the file ends. ``size``: columns and rows of the camera.
    """
    files = sorted(path for path in folder.iterdir() if path.suffix.upper() == ".SUM")
    if not files:
        raise DataError(folder, "there is no file *.SUM")
    by_name: dict[str, list[Path]] = {}
    for image in images:
        by_name.setdefault(image.stem.upper(), []).append(image)
    found: dict[Path, ImageGeometry] = {}
    for path in files:
        content = read_sumfile(path)
        sharing = by_name.get(content.name.upper(), [])
        if len(sharing) > 1:
            raise DataError(path, f"{content.name} is the name of {len(sharing)} images ({sharing[0]}, {sharing[1]})")
        here = content.columns, content.rows
        if sharing and size not in (None, here):
            raise DataError(path, f"line 3: is of {here[0]} x {here[1]} pixels, and the camera has {size}")
        if sharing:
            known, target = found.get(sharing[0]), _target(path, targets)
            if known is not None and target in known.seen:
                raise DataError(path, f"the image {content.name} has another SUMFILE of {target}")
            found[sharing[0]] = _geometry(path, content, target, known)
    if not found:
        raise DataError(folder, f"no image has the name of a SUMFILE, such as {content.name}")
    return GeometryTable(folder, (), found)


def _target(path: Path, targets: Sequence[str]) -> str:
    ends = [name for name in targets if path.stem.upper().endswith(f"_{name.upper()}")]
    if len(targets) != 1 and not ends:
        raise DataError(path, f"of which body? Name the file IMAGE_TARGET.SUM, TARGET one of {', '.join(targets)}")
    return max(ends, key=len, default=targets[0])


def _geometry(path: Path, content: Sumfile, target: str, known: ImageGeometry | None) -> ImageGeometry:
    """Geometry of an image with that of another of its targets."""
    camera = _camera(path, content)
    if camera.rows_reversed:
        raise DataError(path, "line 10: K is of a mirrored image: its first and fifth number must have the same sign")
    turn = camera.camera_from_mission
    camera_from_body = turn * content.camera_from_body
    stated = StatedGeometry(
        target=target,
        position_camera_km=rotate(camera_from_body, content.target_km),
        sun_direction_camera=rotate(camera_from_body, content.sun_direction_body),
        camera_from_body=camera_from_body,
        covariance_camera_km2=_covariance(camera_from_body, content.sigma_target_km),
    )
    return ImageGeometry(
        epoch=content.epoch,
        exposure_s=None,
        camera_from_inertial=None,
        observer=None,
        targets={},
        seen={target: stated} if known is None else {**known.seen, target: stated},
        covariance_attitude_rad2=_covariance(turn, content.sigma_pointing_rad),
        in_body_axes=True,
    )


def read_sumfile_camera(path: Path) -> ImportedCamera:
    """Read the camera of a SUMFILE: focal length, center and K, without distortion."""
    content = read_sumfile(path)
    if np.any(content.pixels_per_mm[:, 2]) or content.pixels_per_mm[1, 0]:
        raise DataError(path, "line 10: K has distortion, by its third, fourth or sixth number: give a camera file")
    return _camera(path, content)


def _camera(path: Path, content: Sumfile) -> ImportedCamera:
    """Camera of a SUMFILE that was read; its third axis is the optical axis."""
    k = content.focal_length_mm * content.pixels_per_mm
    if k[0, 0] * k[1, 1] == 0.0:
        raise DataError(path, "line 10: the first and the fifth number of K must not be 0")
    center_x, center_y = content.center_px.tolist()
    return from_mission_frame(
        PinholeModel,
        {"fx_px": k[0, 0], "skew_px": k[0, 1], "fy_px": k[1, 1], "cx_px": center_x, "cy_px": center_y},
        name=path.stem,
        columns=content.columns,
        rows=content.rows,
        boresight="+z",
    )


def _covariance(turn: Rotation, sigmas: Float) -> Float | None:
    """Covariance (3, 3) of standard deviations along axes that are rotated; None where all are zero."""
    axes = turn.as_matrix()
    return axes * sigmas**2 @ axes.T if np.any(sigmas) else None
