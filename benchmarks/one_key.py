"""The one-key solve: cost per factor, growth with the readings, and against a naive peer.

The peer is what one would write in an afternoon: scikit-learn's Gaussian process per axis and
scipy's least_squares over t, C and H together, with numeric derivatives. Both get the same
readings and the same hyperparameters, and must give the same answer.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from l2m_factors import BatchedReadings, D, MagneticReadings, T, block_factor, reading_factor
from l2m_gtsam.data import FloatArray, KnownSensor, Readings
from l2m_gtsam.graph.alternation import OneKeyOptions
from l2m_gtsam.graph.one_key import solve_one_key
from l2m_gtsam.maps.hyperparameters import Hyperparameters
from l2m_gtsam.maps.sliding_gp import SlidingGP, SlidingGPOptions
from tests.worlds import DipoleWorld, dipole_world, drive, random_sensors

HYPERPARAMETERS = Hyperparameters(length_scale=1.0, signal=6.0, noise=0.1)


@dataclass(frozen=True)
class Survey:
    """Readings of a map survey, positions in metres and fields in uT, shape (N, 3)."""

    points: FloatArray
    field: FloatArray


def survey(world: DipoleWorld, count: int, half: float) -> Survey:
    """Return readings in a box of this half-width and 0 to 1 m height."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-half, -half, -0.3], [half, half, 1.3], (count, 3))
    field, _ = world.field_and_gradient(points)
    return Survey(points, field + rng.normal(0, HYPERPARAMETERS.noise, field.shape))


def sliding_map(data: Survey) -> SlidingGP:
    """Return the map of a survey with the benchmark's hyperparameters."""
    options = SlidingGPOptions(hyperparameters=HYPERPARAMETERS)
    return SlidingGP.fit(data.points, data.field, options)


def seconds(work: Callable[[], object], repeats: int = 3) -> float:
    """Return the shortest time of several runs."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def factor_costs() -> Table:
    """Linearise the same readings as one factor each and as one block."""
    world, sensors = dipole_world(0), random_sensors(0, 12)
    readings = drive(0, sensors, world, count=2000, noise=0.1)
    field_map = sliding_map(survey(world, 8000, 6.0))
    magnetic = MagneticReadings(
        readings.sensor, readings.R_map_lidar, readings.p_map_lidar, readings.field
    )
    values = gtsam.Values()
    for i, sensor in enumerate(sensors):
        values.insert(T(i), sensor.t_lidar_mag)
        values.insert(D(i), sensor.distortion.vector())
    batch = BatchedReadings(field_map, magnetic)
    unit = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    W = np.broadcast_to(10.0 * np.eye(3), (len(batch), 3, 3))
    forms = {"one factor per reading": gtsam.NonlinearFactorGraph()}
    for n in range(len(batch)):
        forms["one factor per reading"].add(reading_factor(batch, n, unit))
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
    world, sensors = dipole_world(1), random_sensors(1, 12)
    field_map = sliding_map(survey(world, 8000, 6.0))
    table = Table("readings (12 sensors)", "s", "ms per 1,000 readings")
    sizes, costs = [1_000, 5_000, 12_000, 24_000, 50_000], []
    for size in sizes:
        readings = drive(2, sensors, world, count=size // 12, noise=0.1)
        start = np.zeros((12, 3))
        solve = partial(solve_one_key, readings, field_map, start, OneKeyOptions())
        cost = seconds(solve, 1)
        costs.append(cost)
        table.add_row(f"{size:,}", f"{cost:.2f}", f"{cost / size * 1e6:.0f}")
    exponent = np.polyfit(np.log(sizes[1:]), np.log(costs[1:]), 1)[0]
    table.add_row("exponent from 5,000 to 50,000", f"{exponent:.2f}", "(1 is linear)")
    return table


def naive_solution(readings: Readings, data: Survey, sensor: int) -> FloatArray:
    """Return (t, C, H) of one sensor as the peer finds it."""
    h = HYPERPARAMETERS
    kernel = ConstantKernel(h.signal**2) * RBF(h.length_scale)
    mean = data.field.mean(axis=0)
    axes = [
        GaussianProcessRegressor(kernel, alpha=h.noise**2, optimizer=None).fit(
            data.points, data.field[:, k] - mean[k]
        )
        for k in range(3)
    ]
    rows = readings.rows_of(sensor)
    R, p, z = readings.R_map_lidar[rows], readings.p_map_lidar[rows], readings.field[rows]

    def residual(x: FloatArray) -> FloatArray:
        points = R @ x[:3] + p
        B = np.column_stack([axis.predict(points) for axis in axes]) + mean
        b = np.einsum("nji,nj->ni", R, B)
        return np.asarray((b @ x[3:12].reshape(3, 3).T + x[12:] - z).ravel())

    start = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)])
    return np.asarray(least_squares(residual, start).x)


def against_the_peer() -> Table:
    """Solve two sensors of 500 readings over a map of 1,000 survey readings."""
    world, sensors = dipole_world(2, count=12), random_sensors(2, 2)
    data = survey(world, 1000, 5.5)
    readings = drive(3, sensors, world, count=500, noise=0.1)
    answers: dict[str, FloatArray] = {}

    def ours() -> None:
        solution = solve_one_key(readings, sliding_map(data), np.zeros((2, 3)), OneKeyOptions())
        answers["ours"] = np.stack([solution.estimate.vector(i) for i in range(2)])

    def peer() -> None:
        answers["peer"] = np.stack([naive_solution(readings, data, i) for i in range(2)])

    fast, slow = seconds(ours), seconds(peer, 1)
    table = Table("map and solve, 2 sensors x 500 readings", "s", "|error of t| (mm)")
    for name, cost in (("l2m_gtsam", fast), ("scikit-learn + scipy", slow)):
        key = "ours" if name == "l2m_gtsam" else "peer"
        table.add_row(name, f"{cost:.2f}", _errors(answers[key], sensors))
    difference = np.abs(answers["ours"] - answers["peer"])[:, :3].max() * 1e3
    table.add_row("ratio", f"{slow / fast:.0f}", f"answers differ by {difference:.2f} mm")
    return table


def _errors(answer: FloatArray, sensors: tuple[KnownSensor, ...]) -> str:
    norms = [np.linalg.norm(answer[i, :3] - s.t_lidar_mag) * 1e3 for i, s in enumerate(sensors)]
    return ", ".join(f"{norm:.1f}" for norm in norms)


def main() -> None:
    """Print all tables."""
    console = Console(width=110)
    for table in (factor_costs(), growth(), against_the_peer()):
        console.print(table)


if __name__ == "__main__":
    main()
