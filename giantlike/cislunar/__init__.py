"""Navigation filter between Earth and Moon: measurements of a round body, batch estimate, linear covariance."""

from giantlike.cislunar.batch import estimate_batch
from giantlike.cislunar.filter import BodyObservation, FilterModel, FilterState, measurement_update, time_update
from giantlike.cislunar.measurement_errors import BodyErrorModel
from giantlike.cislunar.udu import udu_factors

__all__ = [
    "BodyErrorModel",
    "BodyObservation",
    "FilterModel",
    "FilterState",
    "estimate_batch",
    "measurement_update",
    "time_update",
    "udu_factors",
]
