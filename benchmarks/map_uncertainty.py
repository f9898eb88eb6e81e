"""The one-key solve with the map's correlated error in the graph, beside independent errors."""

from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.dipole_hall import NOISE, compiled_map, hall
from benchmarks.timing import seconds
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.one_key import OneKeySolution, solve_one_key
from l2m_gtsam.records.calibration import Uncertainty
from tests.worlds.exact import drive, random_sensors

SENSORS = 12
SIZES = (500, 2_000, 4_000)  # readings of each sensor


def report() -> Table:
    """Return the costs of both, and how large the map makes the errors of t."""
    world, sensors = hall(1), random_sensors(1, SENSORS)
    field_map = compiled_map(world)
    table = Table("readings", "independent (s)", "full (s)", "full costs", "sigma of t grows by")
    for size in SIZES:
        readings = drive(2, sensors, world, count=size, noise=NOISE)
        solves = {
            kind: partial(
                solve_one_key,
                readings,
                field_map,
                np.zeros((SENSORS, 3)),
                OneKeyOptions(uncertainty=kind),
            )
            for kind in (Uncertainty.INDEPENDENT, Uncertainty.FULL)
        }
        alone, full = (solve() for solve in solves.values())  # tiles are compiled when first asked
        cost = {kind: seconds(solve, 2) for kind, solve in solves.items()}
        table.add_row(
            f"{SENSORS} x {size:,}",
            *(f"{each:.2f}" for each in cost.values()),
            f"{cost[Uncertainty.FULL] / cost[Uncertainty.INDEPENDENT]:.2f}",
            f"{sigma(full) / sigma(alone):.2f}",
        )
    return table


def sigma(solution: OneKeySolution) -> float:
    """Return the root mean square of the sigmas of t."""
    variances = [np.diag(each.covariance)[:3] for each in solution.solved]
    return float(np.sqrt(np.mean(variances)))


if __name__ == "__main__":
    Console().print(report())
