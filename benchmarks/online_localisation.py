"""Localisation on line: an hour in one hall, key pose by key pose, beside a graph that only grows.

The peer is iSAM2 as it comes: the same factors, in one graph of the whole drive. Times are those of
processors, of all threads together: what else a machine does would count otherwise.
"""

import time
from dataclasses import dataclass
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.dipole_hall import NOISE, compiled_map, hall
from benchmarks.memory import peak_mib
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.slam.online.follower import SECTION, Follower
from l2m_gtsam.slam.online.key_pose import key_poses_of
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from tests.drives.drawn import DrawnDrive, drawn_drive
from tests.drives.slam import ahead
from tests.worlds.exact import random_sensors

SENSORS, RATE_HZ, SPEED = 12, 10, 0.8
HOUR, SHORT = 36_000, 1_000  # key poses
EXACT = np.full(15, 1e-6)
WRONG = np.concatenate([np.full(3, 0.1), np.full(9, 0.1), np.full(3, 20.0)])


@dataclass(frozen=True)
class Run:
    """What each key pose cost in seconds, its error in metres, and how memory grew in MiB.

    Memory counts from the end of the first tenth, where maps have been compiled.
    """

    cost: FloatArray
    off: FloatArray
    grown: float

    def tenth(self, number: int) -> float:
        """Return the mean cost in a tenth of the drive, in seconds."""
        return float(np.array_split(self.cost, 10)[number].mean())

    @property
    def times_real(self) -> float:
        return len(self.cost) / RATE_HZ / float(self.cost.sum())


def laps(count: int) -> Trajectory:
    """Return laps of an ellipse, never quite the same, with a little roll, pitch and heave."""
    at = np.arange(count) / RATE_HZ
    angle = SPEED * at / np.sqrt(0.5 * (3.6**2 + 2.5**2))
    wide, deep = 3.6 + 0.4 * np.sin(0.37 * angle + 0.3), 2.5 + 0.4 * np.sin(0.71 * angle + 1.0)
    height = 0.5 + 0.03 * np.sin(1.3 * at)
    p = np.column_stack([wide * np.cos(angle), deep * np.sin(angle), height])
    return ahead(at, p)


def followed(drawn: DrawnDrive, field_map: QueryableMap, free: bool, section: int = SECTION) -> Run:
    """Follow a drive and take the time of each key pose."""
    use = CalibrationUse.REFINED if free else CalibrationUse.FIXED
    drive, options = drawn.drive, SlamOptions(calibration=use)
    follower = Follower(drive.start, drive.sensors, field_map, options, section)
    count, warm = len(drawn.drive), len(drawn.drive) // 10
    cost, off, memory = np.zeros(count), np.zeros(count), 0.0
    for number, key_pose in enumerate(key_poses_of(drive)):
        begin = time.process_time()
        belief = follower.add(key_pose)
        cost[number] = time.process_time() - begin
        off[number] = np.linalg.norm(belief.pose.translation() - drawn.p[number])
        if number == warm:
            memory = peak_mib()
    return Run(cost, off, peak_mib() - memory)


def report() -> Table:
    world, sensors = hall(1), random_sensors(1, SENSORS)
    field_map = compiled_map(world)
    drawn = partial(drawn_drive, world, sensors, rng=np.random.default_rng(5), noise=NOISE)
    table = Table(
        "calibration", "graph", "key poses", "times real time", "ms per key pose: first tenth",
        "middle", "last", "last / first", "memory grows by (MiB)", "off, rms (mm)",
    )  # fmt: skip
    for name, sigma in {"fixed": EXACT, "refined": WRONG}.items():
        for graph, count, section in (
            ("sections", HOUR, SECTION),
            ("sections", SHORT, SECTION),
            ("one", SHORT, SHORT),
        ):
            run = followed(
                drawn(truth=laps(count), sigma=sigma), field_map, name == "refined", section
            )
            first, middle, last = (run.tenth(each) for each in (0, 4, 9))
            table.add_row(
                name, graph, f"{count:,}", f"{run.times_real:.1f}",
                *(f"{1e3 * each:.2f}" for each in (first, middle, last)),
                f"{last / first:.2f}", f"{run.grown:.0f}",
                f"{1e3 * np.sqrt(np.mean(run.off**2)):.0f}",
            )  # fmt: skip
    return table


if __name__ == "__main__":
    Console().print(report())
