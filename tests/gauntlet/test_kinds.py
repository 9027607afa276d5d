"""Kinds of the gauntlet: each changes the image or what is told of it, and all follows from seed and number."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from giantlike.core.arrays import Float
from giantlike.gauntlet import KINDS, Kind, stage_of
from giantlike.gauntlet.plan import Base, Plan, body_plan, star_plan
from giantlike.gauntlet.stage import deck, expose, kind_of

SMALL = Base(diameter_px=(24.0, 28.0), rocks=0.0, phase_deg=(30.0, 60.0))
ROCKY = replace(SMALL, rocks=1.0)
ON_ROCKS = ("rotation", "stale_shape", "foreign_shape", "sphere_for_rock", "large_rock_turned")
NOISE_DN = 5.0


def undisturbed(kind: Kind) -> Plan:
    """A cheap image of a kind with nothing wrong."""
    rng = np.random.default_rng([4, 5])
    return body_plan(rng, ROCKY if kind.name in ON_ROCKS else SMALL) if kind.body else star_plan(rng)


def pixels(plan: Plan) -> Float:
    return expose(plan.world, np.random.default_rng(6))[1]


def differs(plan: Plan, other: Plan, part: str) -> bool:
    one, two = getattr(plan, part), getattr(other, part)
    pairs = [(getattr(one, field.name), getattr(two, field.name)) for field in fields(one)]
    return any(not np.array_equal(a, b) if isinstance(a, np.ndarray) else a is not b for a, b in pairs)


@pytest.mark.parametrize("kind", [kind for kind in KINDS.values() if "nominal" not in kind.name], ids=lambda k: k.name)
def test_every_kind_changes_the_image_or_what_is_told(kind: Kind) -> None:
    before = undisturbed(kind)
    after = kind.disturb(before, np.random.default_rng([7, 8]))
    if kind.name in ("point", "large_rock"):
        assert after is before  # nothing is wrong but the size
    elif differs(after, before, "world"):
        image = pixels(after)
        assert np.isfinite(image).all()
        if image.shape == pixels(before).shape:
            assert np.abs(image - pixels(before)).max() > NOISE_DN
    else:
        assert differs(after, before, "told")


def test_a_deck_holds_every_kind_and_a_tenth_or_so_is_nominal() -> None:
    names = deck(3)
    assert set(names) == set(KINDS)
    assert len(KINDS) > 30
    assert 0.07 < sum("nominal" in name for name in names) / len(names) < 0.2
    assert deck(4) != names


def test_an_image_follows_from_seed_and_number_alone() -> None:
    number = next(number for number in range(200) if kind_of(3, number).name == "radiation")
    stage_of(3, number + 1)
    first, second = stage_of(3, number), stage_of(3, number)
    assert_array_equal(first.image.pixels, second.image.pixels)
    assert first.camera.to_mapping() == second.camera.to_mapping()
    assert (first.image.pixels != stage_of(4, number).image.pixels.max()).any()


def test_the_undisturbed_image_has_the_same_scene_and_the_same_errors_of_what_is_told() -> None:
    number = next(number for number in range(200) if kind_of(3, number).name == "scale_5")
    stage = stage_of(3, number)
    wrong, right = stage.plan, stage.undisturbed.plan
    assert_array_equal(stage.image.pixels, stage.undisturbed.image.pixels)
    assert_array_equal(wrong.world.position_camera_km, right.world.position_camera_km)
    assert_array_equal(wrong.told.position_camera_km, right.told.position_camera_km)
    assert wrong.told.shape is not None
    assert right.told.shape is not None
    ratio = wrong.told.shape.mean_radius_km / right.told.shape.mean_radius_km
    assert_allclose(abs(ratio - 1.0), 0.05, rtol=0, atol=1e-9)


def test_errors_of_what_is_told_are_as_large_as_is_stated() -> None:
    """Of predictions, in units of the sigma stated: mean square 1, cut off at 3."""
    errors = []
    for number in range(60):
        plan = body_plan(np.random.default_rng([9, number]), replace(SMALL, declared=1.0))
        miss = plan.told.position_camera_km - plan.world.position_camera_km
        errors.append(miss / plan.told.ephemeris_sigma_km)
    assert 0.75 < float(np.mean(np.square(errors))) < 1.25  # 180 numbers: 1 +- 0.1
    assert np.abs(errors).max() <= 3.0
