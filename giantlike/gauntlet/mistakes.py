"""Kinds with a nominal image and wrong a priori data."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, Mask
from giantlike.core.frames import rotate
from giantlike.gauntlet.bodies import ROCKS, ellipsoid, relief, rock, scale_shape
from giantlike.gauntlet.plan import PSF_PX, Plan, log_uniform, star_plan
from giantlike.independent import EllipsoidBody, StarField
from giantlike.shapes import Ellipsoid

_STATED_SHARE = 0.5  # fraction of errors of size, focal length, attitude that are within the declared sigma
_SEARCH_PX = 30.0  # error of a prediction, px, that every search covers


def _about_sight(plan: Plan, angle_rad: float) -> Rotation:
    return Rotation.from_rotvec(angle_rad * plan.world.position_camera_km / plan.world.range_km)


def _direction(rng: np.random.Generator) -> Float:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def wrong_time(plan: Plan, rng: np.random.Generator) -> Plan:
    """Predict the body with its position and orientation at another time."""
    world, told = plan.world, plan.told
    late = log_uniform(rng, 0.05, 1.0) * rng.choice([-1.0, 1.0])
    angle = rng.uniform(0.0, 2.0 * math.pi)
    across = np.array([math.cos(angle), math.sin(angle), rng.uniform(-0.5, 0.5)])
    shift = late * 200.0 / world.view.focal_px * world.range_km * across
    spin = Rotation.from_rotvec([0.0, 0.0, late * math.pi])
    new = {"position_camera_km": told.position_camera_km + shift, "camera_from_body": told.camera_from_body * spin}
    return plan.but(told=new, hard=True)


def wrong_attitude(plan: Plan, rng: np.random.Generator) -> Plan:
    """Rotate the attitude by 0.1 to 3 deg, declared or not; undeclared errors are far beyond every search."""
    stated = rng.uniform() < _STATED_SHARE
    focal = plan.world.view.focal_px
    # Unstated errors start at 0.5 deg: 44 px for the camera of bodies, beyond the 40 px that searches declare.
    angle_deg = log_uniform(rng, 0.1 if stated else 0.5, 3.0)
    error = Rotation.from_rotvec(math.radians(angle_deg) * _direction(rng))
    turn = error * plan.told.attitude_error
    new: dict[str, object] = {"attitude_error": turn}
    if stated:
        new["attitude_sigma_deg"] = angle_deg / math.sqrt(3.0) * rng.uniform(0.8, 1.5)
    boresight = np.array([0.0, 0.0, 1.0])
    off_px = focal * float(np.linalg.norm(rotate(turn, boresight)[:2]))
    return plan.but(told=new, hard=off_px > _SEARCH_PX and plan.world.sky is None)


def wrong_roll(plan: Plan, rng: np.random.Generator) -> Plan:
    """Roll the camera about its boresight by 3 to 8 degrees."""
    angle = math.radians(rng.uniform(3.0, 8.0)) * rng.choice([-1.0, 1.0])
    error = Rotation.from_rotvec([0.0, 0.0, angle]) * plan.told.attitude_error
    return plan.but(told={"attitude_error": error}, hard=True)


def wrong_scale(plan: Plan, rng: np.random.Generator, *, share: float) -> Plan:
    """Assume a body too large or too small by a fraction of its size."""
    told = plan.told
    assert told.shape is not None
    new: dict[str, object] = {"shape": scale_shape(told.shape, 1.0 + share * rng.choice([-1.0, 1.0]))}
    if rng.uniform() < _STATED_SHARE:
        new["scale_sigma"] = share
    return plan.but(told=new, hard=True)


def focal(plan: Plan, rng: np.random.Generator) -> Plan:
    """Assume a focal length with an error of 2 %; half of them are declared with that uncertainty."""
    new = {"focal_factor": 1.0 + 0.02 * rng.choice([-1.0, 1.0])}
    if rng.uniform() < _STATED_SHARE:
        new["focal_sigma"] = 0.015
    return plan.but(told=new, hard=True)


def pole(plan: Plan, rng: np.random.Generator) -> Plan:
    """Tip the pole by 10, 30, 90 or 180 degrees."""
    angle = math.radians(rng.choice([10.0, 30.0, 90.0, 180.0]))
    around = rng.uniform(0.0, 2.0 * math.pi)
    tip = Rotation.from_rotvec(angle * np.array([math.cos(around), math.sin(around), 0.0]))
    return plan.but(told={"camera_from_body": plan.told.camera_from_body * tip}, hard=True)


def _spun(plan: Plan, rng: np.random.Generator, angle_deg: float) -> Plan:
    spin = Rotation.from_rotvec([0.0, 0.0, math.radians(angle_deg) * rng.choice([-1.0, 1.0])])
    return plan.but(told={"camera_from_body": plan.told.camera_from_body * spin}, hard=True)


def rotation(plan: Plan, rng: np.random.Generator) -> Plan:
    """Turn the body about its pole by 20 to 180 degrees."""
    return _spun(plan, rng, rng.uniform(20.0, 180.0))


def slight_rotation(plan: Plan, rng: np.random.Generator) -> Plan:
    """Turn the body about its pole by 3 to 30 degrees."""
    return _spun(plan, rng, log_uniform(rng, 3.0, 30.0))


def _which_rock(plan: Plan) -> int:
    """Number of the rock of a plan."""
    for number in range(ROCKS):
        if rock(number)[1] is plan.told.shape:
            return number
    raise AssertionError("the plan has no rock")


def stale_shape(plan: Plan, rng: np.random.Generator) -> Plan:
    """Give the body relief of 1 to 5 % that its shape model does not have."""
    rms = float(rng.choice([0.01, 0.02, 0.05]))
    body, _ = rock(_which_rock(plan), relief(int(rng.integers(4)), rms))
    return plan.but(world={"body": body}, hard=True)


def foreign_shape(plan: Plan, rng: np.random.Generator) -> Plan:
    """Tell the shape of another body, of the same volume."""
    assert plan.told.shape is not None
    _, other = rock(_which_rock(plan) + int(rng.integers(1, ROCKS)))
    factor = plan.told.shape.mean_radius_km / other.mean_radius_km
    return plan.but(told={"shape": scale_shape(other, factor)}, hard=True)


def sphere_for_rock(plan: Plan, rng: np.random.Generator) -> Plan:
    """Tell a sphere of the same volume."""
    assert plan.told.shape is not None
    return plan.but(told={"shape": Ellipsoid(radii_km=np.full(3, plan.told.shape.mean_radius_km))}, hard=True)


def wrong_axes(plan: Plan, rng: np.random.Generator) -> Plan:
    """Tell half axes that are 5 to 20 % off, of the same volume."""
    body = plan.world.body
    assert isinstance(body, EllipsoidBody)
    factors = np.exp(log_uniform(rng, 0.05, 0.2) * rng.choice([-1.0, 1.0], size=3) * rng.uniform(0.3, 1.0, 3))
    factors /= np.cbrt(np.prod(factors))
    _, told = ellipsoid(np.asarray(body.radii_km, dtype=float) * factors)
    return plan.but(told={"shape": told}, hard=True)


def wrong_sun(plan: Plan, rng: np.random.Generator) -> Plan:
    """Turn the Sun about the line of sight or about any axis by 20 to 180 degrees."""
    angle = math.radians(rng.uniform(20.0, 180.0))
    turn = _about_sight(plan, angle) if rng.uniform() < 0.5 else Rotation.from_rotvec(angle * _direction(rng))
    return plan.but(told={"sun": rotate(turn, plan.told.sun)}, hard=True)


def wrong_psf(plan: Plan, rng: np.random.Generator) -> Plan:
    """Tell optics 0.4 to 2 times as wide as they are."""
    factor = log_uniform(rng, 0.4, 2.0)
    return plan.but(told={"psf_px": PSF_PX * factor}, hard=abs(factor - 1.0) > 0.3)


def wrong_law(plan: Plan, rng: np.random.Generator) -> Plan:
    """Render another reflectance law than the assumed one."""
    laws = ["mcewen", "lambert", "lommel_seeliger", "minnaert", "hapke"]
    others = [law for law in laws if law != plan.told.law]
    return plan.but(world={"law": str(rng.choice(others))}, hard=False)


def gaps(plan: Plan, rng: np.random.Generator) -> Plan:
    """Leave stars out of the catalog."""
    known = plan.told.catalog
    assert known is not None
    kept = rng.uniform(size=known.magnitudes.size) < rng.uniform(0.2, 0.8)
    return plan.but(told={"catalog": _stars(known, kept)}, hard=bool(kept.mean() < 0.4))


def other_sky(plan: Plan, rng: np.random.Generator) -> Plan:
    """Tell stars that are elsewhere."""
    other = star_plan(rng).world
    assert other.sky is not None
    to_here = plan.world.attitude.inv() * other.attitude
    field = StarField(directions=rotate(to_here, other.sky.directions), magnitudes=other.sky.magnitudes)
    return plan.but(told={"catalog": field}, hard=True)


def _stars(field: StarField, kept: Mask) -> StarField:
    return StarField(directions=field.directions[kept], magnitudes=field.magnitudes[kept])


def observer(plan: Plan, rng: np.random.Generator) -> Plan:
    """State no velocity of the observer, or one in m/s."""
    if rng.uniform() < 0.5:
        return plan.but(told={"observer_known": False}, hard=False)
    return plan.but(told={"observer_factor": 1000.0}, hard=True)
