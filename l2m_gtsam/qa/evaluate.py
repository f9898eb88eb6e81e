"""Calibration -> the figures that it is judged by. Pure: no files, no terminal.

Parts of what was driven are calibrated by themselves: of one drive both halves, of several each
drive.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from l2m_gtsam.calibration.budget.found import NOTHING_FOUND, Budget
from l2m_gtsam.calibration.calibrate import Calibrated
from l2m_gtsam.calibration.one_key import solve_part
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.view import spread
from l2m_gtsam.data import FloatArray, Readings, Recording
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.parallel.threads import in_threads, one_blas_thread
from l2m_gtsam.progress import Progress, silent
from l2m_gtsam.qa.metrics.assemble import Repeats, SeenSensors, map_picture, measures_of
from l2m_gtsam.qa.metrics.evidence import DriveEvidence
from l2m_gtsam.qa.metrics.repeatability import (
    PartialEstimate,
    compare_drives,
    compare_halves,
    halves_of,
    no_halves,
)
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.records.metrics import Measures, Metrics
from l2m_gtsam.records.repeatability import Halves, Repeatability

FIGURES = "figures"
"""Stage of the figures of a calibration and its picture."""
STEPS = 1  # alternation from where the whole was found; the joint graph does the rest
MORE = 4  # times as many readings of a drive as of a half
FAR = 2.0  # times as strong as the whole's, or as weak: an open C beyond that is no sensor's


@one_blas_thread()
def measured(
    recording: Recording,
    calibrated: Calibrated,
    options: CalibrationOptions,
    qa: QaOptions,
    progress: Progress = silent,
) -> Measures:
    """Return the figures that a verdict rests on.

    Parameters
    ----------
    recording
        That was calibrated.
    calibrated
        The calibration, with what it rests on.
    options
        That it was computed with.
    qa
        Whether parts are calibrated by themselves, and on how many readings.
    progress
        Called with a stage and the fraction of it that is done.
    """
    repeats = repeats_of(recording, calibrated, options, qa, progress)
    return measures_of(calibrated.result, seen_in(calibrated), recording, repeats)


@one_blas_thread()
def evaluate(
    recording: Recording,
    calibrated: Calibrated,
    options: CalibrationOptions,
    qa: QaOptions,
    progress: Progress = silent,
) -> Metrics:
    """Return all figures of a calibration: with the map around it; parameters as ``measured``."""
    repeats, seen = repeats_of(recording, calibrated, options, qa, progress), seen_in(calibrated)
    progress(FIGURES, 0.0)
    picture = map_picture(calibrated.field_map, seen.places)  # by all cores
    found = measures_of(calibrated.result, seen, recording, repeats)
    progress(FIGURES, 0.5)
    return Metrics(found.sensors, found.drive, picture, bags=found.bags)


def seen_in(calibrated: Calibrated) -> SeenSensors:
    """Return what the map and a calibration make of a drive's readings."""
    return SeenSensors.of(calibrated.result, evidence_of(calibrated), calibrated.solver_map)


def repeats_of(
    recording: Recording,
    calibrated: Calibrated,
    options: CalibrationOptions,
    qa: QaOptions,
    progress: Progress,
) -> Repeats:
    """Return what parts of a drive, or drives, say by themselves; parameters as ``evaluate``."""
    if not qa.halves:
        return Repeats({}, {})
    stage = "drives by themselves" if recording.drives else "halves of the drive"
    progress(stage, 0.0)
    if recording.drives:
        drives = compared_drives(calibrated, recording, options, qa.half_readings)
        repeats = Repeats({}, drives)
    else:
        repeats = Repeats(compared_halves(calibrated, options, qa), {})
    progress(stage, 1.0)
    return repeats


def evidence_of(calibrated: Calibrated) -> DriveEvidence:
    """Return the readings of a calibration as its solve left them."""
    solution = calibrated.solution
    return DriveEvidence(solution.readings, solution.inside, solution.rejected)


@one_blas_thread()
def compared_halves(
    calibrated: Calibrated, options: CalibrationOptions, qa: QaOptions
) -> dict[str, Halves]:
    """Compare the first and the second half of a drive for each sensor.

    The graph of the whole gives it for all readings that counted. If many were rejected, as those
    of one half if a sensor moved, both halves are calibrated anew. If the map does not model how
    its errors are correlated, they are calibrated on few readings, whose errors are less alike.

    Parameters
    ----------
    calibrated
        The calibration of the whole drive.
    options
        That it was computed with.
    qa
        How many rejected readings are many, and how many a half is calibrated on then.
    """
    solution, names = calibrated.solution, calibrated.result.sensors
    inside = np.bincount(solution.readings.sensor[solution.inside], minlength=len(names))
    rejected = np.bincount(solution.readings.sensor[solution.rejected], minlength=len(names))
    many = rejected > qa.rejected.warn * inside
    found, anew = {}, []
    for each in solution.solved:
        if each.halves is None or many[each.sensor]:
            anew.append(each.sensor)
            continue
        middle = solution.estimate.vector(each.sensor)
        found[names[each.sensor].sensor] = halves_of(middle, each.halves)
    return found | (halves_anew(calibrated, options, qa.half_readings, anew) if anew else {})


def halves_anew(
    calibrated: Calibrated, options: CalibrationOptions, each_half: int, solved: Sequence[int]
) -> dict[str, Halves]:
    """Calibrate both halves of a drive by themselves, and compare them for some sensors.

    Each starts where the whole was found, with its time offsets and processes and without priors:
    what a half leaves open takes no part. Readings that the whole rejected are looked at again.
    """
    readings, whole = _usable(calibrated), calibrated.solution.estimate
    middle, budget = np.median(readings.stamp_ns), calibrated.solution.budget
    parts = (readings.stamp_ns < middle, readings.stamp_ns >= middle)
    try:
        first, second = in_threads(
            lambda part: _parts(
                calibrated, readings.select(part), whole.t, whole.C(), options, each_half, budget
            ),
            parts,
        )
    except (CalibrationError, np.linalg.LinAlgError) as error:
        # The whole is calibrated: that a half is not is no reason to lose it.
        reason = f"a half of the drive cannot be calibrated: {error}"
        return {readings.sensors[index]: no_halves(reason) for index in solved}
    return {readings.sensors[index]: _compared(first, second, index) for index in solved}


@one_blas_thread()
def compared_drives(
    calibrated: Calibrated, recording: Recording, options: CalibrationOptions, each_half: int
) -> dict[str, Repeatability]:
    """Calibrate each drive of a recording by itself, and compare them sensor by sensor.

    They start as halves do. All are one graph, in which every drive has a place and a distortion
    of its own for each sensor, but there is one map: its errors, which drives through the same
    places share, are known to be shared and do not count as a difference.

    Parameters
    ----------
    calibrated
        The calibration of all drives together.
    recording
        The drives.
    options
        That it was computed with.
    each_half
        Readings of each sensor that half a drive would be calibrated on, a fourth of those here.
    """
    readings, count = _usable(calibrated), len(recording.drives)
    solved = [found.sensor for found in calibrated.solution.solved]
    own, whole = by_drive(readings, count), calibrated.solution.estimate
    t, C = (np.repeat(each, count, axis=0) for each in (whole.t, whole.C()))
    try:
        found = _parts(calibrated, own, t, C, options, MORE * each_half)
    except (CalibrationError, np.linalg.LinAlgError) as error:
        found, failed = {}, f"the drives cannot be calibrated by themselves: {error}"
    else:
        failed = ""
    paths = [drive.source.path for drive in recording.drives]
    return {
        readings.sensors[index]: compare_drives(
            [
                (path, found.get(index * count + k) or failed or _too_few(own, index * count + k))
                for k, path in enumerate(paths)
            ]
        )
        for index in solved
    }


def by_drive(readings: Readings, count: int) -> Readings:
    """Return readings as if each of so many drives had sensors of its own.

    Sensor s of drive k then counts as ``s * count + k``.
    """
    names = tuple(f"{name} of drive {k + 1}" for name in readings.sensors for k in range(count))
    return replace(readings, sensors=names, sensor=readings.sensor * count + readings.of_drive)


def _too_few(readings: Readings, sensor: int) -> str:
    rows = readings.rows_of(sensor)
    read = rows.stop - rows.start
    if not read:
        return "nothing usable was read of it in this drive"
    return f"its {read} usable readings in this drive are too few to calibrate on"


def _usable(calibrated: Calibrated) -> Readings:
    """Return the readings of solved sensors inside the map, at fixed time offsets."""
    solution = calibrated.solution
    solved = [found.sensor for found in solution.solved]
    usable = solution.inside & np.isin(solution.readings.sensor, solved)
    return replace(solution.readings, motion=None).select(usable)


def _parts(
    calibrated: Calibrated,
    readings: Readings,
    t: FloatArray,
    C: FloatArray,
    options: CalibrationOptions,
    most: int,
    budget: Budget = NOTHING_FOUND,
) -> dict[int, PartialEstimate]:
    """Return what some of the readings determine of each sensor that they are enough for.

    Parameters
    ----------
    t, C
        Of the whole, of every sensor of the readings: metres, shapes (S, 3) and (S, 3, 3).
    """
    few = readings.select(spread(readings, max(most, options.solve.min_readings)))
    near = options.solve.model_copy(update={"max_steps": min(STEPS, options.solve.max_steps)})
    if duration := calibrated.solution.pose_duration:
        lasting = near.pose_noise.lasting(duration.seconds)
        near = near.model_copy(update={"pose_noise": lasting})
    solution = solve_part(few, calibrated.solver_map, t, near, budget)
    parts = {
        found.sensor: PartialEstimate(
            solution.estimate.vector(found.sensor), found.covariance, found.shared_root
        )
        for found in solution.solved
    }
    return {sensor: _near(part, C[sensor]) for sensor, part in parts.items()}


def _near(part: PartialEstimate, C: FloatArray) -> PartialEstimate:
    """Return a part, or that it determines nothing where what it leaves open of C went astray.

    Its other parameters, and their sigmas, are those beside a C that no sensor has.
    """
    if part.known[3:12].all():
        return part
    ratio = np.linalg.solve(C.T, part.vector[3:12].reshape(3, 3).T)
    strengths = np.linalg.svd(ratio, compute_uv=False)
    if strengths[0] < FAR and strengths[-1] > 1 / FAR:
        return part
    return replace(part, covariance=np.diag(np.full(len(part.vector), np.inf)))


def _compared(
    first: dict[int, PartialEstimate], second: dict[int, PartialEstimate], sensor: int
) -> Halves:
    for name, half in (("first", first), ("second", second)):
        if sensor not in half:
            return no_halves(f"the {name} half of the drive has too few readings to calibrate on")
    # Each half was solved by itself: nothing is known of what their errors share.
    one, other = (replace(half[sensor], shared_root=None) for half in (first, second))
    return compare_halves(one, other)
