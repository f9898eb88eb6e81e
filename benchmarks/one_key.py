"""The one-key solve: cost per factor, growth with the readings, and against a naive peer.

The peer is what one would write in an afternoon: scikit-learn's Gaussian process per axis and
scipy's least_squares over t, C and H together, with numeric derivatives. Both get the same
readings and the same hyperparameters. Its answer is another by as much as it weighs readings
otherwise, which the last table shows step by step.
"""

from collections.abc import Callable
from functools import partial

import gtsam
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from benchmarks.dipole_hall import NOISE, hall, survey
from benchmarks.timing import seconds
from l2m_factors import BatchedReadings, D, MagneticReadings, T, block_factor, reading_factor
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.one_key import solve_one_key
from l2m_gtsam.calibration.view import observe
from l2m_gtsam.data import FloatArray, KnownSensor, Readings
from l2m_gtsam.maps.sliding_gp import SlidingGP
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.solve.noise import map_covariance, reading_covariance, whitening
from tests.worlds.exact import drive, random_sensors


def factor_costs() -> Table:
    """Linearise the same readings as one factor each and as one block."""
    world, sensors = hall(0), random_sensors(0, 12)
    readings = drive(0, sensors, world, count=2000, noise=NOISE)
    data = survey(world, 8000)
    field_map = SlidingGP.fit(data.points, data.field)
    magnetic = MagneticReadings(
        readings.sensor, readings.R_map_lidar, readings.p_map_lidar, readings.field
    )
    values = gtsam.Values()
    for i, sensor in enumerate(sensors):
        values.insert(T(i), sensor.t_lidar_mag)
        values.insert(D(i), sensor.distortion.vector())
    batch = BatchedReadings(field_map, magnetic)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, NOISE)
    W = np.broadcast_to(np.eye(3) / NOISE, (len(batch), 3, 3))
    forms = {"one factor per reading": gtsam.NonlinearFactorGraph()}
    for n in range(len(batch)):
        forms["one factor per reading"].add(reading_factor(batch, n, noise))
    forms["one factor per sensor"] = gtsam.NonlinearFactorGraph()
    for i in batch.sensors:
        forms["one factor per sensor"].add(block_factor(batch, i, W))
    query = seconds(lambda: field_map.field_and_gradient(readings.p_map_lidar))
    table = Table("linearisation of 24,000 readings", "s", "us per reading")
    table.add_row("map query alone", f"{query:.3f}", f"{query / len(batch) * 1e6:.2f}")
    for name, graph in forms.items():
        graph.linearize(values)  # evaluates the map; what follows is the factors' own cost
        cost = seconds(partial(graph.linearize, values))
        table.add_row(f"{name}, map cached", f"{cost:.3f}", f"{cost / len(batch) * 1e6:.2f}")
    return table


def growth() -> Table:
    """Solve with more and more readings; the exponent of the last decade is printed."""
    world, sensors = hall(1), random_sensors(1, 12)
    data = survey(world, 8000)
    field_map = SlidingGP.fit(data.points, data.field)
    table = Table("readings (12 sensors)", "s", "ms per 1,000 readings")
    sizes, costs = [1_000, 5_000, 12_000, 24_000, 50_000], []
    for size in sizes:
        readings = drive(2, sensors, world, count=size // 12, noise=NOISE)
        start = np.zeros((12, 3))
        solve = partial(solve_one_key, readings, field_map, start, OneKeyOptions())
        cost = seconds(solve, 1)
        costs.append(cost)
        table.add_row(f"{size:,}", f"{cost:.2f}", f"{cost / size * 1e6:.0f}")
    exponent = np.polyfit(np.log(sizes[1:]), np.log(costs[1:]), 1)[0]
    table.add_row("exponent from 5,000 to 50,000", f"{exponent:.2f}", "(1 is linear)")
    return table


def one_sensor() -> tuple[KnownSensor, Readings, TrainingSet, SlidingGP]:
    """Return a sensor, 2,000 readings of it, and a survey of 3,000 with our map of it."""
    world, sensors = hall(2), random_sensors(2, 1)
    data, readings = survey(world, 3000), drive(3, sensors, world, count=2000, noise=NOISE)
    return sensors[0], readings, data, SlidingGP.fit(data.points, data.field)


def naive_field(data: TrainingSet, field_map: SlidingGP) -> Callable[[FloatArray], FloatArray]:
    """Return the field of a survey, a process per axis, with the hyperparameters of our map."""
    h = field_map.trained.hyperparameters
    kernel = ConstantKernel(h.signal**2) * RBF(h.length_scale)
    mean = data.field.mean(axis=0)  # scikit-learn's process has mean zero
    axes = [
        GaussianProcessRegressor(kernel, alpha=h.noise**2, optimizer=None).fit(data.points, column)
        for column in (data.field - mean).T
    ]
    return lambda points: np.column_stack([axis.predict(points) for axis in axes]) + mean


def least_squares_solution(
    readings: Readings, field: Callable[[FloatArray], FloatArray], W: FloatArray
) -> FloatArray:
    """Return (t, C, H) of one sensor as the peer finds it in a field.

    ``W`` is what residuals are multiplied with, shape (N, 3, 3).
    """
    R, p, z = readings.R_map_lidar, readings.p_map_lidar, readings.field

    def residual(x: FloatArray) -> FloatArray:
        b = np.einsum("nji,nj->ni", R, field(R @ x[:3] + p))
        e = b @ x[3:12].reshape(3, 3).T + x[12:] - z
        return np.asarray(np.einsum("nij,nj->ni", W, e).ravel())

    start = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)])
    return np.asarray(least_squares(residual, start).x)


def against_the_peer() -> Table:
    """Solve one sensor on our map and on the peer's."""
    sensor, readings, data, field_map = one_sensor()
    peer, equal = naive_field(data, field_map), np.broadcast_to(np.eye(3), (len(readings), 3, 3))
    ours: list[FloatArray] = []
    peers: list[FloatArray] = []

    def solve() -> None:
        solution = solve_one_key(readings, field_map, np.zeros((1, 3)), OneKeyOptions())
        ours.append(solution.estimate.vector(0))

    fast = seconds(solve)
    slow = seconds(lambda: peers.append(least_squares_solution(readings, peer, equal)), 1)
    table = Table("one sensor, 2,000 readings, map of 3,000", "s", "|error of t| (mm)")
    for name, cost, answer in (("l2m_gtsam", fast, ours), ("scikit-learn + scipy", slow, peers)):
        error = np.linalg.norm(answer[-1][:3] - sensor.t_lidar_mag) * 1e3
        table.add_row(name, f"{cost:.2f}", f"{error:.1f}")
    apart = np.linalg.norm(ours[-1][:3] - peers[-1][:3]) * 1e3
    table.add_row("ratio", f"{slow / fast:.0f}", f"answers {apart:.1f} mm apart")
    return table


def from_ours_to_the_peers() -> Table:
    """Change our problem into the peer's step by step; the last step is another map."""
    (sensor, readings, _, field_map), options = one_sensor(), OneKeyOptions()
    solution = solve_one_key(readings, field_map, np.zeros((1, 3)), options)
    estimate, used = solution.estimate, solution.used
    variance = observe(readings, field_map, estimate, options.min_readings).map_variance
    C = np.broadcast_to(estimate.C()[0], (len(readings), 3, 3))
    share = map_covariance(C, readings.R_map_lidar, variance)
    W = whitening(reading_covariance(estimate.noise[readings.sensor], share))
    equal = np.broadcast_to(np.eye(3), W.shape)
    forms = {
        "our weights, the readings that count": (readings.select(used), W[used]),
        "our weights, all readings": (readings, W),
        "equal weights, all readings": (readings, equal),
    }
    table = Table("least squares on our map", "from ours (mm)", "|error of t| (mm)")
    for name, (chosen, weights) in forms.items():
        found = least_squares_solution(
            chosen, lambda x: field_map.field_and_gradient(x)[0], weights
        )
        apart, error = found[:3] - estimate.t[0], found[:3] - sensor.t_lidar_mag
        table.add_row(name, *(f"{np.linalg.norm(each) * 1e3:.3f}" for each in (apart, error)))
    return table


def main() -> None:
    """Print all tables."""
    console = Console(width=110)
    for table in (factor_costs(), growth(), against_the_peer(), from_ours_to_the_peers()):
        console.print(table)


if __name__ == "__main__":
    main()
