"""Both halves of a drive calibrated by themselves. Pure: no files, no terminal."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.calibrate import Calibrated
from l2m_gtsam.config import CalibrationOptions
from l2m_gtsam.data import Readings
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.graph.alternation import spread
from l2m_gtsam.graph.one_key import solve_one_key
from l2m_gtsam.metric_results import Halves
from l2m_gtsam.qa.metrics.halves import Half, compare_halves, no_halves

STEPS = 3  # alternations from where the whole was found; the joint graph does the rest


def compared_halves(
    calibrated: Calibrated, options: CalibrationOptions, each_half: int
) -> dict[str, Halves]:
    """Calibrate the first and the second half of a drive, and compare them sensor by sensor.

    Each starts where the whole was found, with its time offsets and without priors: what a half
    leaves open takes no part. Readings that the whole rejected are looked at again: of a sensor
    that moved on the way they are one half.

    Parameters
    ----------
    calibrated
        The calibration of the whole drive.
    options
        That it was computed with.
    each_half
        Readings of each sensor that a half is calibrated on, at the most.
    """
    solution = calibrated.solution
    readings = replace(solution.readings, motion=None)
    solved = [found.sensor for found in solution.solved]
    usable = solution.inside & np.isin(readings.sensor, solved)
    middle = np.median(readings.stamp_ns[usable])
    parts = (readings.stamp_ns < middle, readings.stamp_ns >= middle)
    try:
        first, second = (
            _half(calibrated, readings.select(usable & part), options, each_half) for part in parts
        )
    except (CalibrationError, np.linalg.LinAlgError) as error:
        # The whole is calibrated: that a half is not is no reason to lose it.
        reason = f"a half of the drive cannot be calibrated: {error}"
        return {readings.sensors[index]: no_halves(reason) for index in solved}
    return {readings.sensors[index]: _compared(first, second, index) for index in solved}


def _half(
    calibrated: Calibrated, readings: Readings, options: CalibrationOptions, most: int
) -> dict[int, Half]:
    """Return what some of the readings say of each sensor that they are enough for."""
    few = spread(readings, max(most, options.solve.min_readings))
    near = options.solve.model_copy(update={"max_steps": min(STEPS, options.solve.max_steps)})
    solution = solve_one_key(few, calibrated.solver_map, calibrated.solution.estimate.t, near)
    return {
        found.sensor: Half(solution.estimate.vector(found.sensor), found.covariance)
        for found in solution.solved
    }


def _compared(first: dict[int, Half], second: dict[int, Half], sensor: int) -> Halves:
    for name, half in (("first", first), ("second", second)):
        if sensor not in half:
            return no_halves(f"the {name} half of the drive has too few readings to calibrate on")
    return compare_halves(first[sensor], second[sensor])
