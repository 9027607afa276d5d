"""The filter beside the extended Kalman filter of Stone Soup, an independent tracking library."""

from __future__ import annotations

import datetime
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.cislunar import BodyObservation, measurement_update, time_update
from giantlike.cislunar.filter import coast, predict_measurement, step_ends
from giantlike.core.arrays import Float
from tests.cislunar.cislunar_case import MODEL, START_ET
from tests.cislunar.test_cislunar_filter import correlated_start, images, turned_sum
from tests.tolerances import FLOAT64_SUM


def models() -> tuple[Any, Any]:
    """Classes of models that Stone Soup is given: a step of flight, and what an image predicts."""
    from stonesoup.models.base import GaussianModel
    from stonesoup.models.measurement.base import MeasurementModel
    from stonesoup.models.transition.base import TransitionModel
    from stonesoup.types.array import CovarianceMatrix, StateVector

    class Flight(TransitionModel, GaussianModel):  # type: ignore[misc]
        ndim_state = 21
        step: Any = None

        def function(self, state: Any, noise: bool = False, **_: Any) -> Any:
            return StateVector(self.step.mean)

        def jacobian(self, state: Any, **_: Any) -> Float:
            return np.asarray(self.step.matrix())

        def covar(self, **_: Any) -> Any:
            return CovarianceMatrix(self.step.noise())

    class Sighting(MeasurementModel, GaussianModel):  # type: ignore[misc]
        ndim_meas = 3
        seen: Any = None

        def function(self, state: Any, noise: bool = False, **_: Any) -> Any:
            return StateVector(predict_measurement(self.seen, np.ravel(state.state_vector).astype(float))[0])

        def jacobian(self, state: Any, **_: Any) -> Float:
            return predict_measurement(self.seen, np.ravel(state.state_vector).astype(float))[1]

        def covar(self, **_: Any) -> Any:
            return CovarianceMatrix(np.diag(self.seen.variances))

    return Flight, Sighting


def by_stone_soup(seen: list[BodyObservation]) -> tuple[Float, Float]:
    """Mean and covariance after all images."""
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import ExtendedKalmanUpdater

    flight_class, sighting_class = models()
    zero = datetime.datetime(2019, 12, 17)
    start = correlated_start()
    state, et = GaussianState(start.mean, start.factors.composed(), timestamp=zero), start.et
    for observation in seen:
        for end in step_ends(et, observation.et, MODEL.longest_step_s):
            flight = flight_class()
            flight.step = coast(MODEL, et, np.ravel(state.state_vector).astype(float), end)
            et = end
            predictor = ExtendedKalmanPredictor(flight)
            state = predictor.predict(state, timestamp=zero + datetime.timedelta(seconds=end - START_ET))
        sighting = sighting_class(ndim_state=21, mapping=tuple(range(21)))
        sighting.seen = observation
        found = Detection(observation.measured, timestamp=state.timestamp, measurement_model=sighting)
        before = np.ravel(state.state_vector).astype(float)
        updated = ExtendedKalmanUpdater(use_joseph_cov=True).update(SingleHypothesis(state, found))
        mean = turned_sum(before, np.ravel(updated.state_vector).astype(float) - before)
        state = GaussianState(mean, updated.covar, timestamp=state.timestamp)
    return np.ravel(state.state_vector).astype(float), np.asarray(state.covar, dtype=float)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_filter_agrees_with_stone_soup() -> None:
    pytest.importorskip("stonesoup")
    seen = images(np.random.default_rng(5))
    mean, covariance = by_stone_soup(seen)
    state = correlated_start()
    for observation in seen:
        state, _ = measurement_update(time_update(state, observation.et, MODEL), observation, MODEL)
    sigma = np.sqrt(np.diag(covariance))
    scale = np.outer(sigma, sigma)
    assert_allclose(state.factors.composed() / scale, covariance / scale, atol=FLOAT64_SUM)
    assert_allclose((state.mean - mean) / sigma, 0.0, atol=FLOAT64_SUM)
