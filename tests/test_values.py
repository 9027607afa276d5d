"""Values stay values: their arrays cannot be changed, and covariances and directions are what their names say."""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest

import giantlike
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.outcomes import CenterFix
from giantlike.core.values import Value


def fix(covariance_px2: object = None) -> CenterFix:
    return CenterFix(
        estimator="moment",
        target="ROCK",
        center_px=np.array([1.0, 2.0]),
        covariance_px2=np.eye(2) if covariance_px2 is None else np.asarray(covariance_px2),
        predicted_px=np.zeros(2),
        residuals=np.zeros(3),
        n_used=3,
        n_rejected=0,
        score=1.0,
    )


def test_an_array_of_a_value_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        fix().center_px[0] = 99.0


def test_the_array_of_the_caller_stays_writable() -> None:
    center = np.zeros(2)
    made = replace(fix(), center_px=center)
    center[0] = 1.0
    assert not made.center_px.flags.writeable


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        ([[1.0, 0.5], [0.4, 1.0]], "symmetric"),
        ([[1.0, 2.0], [2.0, 1.0]], "positive semi-definite"),
        ([[-1.0, 0.0], [0.0, 1.0]], "negative variance"),
        ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "square"),
    ],
)
def test_a_matrix_that_is_no_covariance_is_refused(covariance: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        fix(covariance)


def test_units_do_not_matter_to_the_check_of_a_covariance() -> None:
    sigma = np.array([1e-9, 1e6])
    assert fix(np.outer(sigma, sigma) * [[1.0, 0.999], [0.999, 1.0]]).covariance_px2.shape == (2, 2)
    with pytest.raises(InputError, match="positive semi-definite"):
        fix(np.outer(sigma, sigma) * [[1.0, 1.001], [1.001, 1.0]])


def test_a_direction_must_be_a_unit_vector() -> None:
    @dataclass(frozen=True, slots=True, eq=False)
    class Sun(Value):
        sun_direction_camera: Float

    assert Sun(np.array([0.0, 0.6, 0.8])).sun_direction_camera[2] == 0.8
    with pytest.raises(InputError, match="unit vectors"):
        Sun(np.array([0.0, 0.6, 0.9]))


def dataclasses_of_the_package() -> list[Any]:
    found = []
    for info in pkgutil.walk_packages(giantlike.__path__, "giantlike."):
        if info.name.endswith("__main__") or info.name.startswith("giantlike.independent"):
            continue  # the independent truth shares no base either
        module = importlib.import_module(info.name)
        found += [kind for kind in vars(module).values() if isinstance(kind, type) and is_dataclass(kind)]
    own = [kind for kind in found if not kind.__module__.startswith("giantlike.independent")]
    return [kind for kind in own if kind.__module__.startswith("giantlike") and not kind.__name__.startswith("_")]


def test_every_public_dataclass_with_array_fields_is_a_value() -> None:
    arrays = ("Float", "Mask", "NDArray", "Indices")
    loose = {
        f"{kind.__module__}.{kind.__qualname__}"
        for kind in dataclasses_of_the_package()
        if not issubclass(kind, Value) and any(str(field.type).startswith(arrays) for field in fields(kind))
    }
    assert loose == set()


def test_every_value_runs_its_checks() -> None:
    unchecked = {
        f"{kind.__module__}.{kind.__qualname__}"
        for kind in dataclasses_of_the_package()
        if issubclass(kind, Value)
        and kind.__post_init__ is not Value.__post_init__
        and not {"Value", "_keep"} & set(kind.__post_init__.__code__.co_names)
    }
    assert unchecked == set()
