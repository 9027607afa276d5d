"""Jobs of ``speed.py`` that trace little or nothing: estimators on horizons and on light, in frames of 1024 x 1024 px.

Each estimator is timed as it is used, with the verification behind it, and alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from speed import Job
from speed_bodies import ROCK, estimated, fresh, judge
from stress_truth import Case, Draw

from giantlike.core.outcomes import Failure
from giantlike.relative import ESTIMATORS
from giantlike.relative.estimator import BodyEstimator
from giantlike.relative.inputs import gather

ELLIPSOID = Case(name="speed", frame_px=1024, diameter_px=300.0)


def alone(name: str, draw: Draw) -> Any:
    """Run an estimator without error budget and verification."""
    estimator: BodyEstimator[Any, Any] = ESTIMATORS[name]()  # type: ignore[assignment]
    camera, options = draw.seen.camera, estimator.options
    inputs = gather(draw.image, camera, draw.scene, None, estimator=name, options=options)
    return inputs if isinstance(inputs, Failure) else estimator._estimate(inputs)


def jobs() -> list[Job]:
    """The rows of these estimators."""
    small, point = replace(ELLIPSOID, diameter_px=30.0), replace(ROCK, diameter_px=2.0)
    rows = (
        ("ellipsoid_cra", "300 px", 0.25, ELLIPSOID),
        ("ellipsoid_cra", "30 px", 0.25, small),
        ("sigmoid_limb", "300 px", 0.25, ELLIPSOID),
        ("ellipse_fit", "300 px", 0.5, ELLIPSOID),
        ("ellipse_fit", "30 px", 0.5, small),
        ("moment", "300 px", 0.5, ROCK),
        ("moment", "30 px", 0.5, replace(ROCK, diameter_px=30.0)),
        ("unresolved", "2 px", 0.15, point),
        ("unresolved", "8 px", 0.15, replace(ROCK, diameter_px=8.0)),
    )
    found = []
    for name, size, goal_u, case in rows:
        given = fresh(case)
        verified = Job(name=f"{name}, {size}", goal_u=goal_u, fresh=given, run=estimated(name), judge=judge)
        bare = replace(verified, name=f"{name} alone, {size}", run=lambda draw, name=name: alone(name, draw))
        found += [verified, bare]
    return found
