"""A batch of calibrations on a number of local workers, timed: a process of its own.

A cell of a study may be computed by a worker that must not start workers of its own; this module
therefore runs as a program, which is given options and prints what it measured.
"""

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import partial

import numpy as np
from pydantic import TypeAdapter

from l2m_gtsam.calibration.one_key import solve_one_key
from l2m_gtsam.calibration.start.global_start import find_starts
from l2m_gtsam.errors import ClusterError
from l2m_gtsam.options import Options
from l2m_gtsam.parallel.cluster import ClusterOptions, Work, computed
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.studies.scaling.measurements import Measurement, Quantity, ScalingOptions, TimedTask
from l2m_gtsam.studies.site import Site, mapped_site, random_drive


class WorkerBatch(Options):
    """Input of the program."""

    options: ScalingOptions
    workers: int


@dataclass(frozen=True)
class Stint:
    """One calibration: which process computed it, from when to when, in seconds."""

    process: int
    begin: float
    end: float


def measured_workers(options: ScalingOptions, workers: int) -> tuple[Measurement, ...]:
    """Time a batch on so many workers, in a program of its own.

    Raises
    ------
    ClusterError
        The program ended with an error.
    """
    batch = WorkerBatch(options=options, workers=workers).model_dump_json()
    program = [sys.executable, "-c", f"from {__name__} import main; main()"]
    # Our own program: nothing that it is called with comes from outside.
    ran = subprocess.run(program, input=batch, capture_output=True, text=True, check=False)  # noqa: S603
    if ran.returncode:
        reason = (ran.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise ClusterError(f"a batch on {workers} workers failed: {reason}")
    return TypeAdapter(tuple[Measurement, ...]).validate_json(ran.stdout)


def batch_measurements(batch: WorkerBatch) -> tuple[Measurement, ...]:
    """Compute a batch, and return its time with and without the start of the workers."""
    options = batch.options
    work = Work(lambda key: "small", partial(place, options), partial(stint, options))
    begin = time.monotonic()
    keys = range(options.calibrations)
    stints = [made for _, made in computed(work, keys, ClusterOptions(workers=batch.workers))]
    whole = time.monotonic() - begin
    alone = options.calibrations / rate(stints)
    return (
        Measurement(Quantity.WORKERS, TimedTask.BATCH, batch.workers, alone),
        Measurement(Quantity.WORKERS, TimedTask.STARTED, batch.workers, whole),
    )


def place(options: ScalingOptions, name: str) -> Site:
    """Return the place where all calibrate."""
    return mapped_site(options.small_site)


def stint(options: ScalingOptions, key: int, site: Site) -> Stint:
    """Simulate a drive and calibrate its sensor, as studies do."""
    begin = time.monotonic()
    rng = np.random.default_rng([options.seed, key])
    readings = random_drive(site, options.small_site, rng).readings
    (found,) = find_starts(readings, site.field_map, np.zeros(3), options.search)
    if found is not None:
        chosen = options.solve.model_copy(update={"uncertainty": Uncertainty.INDEPENDENT})
        solve_one_key(readings, site.field_map, found.t_lidar_mag[None], chosen)
    return Stint(os.getpid(), begin, time.monotonic())


def rate(stints: list[Stint]) -> float:
    """Return how many calibrations all processes together compute in a second.

    The first of each process does not count where there are more: it is slow, for everything
    happens for the first time.
    """
    return sum(steady_rate([s for s in stints if s.process == p]) for p in processes(stints))


def processes(stints: list[Stint]) -> set[int]:
    """Return who computed."""
    return {each.process for each in stints}


def steady_rate(own: list[Stint]) -> float:
    """Return how many calibrations one process computes in a second."""
    # Times of one process follow each other: their number over the time from first to last.
    in_order = sorted(own, key=lambda each: each.begin)
    counted = in_order[1:] or in_order
    return len(counted) / (counted[-1].end - counted[0].begin)


def main() -> None:
    """Read a batch as JSON, compute it, and print the measurements as JSON."""
    batch = WorkerBatch.model_validate_json(sys.stdin.read())
    measured = batch_measurements(batch)
    print(TypeAdapter(tuple[Measurement, ...]).dump_json(measured).decode())
