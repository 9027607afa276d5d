"""Scenes: targets, a light, and the steps from true to apparent geometry."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.atmosphere import ATMOSPHERES, Atmosphere, is_airless
from giantlike.camera import Camera
from giantlike.core.arrays import Float, Mask, as_finite, require, require_number, unit
from giantlike.core.display import Pictured
from giantlike.core.errors import FrameMismatchError, InputError
from giantlike.core.frames import rotate, turn_between
from giantlike.core.light import aberrate, boosted
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.core.values import Value, check_covariance
from giantlike.ephemeris import BARYCENTER, ApparentGeometry, DistantLight, Ephemeris, light_path
from giantlike.image import Image
from giantlike.ray_tracing import Body, McEwen, Reflectance, trace_silhouette
from giantlike.ray_tracing.air import Air
from giantlike.rings import Rings
from giantlike.shapes import Ellipsoid, Shape
from giantlike.terrain import HeightMap

_MASK_DIRECTIONS = 720  # points of an outline, every half degree: 3 px apart on a limb of 300 px radius
_SUBPIXEL_BITS = 4  # fractional bits of the corners that OpenCV fills between: 1/16 px
_SUBPIXELS = 1 << _SUBPIXEL_BITS  # to a pixel
_FAR_SUBPIXELS = 1 << 24  # limit of the corners, a million pixels: OpenCV's int32 arithmetic overflows beyond
_NEARLY_ROUND = 0.12  # largest relative difference of radii with unknown pole; Saturn 0.098, Haumea 0.56
_ONE_AT_A_TIME = threading.RLock()  # CSPICE is not thread safe, and estimators may run in threads


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetUncertainty:
    """Standard deviations of the declared values of a body; each is one error, the same in all images.

    The defaults are 0, exact: no general value is valid both for radii of the Moon, known to a
    few meters, and for radii of a body seen for the first time. Only albedo variations are expected on every body.

    Parameters
    ----------
    scale : float; relative error of the size of the shape, all axes by the same factor
    pole_rad : float, rad; error of the direction of the body-fixed z axis, about each of the other two axes
    spin_rad : float, rad; error of the rotation about the body-fixed z axis
    ephemeris_km : float, km; error of the predicted position, along each axis
    ephemeris_icrf_km2 : (3, 3) array_like, km^2, ICRF axes, optional
        Covariance of the predicted position in an image, in place of ``ephemeris_km``, which becomes the square root of
        its largest eigenvalue.
    sun_rad : float, rad; error of the direction to the Sun, about each axis across it
    albedo : float
        Relative standard deviation of the brightness of the surface about its law (albedo variations), which are not
        attributed to another body, shape or Sun. 0.5 and more for clouds above sea.
    pole_unknown : bool
        True where the orientation of the body is not known at all; for ellipsoids that are nearly spheres
        (:meth:`require_known_pole`). Fixes then hold how far they move over all orientations.

    Raises
    ------
    InputError
        A value is negative, or not small: 0.3 of the size, 0.5 rad; or the albedo is not in [0.01, 2]; or a pole is
        unknown and has an error.
    """

    scale: float = 0.0
    pole_rad: float = 0.0
    spin_rad: float = 0.0
    ephemeris_km: float = 0.0
    albedo: float = 0.15
    pole_unknown: bool = False
    ephemeris_icrf_km2: Any = None
    sun_rad: float = 0.0

    def __post_init__(self) -> None:
        if self.ephemeris_icrf_km2 is not None:
            covariance = as_finite(self.ephemeris_icrf_km2, (3, 3), "ephemeris_icrf_km2")
            check_covariance(covariance, "ephemeris_icrf_km2")
            object.__setattr__(self, "ephemeris_icrf_km2", tuple(map(tuple, covariance.tolist())))
            object.__setattr__(self, "ephemeris_km", math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0)))
        require_number(self.sun_rad, "sun_rad", least=0.0, most=0.5)
        require_number(self.albedo, "albedo", least=0.01, most=2.0)
        require_number(self.scale, "scale", least=0.0, most=0.3)
        require_number(self.pole_rad, "pole_rad", least=0.0, most=0.5)
        require_number(self.spin_rad, "spin_rad", least=0.0, most=0.5)
        require_number(self.ephemeris_km, "ephemeris_km", least=0.0)
        alone = not (self.pole_unknown and (self.pole_rad or self.spin_rad))
        require(alone, "an unknown pole has no pole_rad and no spin_rad: nothing is known of the orientation")

    @property
    def covariance_ephemeris_km2(self) -> Float:
        """Covariance (3, 3) of the predicted position, km^2, ICRF axes."""
        return np.array(self.ephemeris_icrf_km2 or self.ephemeris_km**2 * np.eye(3))

    def require_known_pole(self, name: str, radii_km: Sequence[float] | None) -> None:
        """Raise an InputError where the pole is unknown and the body looks too different from other sides.

        Only ellipsoids whose ``radii_km`` differ by at most 12 % look similar enough; None stands for another shape.
        """
        if not self.pole_unknown:
            return
        why = "unknown pole: an ellipsoid is needed, whose radii differ by at most"
        require(radii_km is not None, f"{name}: {why} {_NEARLY_ROUND:.0%}, got a mesh")
        assert radii_km is not None
        difference = (max(radii_km) - min(radii_km)) / max(radii_km)
        require(
            difference <= _NEARLY_ROUND,
            f"{name}: {why} {_NEARLY_ROUND:.0%}, got {difference:.0%}: such a body looks different from each side; "
            "estimate its orientation, or declare pole_deg and spin_deg of a guess",
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target(Value):
    """A body that may be in the image.

    Parameters
    ----------
    name : str; name in tables and messages
    shape : Shape; shape in body axes; its origin is the center that estimators report
    ephemeris : Ephemeris or ApparentGeometry; position and orientation, geometric or already apparent
    reflectance : Reflectance; reflectance law of the surface; McEwen by default
    uncertainty : TargetUncertainty; of shape, orientation and ephemeris; by default all are exact
    terrain : HeightMap, optional; relief of an ellipsoid, for outlines of estimators on limbs alone
    atmosphere : Atmosphere, optional; haze over an ellipsoid, for estimators on limbs
    air : bool, optional
        True for a body with air or haze: an ellipsoid without an ``atmosphere`` or ``terrain`` gets the one that
        :data:`~giantlike.atmosphere.ATMOSPHERES` has by its name. False for an airless one: no estimator looks for
        haze on it, and albedo variations are not mistaken for it. None where it is not known, and haze is looked for;
        bodies of :data:`~giantlike.atmosphere.AIRLESS` are airless without being declared so.
    rings : Rings, optional; in the equator of an ellipsoid; limbs behind or in shadow of them are left out
    normal_albedo : float, optional; radiance factor (I/F) along the normal, for the light that is expected

    Raises
    ------
    InputError
        There is a height map, an atmosphere or rings and the shape is no ellipsoid, or there are both of the first: a
        limb has only one of them; or an airless body has an atmosphere.
    """

    name: str
    shape: Shape
    ephemeris: Ephemeris | ApparentGeometry
    reflectance: Reflectance = field(default_factory=McEwen)
    uncertainty: TargetUncertainty = field(default_factory=TargetUncertainty)
    terrain: HeightMap | None = None
    atmosphere: Atmosphere | None = None
    rings: Rings | None = None
    air: bool | None = None
    normal_albedo: float | None = None

    def __post_init__(self) -> None:
        require(
            self.air is not False or self.atmosphere is None,
            f"{self.name}: an airless body (air = false) has no atmosphere; leave one of the two out",
        )
        if self.normal_albedo is not None:
            require_number(self.normal_albedo, f"{self.name}: normal_albedo", above=0.0)
        if self.air and self.atmosphere is None and self.terrain is None and isinstance(self.shape, Ellipsoid):
            object.__setattr__(self, "atmosphere", ATMOSPHERES.get(self.name.upper()))
        for name, part in (
            ("terrain goes", self.terrain),
            ("an atmosphere goes", self.atmosphere),
            ("rings go", self.rings),
        ):
            smooth = part is None or isinstance(self.shape, Ellipsoid)
            require(smooth, f"{self.name}: {name} with an ellipsoid as shape, got a {type(self.shape).__name__}")
        require(
            self.terrain is None or self.atmosphere is None,
            f"{self.name}: give either terrain or an atmosphere: the limb is seen at one of them",
        )
        radii_km = self.shape.radii_km.tolist() if isinstance(self.shape, Ellipsoid) else None
        self.uncertainty.require_known_pole(self.name, radii_km)
        Value.__post_init__(self)

    @property
    def airless(self) -> bool:
        """True for a body without haze, as declared or by its name: nothing in its image is haze."""
        if self.air is None:
            return self.atmosphere is None and is_airless(self.name)
        return not self.air


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TargetGeometry(Value):
    """Predicted geometry of a target in one image.

    Parameters
    ----------
    target : Target; the body
    position_camera_km : (3,), km, camera axes
        Apparent position of the origin of the shape, from the camera; its length is the range by which the size in
        the image goes, see :func:`~giantlike.core.light.boosted`.
    camera_from_body : Rotation; orientation at the time the light left the body
    sun_direction_camera : (3,), unitless, camera axes; unit vector from body to Sun
    covariance_position_km2 : (3, 3), km^2, camera axes, optional; default by ``ephemeris_km`` of the target
    """

    target: Target
    position_camera_km: Float
    camera_from_body: Rotation
    sun_direction_camera: Float
    covariance_position_km2: Float | None = None

    @property
    def covariance_ephemeris_km2(self) -> Float:
        """Covariance (3, 3) of the position by the ephemeris, km^2, camera axes."""
        known = self.covariance_position_km2
        return self.target.uncertainty.ephemeris_km**2 * np.eye(3) if known is None else known

    @property
    def limb_altitude_km(self) -> tuple[float, float]:
        """Altitude of the limb above the shape by an atmosphere, and its standard deviation, km; 0 and 0 without."""
        atmosphere = self.target.atmosphere
        if atmosphere is None:
            return 0.0, 0.0
        return atmosphere.limb_altitude_km(self.target.shape.mean_radius_km), atmosphere.sigma_km

    @property
    def air(self) -> Air | None:
        """Air by an atmosphere whose scale height is known; None without."""
        atmosphere = self.target.atmosphere
        if atmosphere is None or atmosphere.scale_height_km == 0.0:
            return None
        radius_km = self.target.shape.mean_radius_km + self.limb_altitude_km[0]
        return Air(scale_height=atmosphere.scale_height_km / radius_km, optical_depth=atmosphere.vertical_depth)

    @property
    def range_km(self) -> float:
        """Distance from camera to body center, km."""
        return float(np.linalg.norm(self.position_camera_km))

    @property
    def phase_angle_rad(self) -> float:
        """Angle at the body between Sun and camera, rad."""
        cosine = -float(self.sun_direction_camera @ self.position_camera_km) / self.range_km
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)))

    def body(self, position_camera_km: Float | None = None) -> Body:
        """Return the body for the ray tracer, at a position (3,), km, camera axes; the predicted one by default."""
        position = self.position_camera_km if position_camera_km is None else position_camera_km
        return Body(
            shape=self.target.shape,
            reflectance=self.target.reflectance,
            camera_from_body=self.camera_from_body,
            position_camera_km=position,
        )

    def seen_body(self, position_camera_km: Float | None = None) -> Body:
        """Return :meth:`body` as seen: radii of an ellipsoid include the altitude of its atmosphere."""
        body, altitude_km = self.body(position_camera_km), self.limb_altitude_km[0]
        if altitude_km == 0.0 or not isinstance(body.shape, Ellipsoid):
            return body
        return replace(body, shape=replace(body.shape, radii_km=body.shape.radii_km + altitude_km), air=self.air)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Circumstances(Value):
    """States by which light time and stellar aberration of a target in an image are put in and taken out.

    Parameters
    ----------
    origin : str; NAIF name of the origin of states
    observer_position_km, observer_velocity_km_s : (3,) float64, km and km/s, ICRF axes; at the epoch
    target_velocity_km_s : (3,) float64, km/s, ICRF axes, optional; of the target when the light left it
    target_motion_km : (3,) float64, km, ICRF axes, optional; from emission of the light to the epoch
    light_time_s : float, s; predicted
    """

    origin: str
    observer_position_km: Float
    observer_velocity_km_s: Float
    target_velocity_km_s: Float | None = None
    target_motion_km: Float | None = None
    light_time_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene(Pictured, Value):
    """Targets, the light on them, and the position of the camera.

    Parameters
    ----------
    targets : sequence of Target; bodies that may be in the image
    observer : Ephemeris, optional; the spacecraft; without it the observer of the image is used
    light : Ephemeris or DistantLight, optional; the Sun, unless every target has a Sun direction
    light_time : bool; True to take geometric targets at the time the light left them
    stellar_aberration : bool
        True to see geometric targets as an observer does who moves with respect to the common origin: shifted, and at
        the distance that belongs to their size in the image.

    Raises
    ------
    InputError
        Two targets have the same name, or there is none.
    FrameMismatchError
        Ephemerides have different origins.
    """

    targets: tuple[Target, ...]
    observer: Ephemeris | None = None
    light: Ephemeris | DistantLight | None = None
    light_time: bool = True
    stellar_aberration: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "targets", tuple(self.targets))
        names = [target.name for target in self.targets]
        require(len(names) > 0, "a scene needs at least one target")
        require(len(set(names)) == len(names), f"target names must differ, got {', '.join(names)}")
        origin = self._origin()
        for part in [self.observer, self.light, *(target.ephemeris for target in self.targets)]:
            if isinstance(part, Ephemeris) and part.origin != origin:
                raise FrameMismatchError(f"origin {part.origin}", f"origin {origin}")
        Value.__post_init__(self)

    def __repr__(self) -> str:
        return f"Scene({', '.join(target.name for target in self.targets)})"

    def target(self, name: str | None = None) -> Target:
        """Return a target by name, needed where there are several; InputError for an unknown one."""
        if name is None:
            if len(self.targets) > 1:
                raise InputError(f"the scene has several targets, name one: {self._names()}")
            return self.targets[0]
        for target in self.targets:
            if target.name == name:
                return target
        raise InputError(f"no target {name!r} in the scene; there is {self._names()}")

    def geometry(self, image: Image, target: str | None = None) -> TargetGeometry | Failure:
        """Predict the geometry of a target in an image.

        Parameters
        ----------
        image : Image; needs an attitude; for geometric ephemerides also an epoch
        target : str, optional; name of the target; may be left out when there is only one

        Returns
        -------
        TargetGeometry or Failure
            Reasons: no_attitude, no_epoch, no_geometry (the position of the spacecraft or the direction of the Sun is
            not known).

        Raises
        ------
        InputError
            There is no such target, or an ephemeris table does not cover the epoch.
        DataError
            SPICE kernels do not cover the epoch.
        """
        found = self.target(target)
        if image.camera_from_inertial is None:
            return Failure(
                Reason.NO_ATTITUDE,
                f"{image.name}: no attitude, a priori or from stars; give one in the geometry table or solve the stars",
            )
        with _ONE_AT_A_TIME:
            apparent = self.apparent(image, found)
        if isinstance(apparent, Failure):
            return apparent
        sun = apparent.sun_direction_inertial
        if sun is None and isinstance(self.light, DistantLight):
            sun = self.light.direction_inertial
        if sun is None:
            return Failure(Reason.NO_GEOMETRY, f"{image.name}: no direction from {found.name} to the Sun: give a light")
        turn, known = image.camera_from_inertial, found.uncertainty
        return TargetGeometry(
            target=found,
            position_camera_km=rotate(turn, apparent.position_inertial_km),
            camera_from_body=turn * apparent.inertial_from_body,
            sun_direction_camera=rotate(turn, sun),
            covariance_position_km2=turn.as_matrix() @ known.covariance_ephemeris_km2 @ turn.as_matrix().T,
        )

    def apparent(self, image: Image, target: Target) -> ApparentGeometry | Failure:
        """Compute the apparent geometry of a target in inertial axes; fails without an epoch or an observer.

        The steps: 1. observer at mid-exposure; 2. target when the light left it; 3. its orientation then; 4. the Sun as
        seen from the target then; 5. the motion of the observer: stellar aberration, and the distance by which the size
        of the body goes (:func:`~giantlike.core.light.boosted`); 6. the side that the body turns to a camera that moves
        with respect to it, and the Sun's own aberration there, up to about 1e-4 rad. The observer is that of the scene,
        else of the image. Raises as :meth:`geometry` does.
        """
        ephemeris = target.ephemeris
        if isinstance(ephemeris, ApparentGeometry):
            return ephemeris
        et = image.et
        if et is None:
            return Failure(Reason.NO_EPOCH, f"{image.name}: no epoch, so the ephemeris of {target.name} cannot be used")
        observer = self._observer_state(image, et)
        if observer is None:
            return Failure(Reason.NO_GEOMETRY, f"{image.name}: neither the image nor the scene has an observer")
        observer_km, observer_km_s = observer
        path = light_path if self.light_time else _straight
        vector, emission = path(ephemeris, et, observer_km)
        inertial_from_body = ephemeris.inertial_from_body(emission)
        sun = None
        if isinstance(self.light, Ephemeris):
            sun = unit(path(self.light, emission, observer_km + vector)[0])
        if self.stellar_aberration:
            body_km_s = ephemeris.state(emission)[1]
            turn = turn_between(aberrate(unit(vector), body_km_s), aberrate(unit(vector), observer_km_s))
            inertial_from_body = turn * inertial_from_body
            sun = None if sun is None else rotate(turn, aberrate(sun, body_km_s))
            vector = boosted(vector, observer_km_s)
        return ApparentGeometry(
            position_inertial_km=vector, inertial_from_body=inertial_from_body, sun_direction_inertial=sun
        )

    def circumstances(self, image: Image, target: str | None = None) -> Circumstances | None:
        """States by which the apparent geometry of a target follows from the geometric one.

        None where epoch or observer are not known. Of a target whose apparent geometry is given, the motion is given by
        its velocity, where known. The target and errors are as for :meth:`geometry`.
        """
        ephemeris, et = self.target(target).ephemeris, image.et
        observer = None if et is None else self._observer_state(image, et)
        if et is None or observer is None:
            return None
        position_km, velocity_km_s = observer
        if isinstance(ephemeris, ApparentGeometry):
            seen_km = boosted(ephemeris.position_inertial_km, -velocity_km_s)
            light_time_s = float(np.linalg.norm(seen_km)) / SPEED_OF_LIGHT_KM_S
            target_km_s = ephemeris.velocity_inertial_km_s
            motion_km = None if target_km_s is None else light_time_s * target_km_s
        else:
            seen_km, emission = (light_path if self.light_time else _straight)(ephemeris, et, position_km)
            light_time_s = et - emission
            target_km_s = ephemeris.state(emission)[1]
            motion_km = ephemeris.state(et)[0] - (position_km + seen_km)
        return Circumstances(
            origin=self._origin(),
            observer_position_km=position_km,
            observer_velocity_km_s=velocity_km_s,
            target_velocity_km_s=target_km_s,
            target_motion_km=motion_km,
            light_time_s=light_time_s,
        )

    def _observer_state(self, image: Image, et: float) -> tuple[Float, Float] | None:
        if self.observer is not None:
            return self.observer.state(et)
        if image.observer is not None and self._origin() == BARYCENTER:
            return image.observer.position_km, image.observer.velocity_km_s
        return None

    def _origin(self) -> str:
        parts = [self.observer, *(target.ephemeris for target in self.targets), self.light]
        return next((part.origin for part in parts if isinstance(part, Ephemeris)), BARYCENTER)

    def _names(self) -> str:
        return ", ".join(target.name for target in self.targets)


def body_mask(scene: Scene, image: Image, camera: Camera, *, margin_px: float = 5.0) -> Mask | Failure:
    """Mask (rows, columns) of the pixels that the bodies of a scene cover, for a search of stars around them.

    Parameters
    ----------
    scene : Scene
    image : Image; with the attributes that :meth:`Scene.geometry` needs
    camera : Camera
    margin_px : float, px; around the outlines, for errors of the attitude and light near a bright limb

    Returns
    -------
    (rows, columns) bool or Failure
        True on a body, lit or not, and in the margin. The outermost outline counts: bays of an irregular body are
        covered too. A target of which the camera images no limb leaves the mask as it is, unless the body fills the
        view: then everything is covered.

    Raises
    ------
    InputError
        The margin is negative.
    """
    require_number(margin_px, "margin_px", least=0.0)
    covered = np.zeros((camera.rows, camera.columns), dtype=np.uint8)
    angles = np.linspace(0.0, 2.0 * np.pi, _MASK_DIRECTIONS, endpoint=False)
    for target in scene.targets:
        geometry = scene.geometry(image, target.name)
        if isinstance(geometry, Failure):
            return geometry
        body = geometry.body()
        outline = trace_silhouette(body, camera.model, angles, sun_direction_camera=geometry.sun_direction_camera)
        limb = outline.points_px[outline.valid]
        if len(limb) >= 3:
            corners = np.clip(np.rint(limb * _SUBPIXELS), -_FAR_SUBPIXELS, _FAR_SUBPIXELS).astype(np.int32)
            cv2.fillPoly(covered, [corners], 1, shift=_SUBPIXEL_BITS)
        elif geometry.range_km <= body.shape.circumscribing_radius_km:
            covered[:] = 1
    reach = math.ceil(margin_px)
    if reach and covered.any():
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        covered = np.asarray(cv2.dilate(covered, kernel), dtype=np.uint8)
    return covered.astype(bool)


def _straight(source: Ephemeris, et: float, observer_km: Float) -> tuple[Float, float]:
    return source.state(et)[0] - observer_km, et
