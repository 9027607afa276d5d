"""Images of a campaign with their a priori epoch, pose and scene.

Sources, in order of precedence: the geometry table or ``[geometry]``, the image's own header, SPICE.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.file.inputs import SpiceSetup, TargetSetup
from giantlike.campaign.store.edits import Area, mask_of
from giantlike.core.arrays import require, unit
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.time import time_from_et
from giantlike.core.values import Value
from giantlike.ephemeris import BARYCENTER, ApparentGeometry, SpiceEphemeris
from giantlike.image import Image
from giantlike.io.geometry_table import GeometryRow, ImageGeometry
from giantlike.io.label_geometry import geometry_of_label
from giantlike.io.spice import CoverageError, spk_state
from giantlike.io.spice_pointing import LabelClock
from giantlike.io.wcs_header import attitude_of_wcs, has_world_coordinates
from giantlike.processing.calibration_frames import CalibrationFrames
from giantlike.scene import Scene, Target, TargetUncertainty
from giantlike.shapes import Ellipsoid, Shape

_POLE_UP = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""``camera_from_body`` with the pole up in the image: the most frequent view of poles in random directions."""
_SUN_COLUMNS = "sun_x, sun_y, sun_z"


@dataclass(frozen=True, slots=True, eq=False)
class PreparedImage(Value):
    """An image with its a priori epoch and pose."""

    image: Image
    notes: tuple[str, ...]  # requested data that could not be found


def open_image(campaign: Campaign, entry: ImageEntry, frames: CalibrationFrames | None = None) -> PreparedImage:
    """Read an image, complete it from geometry table and SPICE, and calibrate its pixels."""
    image = dataclasses.replace(
        Image.open(entry.path, hdu=campaign.hdu, bottom_up=campaign.bottom_up),
        name=entry.key,
        camera_name=campaign.camera.frame_name,
    )
    campaign.camera.require_image(image)
    known = campaign.geometry.get(entry.key)
    if known is not None:
        image = dataclasses.replace(
            image,
            epoch=known.epoch or image.epoch,
            exposure_s=image.exposure_s if known.exposure_s is None else known.exposure_s,
            observer=known.observer or image.observer,
        )
        if known.in_body_axes:
            pointing = _attitude_by_body(campaign, image, known)
            image = image if pointing is None else image.with_attitude(pointing)
        if known.camera_from_inertial is not None:
            image = image.with_attitude(known.camera_from_inertial)
    if frames is not None:
        image = image.calibrated(frames, campaign.camera.detector)
    notes: tuple[str, ...] = ()
    if campaign.spice is not None and campaign.spice.clock is not None and image.epoch is None:
        image, notes = _with_clock(image, campaign.spice.clock)
    if campaign.label_geometry and image.camera_from_inertial is None:
        pointing = attitude_of_label(campaign, image)
        image = image if pointing is None else image.with_attitude(pointing)
    if campaign.spice is not None:
        image, more = _with_spice(image, campaign.spice)
        notes += more
    if image.camera_from_inertial is None and has_world_coordinates(image.metadata):
        image, more = _with_world_coordinates(image, campaign)
        notes += more
    if image.camera_from_inertial is None and known is not None and known.seen:
        turn = next(iter(known.seen.values())).camera_from_body if known.in_body_axes else None
        image = dataclasses.replace(image, observer=None if known.in_body_axes else image.observer)
        image = image.with_attitude(turn or Rotation.identity())
        axes = "camera axes" if turn is None else "axes of the body"
        notes += (f"no a priori attitude: {axes} are used as inertial axes",)
    return PreparedImage(image, notes)


def mask_areas(image: Image, areas: Sequence[Area]) -> Image:
    """Return an image without the pixels in polygons."""
    if not areas:
        return image
    return dataclasses.replace(image, mask=image.mask | mask_of(areas, (image.rows, image.columns)))


def _attitude_by_body(campaign: Campaign, image: Image, known: ImageGeometry) -> Rotation | None:
    """Attitude by the orientation of a target by SPICE. Returns None where there is none."""
    et = image.et
    if campaign.spice is None or et is None:
        return None
    for target in campaign.targets:
        stated = known.seen.get(target.name)
        if stated is not None and stated.camera_from_body is not None:
            try:
                return stated.camera_from_body * target.inertial_from_body(stated.position_camera_km, et).inv()
            except DataError:
                continue
    return None


def _with_world_coordinates(image: Image, campaign: Campaign) -> tuple[Image, tuple[str, ...]]:
    """The attitude that a plate solver left in the header, as a priori."""
    try:
        solved = attitude_of_wcs(
            image.metadata, campaign.camera.model, columns=image.columns, rows=image.rows, bottom_up=campaign.bottom_up
        )
    except InputError as error:
        return image, (f"no a priori attitude from world coordinates: {error}",)
    note = f"a priori attitude from world coordinates, which the camera model fits to {solved.rms_px:.2g} px"
    return image.with_attitude(solved.camera_from_inertial), (note,)


def _with_clock(image: Image, clock: LabelClock) -> tuple[Image, tuple[str, ...]]:
    """The epoch by the count of the spacecraft clock in the label."""
    try:
        et = clock.middle_of_exposure(image.metadata, image.exposure_s)
    except DataError as error:
        return image, (str(error),)
    return (image, ()) if et is None else (dataclasses.replace(image, epoch=time_from_et(et)), ())


def _with_spice(image: Image, spice: SpiceSetup) -> tuple[Image, tuple[str, ...]]:
    et = image.et
    if et is None:
        return image, ("no epoch, so nothing is known of this image from SPICE",)
    notes: list[str] = []
    if image.observer is None:
        try:
            image = dataclasses.replace(image, observer=spice.observer(et))
        except DataError as error:
            notes.append(f"stars without aberration and parallax: {error}")
    if image.camera_from_inertial is None:
        try:
            pointing = spice.camera_from_inertial(et)
            image = image if pointing is None else image.with_attitude(pointing)
        except DataError as error:
            notes.append(f"no a priori attitude: {error}")
    return image, tuple(notes)


def targets_in(campaign: Campaign, key: str) -> tuple[TargetSetup, ...]:
    """Targets to look for in an image: those with a row in the geometry table; with SPICE or labels, all."""
    if campaign.spice is not None or campaign.label_geometry:
        return campaign.targets
    known = campaign.geometry.get(key)
    named = () if known is None else (*known.targets, *known.seen)
    return tuple(target for target in campaign.targets if target.name in named)


@dataclass(frozen=True, slots=True)
class _SpiceGeometry:
    """A target, the Sun and the spacecraft, all from SPICE.

    Positions are relative to the barycenter of the Solar System or, if kernels do not link spacecraft and target to it,
    to the target itself (``relative``). Light time and aberration by the relative velocity are then correct to first
    order, but for the acceleration of the target and v^2/c^2.
    """

    spice: SpiceSetup
    target: TargetSetup
    uncertainty: TargetUncertainty
    relative: bool

    @classmethod
    def at(
        cls, spice: SpiceSetup, target: TargetSetup, uncertainty: TargetUncertainty, et: float | None
    ) -> _SpiceGeometry:
        """Choose the origin: the barycenter, unless the kernels know the spacecraft relative to the target only."""
        linked = et is None or all(_has_state(body, et, BARYCENTER) for body in (spice.spacecraft, target.spice_body))
        relative = et is not None and not linked and _has_state(spice.spacecraft, et, target.spice_body)
        return cls(spice, target, uncertainty, relative=relative)

    def scene(self, shape: Shape, *, sun: bool = True) -> Scene:
        """Scene of the target, without the Sun for positions alone."""
        origin = self.target.spice_body if self.relative else BARYCENTER
        body = SpiceEphemeris(self.target.spice_body, self.target.frame, origin)
        return Scene(
            targets=(_body(self.target, self.uncertainty, shape, body),),
            observer=SpiceEphemeris(self.spice.spacecraft, origin=origin),
            light=SpiceEphemeris("SUN", origin=origin) if sun else None,
        )


def _has_state(body: str, et: float, origin: str) -> bool:
    try:
        spk_state(body, et, observer=origin)
    except CoverageError:
        return False
    return True


def _uncertainty_in(campaign: Campaign, image: Image, target: TargetSetup) -> TargetUncertainty:
    """Uncertainty of a target with the covariance of its position in an image: of the arc, or of its SUMFILE."""
    known, et, attitude = campaign.geometry.get(image.name), image.et, image.camera_from_inertial
    stated = None if known is None else known.seen.get(target.name)
    if target.orbit is not None and campaign.is_body_image(image.exposure_s):
        require(et is not None, f"{target.name}: its covariance by epoch needs the epoch of the image")
        return dataclasses.replace(target.uncertainty, ephemeris_icrf_km2=target.orbit.at(et or 0.0))
    covariance = None if stated is None else stated.covariance_camera_km2
    if covariance is None or attitude is None or target.uncertainty.ephemeris_km > 0.0:
        return target.uncertainty
    turn = attitude.as_matrix()
    return dataclasses.replace(target.uncertainty, ephemeris_icrf_km2=turn.T @ covariance @ turn)


def _body(
    target: TargetSetup, uncertainty: TargetUncertainty, shape: Shape, ephemeris: ApparentGeometry | SpiceEphemeris
) -> Target:
    return Target(
        name=target.name,
        shape=shape,
        ephemeris=ephemeris,
        reflectance=target.reflectance,
        uncertainty=uncertainty,
        terrain=target.limb.height_map(),
        atmosphere=target.limb.atmosphere,
        rings=target.limb.rings,
        air=target.limb.air,
    )


def scene_of(campaign: Campaign, image: Image, target: TargetSetup, shape: Shape) -> Scene | Failure:
    """Build the scene of one target in an image."""
    known = campaign.geometry.get(image.name)
    row = None if known is None else known.targets.get(target.name)
    if row is None:
        row = stated_row(campaign, image, target)
    known_errors = _uncertainty_in(campaign, image, target)
    setup = campaign.spice
    spice = None if setup is None else _SpiceGeometry.at(setup, target, known_errors, image.et)
    if row is not None:
        apparent = _from_row(row, image, target, shape, spice)
        if isinstance(apparent, Failure):
            return apparent
        return Scene(targets=(_body(target, known_errors, shape, apparent),))
    if spice is None:
        return _missing(image, target, "row")
    if spice.relative and image.et is not None and not _has_state("SUN", image.et, target.spice_body):
        return _missing(image, target, _SUN_COLUMNS, f"no state of SUN relative to {target.spice_body}")
    return spice.scene(shape)


def _from_row(
    row: GeometryRow, image: Image, target: TargetSetup, shape: Shape, spice: _SpiceGeometry | None
) -> ApparentGeometry | Failure:
    """Geometry of a row of the table; missing values come from SPICE, if available."""
    position, sun = row.target_position_inertial_km, row.sun_direction_inertial
    if position is None:
        if spice is None:
            return _missing(image, target, "target_x_km, target_y_km, target_z_km")
        scene = spice.scene(shape, sun=False)
        predicted = scene.apparent(image, scene.target())
        if isinstance(predicted, Failure):
            return predicted
        position = predicted.position_inertial_km
    et = image.et
    if row.body_from_inertial is not None:
        inertial_from_body = row.body_from_inertial.inv()
    elif spice is not None and et is not None:
        inertial_from_body = target.inertial_from_body(position, et)
    elif isinstance(shape, Ellipsoid) and np.ptp(shape.radii_km) == 0:
        inertial_from_body = Rotation.identity()  # a sphere looks the same from everywhere
    elif target.uncertainty.pole_unknown:
        attitude = image.camera_from_inertial
        inertial_from_body = _POLE_UP if attitude is None else attitude.inv() * _POLE_UP
    else:
        return _missing(image, target, "body_qx, body_qy, body_qz, body_qw (in [geometry]: north, sub-observer point)")
    if sun is None:
        if spice is None or et is None:
            return _missing(image, target, _SUN_COLUMNS)
        spacecraft = spice.spice.spacecraft
        if not _has_state("SUN", et, spacecraft):
            return _missing(image, target, _SUN_COLUMNS, f"no state of SUN relative to {spacecraft}")
        sun = unit(spice.spice.sun_from(position, et))
    velocity = row.target_velocity_inertial_km_s
    if velocity is None and spice is not None and et is not None and _has_state(target.spice_body, et, BARYCENTER):
        velocity = spk_state(target.spice_body, et, observer=BARYCENTER)[1]
    return ApparentGeometry(
        position_inertial_km=position,
        inertial_from_body=inertial_from_body,
        sun_direction_inertial=sun,
        velocity_inertial_km_s=velocity,
    )


def _missing(
    image: Image, target: TargetSetup, what: str, why: str = "no [spice], or no epoch of the image"
) -> Failure:
    detail = f"{image.name}: {target.name}: the geometry table has no {what}, and SPICE cannot fill in ({why})"
    return Failure(Reason.NO_GEOMETRY, detail)


def attitude_of_label(campaign: Campaign, image: Image) -> Rotation | None:
    """Attitude from a label, direct or by the orientation of its target; None where that is not known."""
    label = geometry_of_label(image.metadata, campaign.camera.model)
    if label is None or label.camera_from_inertial is not None or label.camera_from_body is None:
        return None if label is None else label.camera_from_inertial
    target = next((one for one in campaign.targets if _is(one, label.target)), None)
    et = image.et
    if target is None or et is None or campaign.spice is None:
        return None
    try:
        # only the distance counts, for the light time
        inertial_from_body = target.inertial_from_body(label.position_camera_km, et)
    except DataError:
        return None
    return label.camera_from_body * inertial_from_body.inv()


def stated_row(campaign: Campaign, image: Image, target: TargetSetup) -> GeometryRow | None:
    """Geometry of a target from ``[geometry]`` or the label of an image; None without it, or without attitude."""
    known, attitude = campaign.geometry.get(image.name), image.camera_from_inertial
    stated = None if known is None else known.seen.get(target.name)
    if stated is None and campaign.label_geometry:
        label = geometry_of_label(image.metadata, campaign.camera.model)
        stated = label if label is not None and _is(target, label.target) else None
    if stated is None or attitude is None:
        return None
    turn = stated.camera_from_body
    return GeometryRow(
        file=image.name,
        target=target.name,
        target_position_inertial_km=rotate(attitude.inv(), stated.position_camera_km),
        body_from_inertial=None if turn is None else turn.inv() * attitude,
        sun_direction_inertial=rotate(attitude.inv(), stated.sun_direction_camera),
    )


def _is(target: TargetSetup, name: str) -> bool:
    return name.strip().upper() in {target.name.upper(), target.spice_body.upper()}
