"""The solve of 12 sensors and its last graph with the error budget and without.

Processor seconds, one BLAS thread. *Without*: the rounds of the graph until its weights settle, and
its covariances. *With*: the same, then the search for processes, the rounds with those that were
found, the checks on parts and halves of the drive and on stated sizes, and variances by cause. The
solve begins 5 cm beside the sensors; a calibration looks for starts before it.
"""

from dataclasses import dataclass, replace
from time import process_time

import numpy as np

from benchmarks.dipole_hall import compiled_map, hall, true_start
from benchmarks.last_stage import laps
from l2m_gtsam.calibration.alternation import Alternated, OneKeyOptions
from l2m_gtsam.calibration.joint import joint_problem
from l2m_gtsam.calibration.one_key import settle, solve_one_key
from l2m_gtsam.calibration.start.global_start import StartOptions, find_starts
from l2m_gtsam.calibration.uncertain import solve_uncertain
from l2m_gtsam.calibration.uncertain_graph import IndependentOptimum, UncertainDrive
from l2m_gtsam.calibration.uncertain_rounds import settle_by_any
from l2m_gtsam.calibration.view import RememberedMap, StandIns
from l2m_gtsam.data import Readings
from l2m_gtsam.maps.harmonic.harmonic_map import CompiledMap
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import silent
from l2m_gtsam.simulate.sensors import lasting
from tests.worlds.exact import random_sensors

OPTIONS = OneKeyOptions()
SENSORS, EACH, BESIDE_M = 12, 600, 0.03  # along each axis
WALK_UT, POSE_M, POSE_S = 0.3, 0.007, 2.0


@dataclass(frozen=True)
class Cost:
    """Processor seconds, and the processes that were found.

    Attributes
    ----------
    without, whole
        Of the last graph without the error budget and with it.
    solve, starts
        Of the solve with it, and of the search for starts.
    kinds
        What was found.
    """

    without: float
    whole: float
    solve: float
    starts: float
    kinds: tuple[str, ...]

    @property
    def beside(self) -> float:
        """What the error budget adds."""
        return self.whole - self.without

    def columns(self) -> tuple[str, ...]:
        """Return without, with and ratio: of the last graph, the solve, and that with starts."""
        wholes = (self.whole, self.solve, self.starts + self.solve)
        return tuple(
            f"{whole - self.beside:7.2f} {whole:6.2f} {whole / (whole - self.beside):6.2f}"
            for whole in wholes
        )


def nothing(readings: Readings) -> Readings:
    """Return a drive as it is."""
    return readings


def wandering(readings: Readings) -> Readings:
    """Return a drive on which H of each sensor walks."""
    rng = np.random.default_rng(5)
    steps = rng.normal(0, WALK_UT / np.sqrt(EACH), (SENSORS, EACH, 3))
    return replace(readings, field=readings.field + np.cumsum(steps, axis=1).reshape(-1, 3))


def misplaced(readings: Readings) -> Readings:
    """Return a drive whose positions are wrong for a while, for all sensors alike."""
    rng = np.random.default_rng(6)
    error = lasting(rng.standard_normal((EACH, 3)), readings.stamp_ns[:EACH], POSE_S)
    shift = POSE_M * np.tile(error, (SENSORS, 1))
    return replace(readings, p_map_lidar=readings.p_map_lidar + shift)


def cost(field_map: CompiledMap, readings: Readings) -> Cost:
    """Return what the last graph costs."""
    start = true_start(random_sensors(1, SENSORS), OPTIONS)
    asked = RememberedMap(field_map)
    near, few = Alternated(start, start.t, steps=0), StandIns.of(readings, OPTIONS.fewer_readings)
    joint = settle(readings, few, asked, near, OPTIONS, silent, None)
    if joint.problem is None:
        raise RuntimeError("no sensor has enough readings")
    view = joint.problem.view
    tests = joint_problem(view, asked, joint.estimate, OPTIONS).determinacies
    optimum = IndependentOptimum(view, asked, asked, joint.estimate, tests, OPTIONS)
    settle_by_any(UncertainDrive.of(optimum), joint.estimate, lambda _: None)  # compiles tiles
    began = process_time()
    found = settle_by_any(UncertainDrive.of(optimum), joint.estimate, lambda _: None)
    found.optimum.solutions()
    between = process_time()
    whole = solve_uncertain(optimum, lambda _: None)
    kinds = sorted({each.process.kind.value for each in whole.budget.found})
    ended = process_time()
    solve_one_key(readings, RememberedMap(field_map), start.t + BESIDE_M, OPTIONS)
    solved = process_time()
    find_starts(readings, field_map, np.zeros(3), StartOptions())
    starts = process_time() - solved
    return Cost(between - began, ended - between, solved - ended, starts, tuple(kinds))


@one_blas_thread()
def main() -> None:
    """Print a line for each drive."""
    field_map = compiled_map(hall(1))
    clean = laps(random_sensors(1, SENSORS), hall(1), EACH)
    print(f"{SENSORS} x {EACH}: seconds without, with, ratio")
    print(f"{'':>10} {'last graph':>21}   {'solve':>21}   {'starts and solve':>21}   found")
    for change in (nothing, wandering, misplaced):
        found = cost(field_map, change(clean))
        kinds = ", ".join(found.kinds) or "nothing"
        print(f"{change.__name__:>10} {'   '.join(found.columns())}   {kinds}", flush=True)


if __name__ == "__main__":
    main()
