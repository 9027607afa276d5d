"""Kinds whose scene differs from the assumed one: other bodies, other illumination, or none."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.core.frames import rotate
from giantlike.gauntlet import lights
from giantlike.gauntlet.bodies import EclipsedBody, ellipsoid, markings, rock
from giantlike.gauntlet.plan import Plan, World, log_uniform, star_plan, sun_at
from giantlike.independent import Body, EllipsoidBody, ReliefBody, Sampling

_THINNEST_DEG = 1.0  # minimum distance of the phase angle from 180, deg
_CRESCENT = Sampling(cells=6, edge_rays=10)  # rays for thin crescents: 3,600 a pixel at the edge
_DUST_CORE = 0.5  # distance, in radii of the nucleus, within which a coma does not rise any more


def _move_target(plan: Plan, place_px: Float, *, sun: Float | None = None, predicted: bool = True) -> Plan:
    """The plan with the target, and its prediction, at another position in the image."""
    world, told = plan.world, plan.told
    sight = world.view.directions(place_px)
    position = world.range_km * sight / np.linalg.norm(sight)
    change = position - world.position_camera_km
    new: dict[str, object] = {"position_camera_km": position}
    known: dict[str, object] = {"position_camera_km": told.position_camera_km + change} if predicted else {}
    if sun is not None:
        new["sun"] = known["sun"] = sun
    return plan.but(world=new, told=known, hard=False)


def _diameter_px(world: World) -> float:
    assert world.body is not None
    return 2.0 * world.body.bounding_radius_km / world.range_km * world.view.focal_px


def thin_crescent(plan: Plan, rng: np.random.Generator) -> Plan:
    """Move the Sun behind the body."""
    left_deg = log_uniform(rng, _THINNEST_DEG, 55.0)
    sight = plan.world.position_camera_km / plan.world.range_km
    sun = sun_at(rng, sight, math.radians(180.0 - left_deg))
    sampling = {"sampling": _CRESCENT} if isinstance(plan.world.body, EllipsoidBody) else {}
    return plan.but(world={"sun": sun, **sampling}, told={"sun": sun}, hard=False)


def filling(plan: Plan, rng: np.random.Generator) -> Plan:
    """Move a large body so that its limb crosses the frame, or that the frame is filled."""
    world = plan.world
    angle = rng.uniform(0.0, 2.0 * math.pi)
    middle = 0.5 * np.array([world.view.columns - 1, world.view.rows - 1])
    away = rng.uniform(0.0, 1.0) * 0.5 * _diameter_px(world)
    outward = np.array([math.cos(angle), math.sin(angle)])
    # The limb toward the Sun is the one in view, for the images in which one is.
    sight = world.position_camera_km / world.range_km
    sun = -math.cos(world.phase_rad) * sight
    side = np.array([-outward[0], -outward[1], 0.0])
    side -= (side @ sight) * sight
    sun = sun + math.sin(world.phase_rad) * side / np.linalg.norm(side)
    return _move_target(plan, middle + away * outward, sun=sun)


def partly_outside(plan: Plan, rng: np.random.Generator) -> Plan:
    """Move the body over the edge of the frame."""
    return _move_target(plan, _place_at_edge(plan.world, rng, (-0.4, 0.4)))


def outside(plan: Plan, rng: np.random.Generator) -> Plan:
    """Move the body out of the frame; half of them are still predicted inside."""
    place = _place_at_edge(plan.world, rng, (0.55, 1.55), more_px=8.0)
    return _move_target(plan, place, predicted=rng.uniform() < 0.5).but(hard=True)


def _place_at_edge(
    world: World, rng: np.random.Generator, diameters: tuple[float, float], *, more_px: float = 0.0
) -> Float:
    """Position in the image, given as diameters of the body beyond one of its edges; negative is inside."""
    size = np.array([world.view.columns - 1, world.view.rows - 1], dtype=float)
    place: Float = rng.uniform(0.2, 0.8, 2) * size
    axis = int(rng.integers(2))
    beyond = rng.uniform(*diameters) * _diameter_px(world) + more_px
    place[axis] = -beyond if rng.uniform() < 0.5 else size[axis] + beyond
    return place


def _some_body(rng: np.random.Generator, radius_km: float) -> tuple[Body, Sampling | None]:
    """Another figure of about a size: a rock or an ellipsoid."""
    if rng.uniform() < 0.3:
        known, _ = rock(int(rng.integers(100)))
        factor = radius_km / known.bounding_radius_km
        return ReliefBody(np.asarray(known.radii_km) * factor, known.relief), Sampling(cells=2, edge_rays=3)
    axes = radius_km * np.array([1.0, rng.uniform(0.6, 1.0), rng.uniform(0.6, 1.0)])
    return EllipsoidBody(axes), None


def wrong_target(plan: Plan, rng: np.random.Generator) -> Plan:
    """Put another body, of another size, where the target should be; the target is not in the image."""
    world = plan.world
    factor = log_uniform(rng, 1.12, 2.0) ** rng.choice([-1.0, 1.0])
    body, sampling = _some_body(rng, world.body.bounding_radius_km * factor if world.body else factor)
    aside = rng.normal(scale=8.0, size=2)
    sight = world.view.directions(world.center_px + aside)
    place = world.range_km * sight / np.linalg.norm(sight)
    light = lights.other_body(body, place, 1.0)
    new = {"body": None, "lights": (light, *world.lights), "sampling": sampling}
    return plan.but(world=new, hard=True)


def two_bodies(plan: Plan, rng: np.random.Generator) -> Plan:
    """Add a second body next to the target."""
    world = plan.world
    diameter = _diameter_px(world)
    size = log_uniform(rng, 0.3, 1.5)
    assert world.body is not None
    body, _ = _some_body(rng, size * world.body.bounding_radius_km)
    place = _beside(world, rng, (0.55 * (1.0 + size) * diameter + 4.0, 0.9 * (1.0 + size) * diameter + 60.0))
    light = lights.other_body(body, place, log_uniform(rng, 0.3, 2.0))
    return plan.but(world={"lights": (light, *world.lights)}, hard=True)


def _beside(world: World, rng: np.random.Generator, away_px: tuple[float, float]) -> Float:
    """Position next to the target, in camera axes, km, at a distance in px."""
    angle = rng.uniform(0.0, 2.0 * math.pi)
    offset = rng.uniform(*away_px) * np.array([math.cos(angle), math.sin(angle)])
    sight = world.view.directions(world.center_px + offset)
    return world.range_km * sight / np.linalg.norm(sight)


def twin(plan: Plan, rng: np.random.Generator) -> Plan:
    """Add the target a second time, at another position."""
    world = plan.world
    diameter = _diameter_px(world)
    assert world.body is not None
    place = _beside(world, rng, (1.1 * diameter + 6.0, 2.0 * diameter + 40.0))
    light = lights.other_body(world.body, place, log_uniform(rng, 0.8, 1.25))
    return plan.but(world={"lights": (light, *world.lights)}, hard=True)


def moon(plan: Plan, rng: np.random.Generator) -> Plan:
    """Put a moon between camera and target."""
    body, place = lights.moon_of(rng, plan.world)
    light = lights.other_body(body, place, log_uniform(rng, 0.5, 1.5), in_front=True)
    return plan.but(world={"lights": (light, *plan.world.lights)}, hard=True)


def add_rings(plan: Plan, rng: np.random.Generator) -> Plan:
    """Add rings."""
    inner = rng.uniform(1.15, 1.6)
    light = lights.rings(
        inner=inner,
        outer=inner + rng.uniform(0.1, 0.8),
        brightness=log_uniform(rng, 0.05, 0.8),
        opacity=rng.uniform(0.1, 0.9),
    )
    return plan.but(world={"lights": (light, *plan.world.lights)}, hard=True)


def eclipse(plan: Plan, rng: np.random.Generator) -> Plan:
    """Let the shadow of another body fall on part of the disk."""
    world = plan.world
    assert world.body is not None
    radius = world.body.bounding_radius_km
    to_body = world.camera_from_body.inv()
    sun = rotate(to_body, world.sun)
    view = rotate(to_body, -world.position_camera_km / world.range_km)
    middle = sun + view + 0.5 * rng.normal(size=3)
    through = 0.9 * radius * middle / np.linalg.norm(middle)
    body = EclipsedBody(
        body=world.body,
        sun=sun,
        through_km=through,
        radius_km=radius * log_uniform(rng, 0.2, 1.0),
        penumbra_km=radius * log_uniform(rng, 0.02, 0.5),
    )
    return plan.but(world={"body": body}, hard=True)


def comet(plan: Plan, rng: np.random.Generator) -> Plan:
    """Surround the target with dust."""
    brightness = log_uniform(rng, 0.003, 0.5)
    core = _DUST_CORE * _diameter_px(plan.world)
    light = lights.coma(brightness=brightness, core_px=max(core, 1.0), fan=rng.uniform(0.0, 3.0))
    return plan.but(world={"lights": (light, *plan.world.lights)}, hard=brightness > 0.01)


def add_markings(plan: Plan, rng: np.random.Generator) -> Plan:
    """Paint the body with markings of 5 to 20 %."""
    body = plan.world.body
    assert isinstance(body, EllipsoidBody)
    field = markings(int(rng.integers(4)), float(rng.choice([0.05, 0.1, 0.2])))
    painted, _ = ellipsoid(np.asarray(body.radii_km, dtype=float), field)
    return plan.but(world={"body": painted}, hard=False)


def dense_stars(plan: Plan, rng: np.random.Generator) -> Plan:
    """Fill the sky behind the body with stars."""
    count = int(log_uniform(rng, 50.0, 3000.0))
    light = lights.field_stars(count, 30.0, 20_000.0)
    return plan.but(world={"lights": (light, *plan.world.lights)}, hard=count > 150)


def add_faint_stars(plan: Plan, rng: np.random.Generator) -> Plan:
    """Add stars that are fainter than the catalog, and many."""
    count = int(log_uniform(rng, 300.0, 8000.0))
    light = lights.field_stars(count, 20.0, 400.0)
    return plan.but(world={"lights": (light, *plan.world.lights)}, hard=count > 2000)


def noise(plan: Plan, rng: np.random.Generator) -> Plan:
    """Take all light away."""
    return plan.but(world={"body": None, "sky": None}, hard=True)


def with_sky(plan: Plan, rng: np.random.Generator) -> Plan:
    """Put the body before a field of stars of the catalog, at the focal length of the star camera."""
    stars = star_plan(rng)
    world, told = plan.world, plan.told
    # The body keeps its size in the image of the star camera by coming nearer.
    factor = stars.world.view.focal_px / world.view.focal_px
    sight = stars.world.view.directions(rng.uniform(140.0, 370.0, 2))
    position = factor * world.range_km * sight / np.linalg.norm(sight)
    turn = Rotation.align_vectors(position[None, :], world.position_camera_km[None, :])[0]
    change = factor * rotate(turn, told.position_camera_km - world.position_camera_km)
    moved_world = {
        "view": stars.world.view,
        "attitude": stars.world.attitude,
        "sky": stars.world.sky,
        "velocity_km_s": stars.world.velocity_km_s,
        "position_camera_km": position,
        "sun": rotate(turn, world.sun),
    }
    moved_told = {
        "position_camera_km": position + change,
        "sun": rotate(turn, told.sun),
        "ephemeris_sigma_km": factor * told.ephemeris_sigma_km,
        "catalog": stars.told.catalog,
    }
    return plan.but(world=moved_world, told=moved_told, hard=False)
