"""Photos and tracks of an ISIS control network and the image support data of its images."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, require_number
from giantlike.core.errors import DataError
from giantlike.core.frames import rotate
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.io.isis_network import (
    ControlNetwork,
    ControlPoint,
    ImageSupport,
    angles_covariance,
    read_control_network,
    read_image_support,
)
from giantlike.network.photos import Photo, Tracks

_SERIAL_TIME = re.compile(r"\d{4}-\d{2}-\d{2}T[\d:.]+\Z")
_MAX_APART_S = 2.0  # between the time in a serial number, mostly the start of the exposure, and the ISD's
_SIGMA_PX = 1.4  # of a measure, pixels of the detector: what jigsaw takes where a network says nothing

_MIN_SPREAD = 3  # measures of an image by which its scale is compared
_OTHER_SCALE = 1.3  # ratio of scales beyond errors of a priori poses


def read_isis(
    network: str | Path,
    isds: Sequence[str | Path],
    *,
    reduction: float = 1.0,
    sigma_px: float = _SIGMA_PX,
    sigma_position_km: float = 1.0,
    sigma_angles_deg: float = 2.0,
) -> tuple[list[Photo], Tracks]:
    """Read an ISIS control network with the image support data of its images.

    Parameters
    ----------
    network : path-like; control network in PVL
    isds : sequence of path-like; ISDs of frame cameras
    reduction : float; pixels of the detector along a pixel of the images in which the network is measured
    sigma_px : float, px of the detector; standard deviation of measures, per axis
    sigma_position_km : float, km; a priori standard deviation of positions, per axis
    sigma_angles_deg : float, deg; a priori standard deviation of the angles RA, DEC and TWIST of ISIS

    Returns
    -------
    list of Photo, Tracks
        Pinhole cameras, and measures from which distortion is removed, as ISIS does it; pixels of the images.

    Raises
    ------
    DataError
        A file is damaged, an image has no ISD or a camera that is none of a frame, or the pixels are of another size.
    """
    for name, value in (("reduction", reduction), ("sigma_px", sigma_px), ("sigma_position_km", sigma_position_km),
                        ("sigma_angles_deg", sigma_angles_deg)):  # fmt: skip
        require_number(value, name, above=0.0)
    path = Path(network)
    content = read_control_network(path)
    supports = {str(isd): read_image_support(Path(isd)) for isd in isds}
    files = _files_of(path, content, supports)
    serials = list(files)
    photos: list[Photo] = []
    measures: dict[str, Iterator[Float]] = {}
    for serial, file in files.items():
        support = supports[file]
        photo, to_pixels = _photo(Path(file), serial, support, reduction, (sigma_position_km, sigma_angles_deg))
        photos.append(photo)
        places = [(m.sample, m.line) for p in content.points for m in p.measures if m.serial_number == serial]
        raw = np.array(places)
        outside = (raw < 0.5) | (raw > np.array([support.samples, support.lines]) + 0.5)
        if outside.any():
            worst = raw[outside.any(axis=1)][0]
            raise DataError(
                path, f"a measure of {serial} at sample {worst[0]:.1f}, line {worst[1]:.1f} lies outside of the image "
                f"of {support.samples} by {support.lines} pixels: check which image the network was measured in",
            )  # fmt: skip
        measures[serial] = iter(to_pixels(raw))
    tracks = _tracks(content, serials, measures, sigma_px / reduction)
    _require_scale(path, photos, tracks, reduction)
    return photos, tracks


def _files_of(path: Path, content: ControlNetwork, supports: dict[str, ImageSupport]) -> dict[str, str]:
    """ISD of each serial number, by platform, sensor and time."""
    serials = sorted({m.serial_number for p in content.points for m in p.measures})
    files: dict[str, str] = {}
    for serial in serials:
        time = _SERIAL_TIME.search(serial)
        if time is None:
            raise DataError(path, f"the serial number {serial!r} does not end with a time: such images are not read")
        et = et_from_time(time_from_utc(time[0]))
        known = [file for file, one in supports.items() if _prefix(one) == _plain(serial[: time.start()])]
        nearest = min(known, key=lambda file: abs(supports[file].et - et), default=None)
        if nearest is None or abs(supports[nearest].et - et) > _MAX_APART_S:
            raise DataError(
                path, f"the image {serial} has no ISD: give those of all images ({len(supports)} are given)"
            )
        if nearest in files.values():
            raise DataError(path, f"the ISD {nearest} fits two images, {serial} among them: one ISD is missing")
        files[serial] = nearest
    return files


def _prefix(support: ImageSupport) -> str:
    return _plain(f"{support.platform}/{support.sensor}")


def _plain(text: str) -> str:
    return "".join(text.split()).strip("/").upper()


def _photo(
    path: Path, serial: str, support: ImageSupport, reduction: float, sigmas: tuple[float, float]
) -> tuple[Photo, Callable[[Float], Float]]:
    """Photo of an ISD, and a function from samples and lines (n, 2) to pixels (n, 2) without distortion."""
    by_pixel = reduction * np.array(support.summing)
    half = (np.array([support.samples, support.lines]) * by_pixel) / 2.0
    if np.isnan(support.center).any():
        support = replace(support, center=half)
    toward = support.camera_from_inertial.as_matrix() @ -support.position_km
    axes = np.zeros((3, 3))  # of the camera here, along columns, rows and the line of sight, in ISIS's
    for row, direction in enumerate(support.pixels_per_mm):
        axes[row, int(np.argmax(np.abs(direction)))] = np.sign(direction[np.argmax(np.abs(direction))])
    axes[2, 2] = np.sign(toward[2])
    if not np.linalg.det(axes) > 0.0:
        raise DataError(path, "focal2pixel and the pose are of a mirrored image: rows or columns run the other way")
    pitch_mm = by_pixel / np.abs((support.pixels_per_mm @ axes[:2, :2].T).diagonal())
    center_px = (support.center - support.first - 0.5) / by_pixel - 0.5

    def to_pixels(raw: Float) -> Float:
        ideal = support.ideal_mm((raw - 0.5) * by_pixel + 0.5 + support.first)
        return np.asarray(ideal @ axes[:2, :2].T / pitch_mm + center_px)

    focal = support.focal_length_mm / pitch_mm
    camera = Rotation.from_matrix(axes)
    covariance = np.zeros((6, 6))
    turned = angles_covariance(support.camera_from_inertial, sigmas[1])
    covariance[:3, :3], covariance[3:, 3:] = axes @ turned @ axes.T, np.eye(3) * sigmas[0] ** 2
    photo = Photo(
        name=serial,
        model=PinholeModel(fx_px=focal[0], fy_px=focal[1], cx_px=center_px[0], cy_px=center_px[1]),
        camera_from_inertial=camera * support.camera_from_inertial,
        position_km=support.position_km,
        covariance_pose=covariance,
        inertial_from_body=support.body_from_inertial.inv(),
        et=support.et,
    )
    return photo, to_pixels


def _tracks(
    content: ControlNetwork, serials: list[str], measures: dict[str, Iterator[Float]], sigma_px: float
) -> Tracks:
    """Measures of all points; free points start where the network has them."""
    found = [(k, m.serial_number) for k, point in enumerate(content.points) for m in point.measures]
    return Tracks(
        names=tuple(point.name for point in content.points),
        point=np.array([k for k, _ in found]),
        photo=np.array([serials.index(serial) for _, serial in found]),
        points_px=np.array([next(measures[serial]) for _, serial in found]),
        sigma_px=np.array(sigma_px),
        points_km=np.array([point.position_km for point in content.points]),
        covariance_points_km2=np.array([_covariance(point) for point in content.points]),
    )


def _covariance(point: ControlPoint) -> Float:
    """A priori covariance (3, 3) of a point: of constrained points that of the file, zero for fixed ones."""
    if point.type == "Fixed":
        return np.zeros((3, 3))
    constrained = point.type == "Constrained" and point.covariance_km2 is not None
    return point.covariance_km2 if constrained and point.covariance_km2 is not None else np.diag([np.inf] * 3)


def _require_scale(path: Path, photos: list[Photo], tracks: Tracks, reduction: float) -> None:
    """Raise where measures are predicted ones divided by one factor: the images were reduced by it."""
    known = np.isfinite(np.asarray(tracks.points_km)).all(axis=1)[tracks.point]
    ratios: list[float] = []
    for number, photo in enumerate(photos):
        mine = known & (tracks.photo == number)
        points = rotate(photo.inertial_from_body, np.asarray(tracks.points_km)[tracks.point[mine]])
        predicted = photo.model.project(rotate(photo.camera_from_inertial, points - photo.position_km))
        spread = [
            np.ptp(values, axis=0) for values in (predicted, tracks.points_px[mine]) if len(values) >= _MIN_SPREAD
        ]
        ratios += (spread[0] / spread[1]).tolist() if len(spread) == 2 else []
    ratio = float(np.nanmedian(ratios)) if ratios else 1.0
    if not 1.0 / _OTHER_SCALE < ratio < _OTHER_SCALE:
        raise DataError(
            path, f"its pixels are {ratio:.2f} pixels of the cameras: the images were reduced by "
            f"{ratio * reduction:.3g}; give that as reduction (here {reduction:g})",
        )  # fmt: skip
