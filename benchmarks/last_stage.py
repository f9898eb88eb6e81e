"""The last graph of a calibration: GTSAM beside the block elimination that it replaced.

One round each: descent, degrees of freedom of all sensors, covariances. The old engine took two
Gauss-Newton steps; both start where sensors are to within millimetres, without any error of the
map. Processor seconds, one BLAS thread, growth with the readings and with the sensors.
"""

from dataclasses import dataclass, replace
from time import process_time

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.dipole_hall import NOISE, compiled_map, hall, true_start
from benchmarks.timing import seconds
from l2m_factors import map_weights_prior
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.joint import joint_problem
from l2m_gtsam.calibration.optimise import LinearSolver
from l2m_gtsam.calibration.uncertain_graph import (
    IndependentOptimum,
    UncertainDrive,
    UncertainProblem,
    starting_values,
)
from l2m_gtsam.calibration.uncertain_optimum import UncertainOptimum
from l2m_gtsam.calibration.view import observe
from l2m_gtsam.data import FloatArray, KnownSensor, Readings, Trajectory
from l2m_gtsam.maps.harmonic.harmonic_map import CompiledMap
from l2m_gtsam.parallel.threads import one_blas_thread
from tests.reference.elimination import Eliminated, eliminate
from tests.worlds.exact import DipoleWorld, random_sensors, read_together

OPTIONS = OneKeyOptions()
GROWTH = ((12, 2_000), (12, 8_000), (1, 2_000), (4, 2_000), (48, 2_000))  # sensors, readings
POSE_SIGMA = (0.002, 0.002)  # rad and m: knots take part
OLD_STEPS = 2


@dataclass(frozen=True)
class Case:
    """The last graph of one drive, and where it starts; ``rows`` has the prior as rows."""

    problem: UncertainProblem
    rows: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    sizes: dict[int, int]
    sensors: list[int]

    def old_round(self) -> list[FloatArray]:
        """Return covariances after the steps and the noise of the old engine."""
        values = self.values
        for _ in range(OLD_STEPS):
            values = self.eliminated(values).stepped(values, self.sizes)
        system = self.eliminated(values)
        for sensor in self.sensors:
            system.taken(sensor)
        return [system.covariance(sensor) for sensor in self.sensors]

    def round(self) -> list[FloatArray]:
        """Return covariances after a descent, degrees of freedom and marginals by GTSAM."""
        values = self.problem.descend(self.values, LinearSolver.CHOLESKY).values
        solved = UncertainOptimum.at(self.problem, values).solutions()
        return [each.joint_covariance for each in solved]

    def eliminated(self, values: gtsam.Values) -> Eliminated:
        """Return the old engine's solution of the linear graph."""
        return eliminate(self.rows.linearize(values), self.sensors, self.sizes)

    def old_covariances(self) -> list[FloatArray]:
        """Return covariances by the old engine, linearised where the graph starts."""
        system = self.eliminated(self.values)
        return [system.covariance(sensor) for sensor in self.sensors]

    def marginals(self) -> gtsam.Marginals:
        """Return GTSAM's."""
        return gtsam.Marginals(self.problem.graph.linearize(self.values), self.values)


def laps(sensors: tuple[KnownSensor, ...], world: DipoleWorld, count: int) -> Readings:
    """Return readings of a smooth drive that comes to each place several times, in 100 s."""
    phase = 2 * np.pi * np.linspace(0, 1, count)
    p = np.column_stack(
        [4 * np.sin(3 * phase), 4 * np.sin(4 * phase + 0.5), 0.5 + 0.15 * np.sin(11 * phase)]
    )
    angles = np.column_stack(
        [5 * phase + np.sin(7 * phase), 0.15 * np.sin(13 * phase), 0.15 * np.cos(9 * phase)]
    )
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    poses = Trajectory(np.linspace(0, 100e9, count).astype(np.int64), R, p, "map", "lidar")
    return read_together(sensors, world, poses, np.random.default_rng(3), NOISE)


def case(field_map: CompiledMap, count: int, each: int) -> Case:
    """Return the graph of so many sensors with so many readings each."""
    world, sensors = hall(1), random_sensors(1, count)
    readings = laps(sensors, world, each)
    root = np.diag(np.repeat(POSE_SIGMA, 3))
    readings = replace(readings, pose_root=np.broadcast_to(root, (len(readings), 6, 6)))
    estimate = true_start(sensors, OPTIONS)
    view = observe(readings, field_map, estimate, OPTIONS.min_readings)
    tests = joint_problem(view, field_map, estimate, OPTIONS).determinacies
    optimum = IndependentOptimum(view, field_map, field_map, estimate, tests, OPTIONS)
    drive_ = UncertainDrive.of(optimum)
    problem = UncertainProblem(drive_, estimate)
    coverage = drive_.coverage
    rows = gtsam.NonlinearFactorGraph()
    information = coverage.prior.at(0)
    for index in range(problem.graph.size()):
        factor = problem.graph.at(index)
        if set(factor.keys()) != set(information.keys()):
            rows.add(factor)
    rows.add(map_weights_prior(coverage.tiles, coverage.root_information))
    values = starting_values(estimate, view.sensors, coverage)
    return Case(problem, rows, values, coverage.sizes, view.sensors)


def row(field_map: CompiledMap, count: int, each: int) -> str:
    """Return what a round and the covariances cost, old and new."""
    now = case(field_map, count, each)
    now.round()  # tiles are compiled when first asked
    old, new, old_part, new_part = (
        seconds(work, 1, process_time)
        for work in (now.old_round, now.round, now.old_covariances, now.marginals)
    )
    return (
        f"{f'{count} x {each:,}':>12} {sum(now.sizes.values()):8,} {old:8.2f} {new:8.2f} "
        f"{old / new:6.2f} {old_part:10.2f} {new_part:10.2f} {old_part / new_part:6.2f}"
    )


@one_blas_thread()
def main() -> None:
    """Print a line as soon as there is one: the old engine takes minutes for 48 sensors."""
    field_map = compiled_map(hall(1))
    print("    readings  weights    old (s)  new (s)  ratio   old cov (s)  new (s)  ratio")
    for count, each in GROWTH:
        print(row(field_map, count, each), flush=True)


if __name__ == "__main__":
    main()
