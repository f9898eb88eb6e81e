"""What a solve says of each sensor: figures, a status, and a sentence about it."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.explanation import Explained
from l2m_gtsam.calibration.moving_solve import MovingSolution
from l2m_gtsam.calibration.one_key import OneKeySolution
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.priors import Contradiction
from l2m_gtsam.calibration.variance_parts import variance_shares
from l2m_gtsam.data import Distortion, Readings, SyncCounts, Synchronised
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.geometry import PolarRotation, dead_axis, polar_rotation
from l2m_gtsam.records.calibration import FoundStart, SensorCalibration, SensorStatus, TimeOffset
from l2m_gtsam.solve.explain import Movement

# A Newton step of a tenth of a standard deviation would still be worth taking.
CONVERGED_SIGMAS = 0.1

# Squared distance of two sensors in sigmas, three degrees of freedom: exceeded by 1 % of those at
# one point.
ONE_POINT = float(chdtri(3, 0.01))

# With more of its readings rejected than this, what a sensor's others agree on may be chance.
MOST_REJECTED = 1 / 3

UNSOLVED = "the sensor is not solved"


@dataclass(frozen=True)
class SolvedDrive:
    """A drive, and everything that was found of its sensors.

    Attributes
    ----------
    synchronised
        Readings of all sensors, and the account of those dropped.
    readings
        Those that the solve was given.
    outcome
        Of the solve.
    explained
        Solutions of the solved sensors, with what they leave open.
    starts
        Where the search found each sensor; none where it was not looked for or not found.
    moved
        How the vehicle moved.
    """

    synchronised: Synchronised
    readings: Readings
    outcome: MovingSolution
    explained: dict[int, Explained]
    starts: tuple[FoundStart | None, ...]
    moved: Movement


def sensor_verdicts(
    drive: SolvedDrive, options: CalibrationOptions
) -> tuple[SensorCalibration, ...]:
    """Return a verdict on every sensor of a drive, in the order of its readings."""
    names, outcome = drive.readings.sensors, drive.outcome
    missed = {each.sensor: each.contradictions for each in outcome.solution.solved}
    sensors = []
    for index, entry in enumerate(_assess(drive, options)):
        entry = _with_models(index, entry, outcome)
        entry = _with_contradictions(entry, missed.get(index, ()), names)
        sensors.append(_with_start(entry, drive.starts[index], options))
    return tuple(_with_neighbours(sensor, tuple(sensors)) for sensor in sensors)


def _with_models(
    index: int, sensor: SensorCalibration, outcome: MovingSolution
) -> SensorCalibration:
    """Return the same with its models and what recorded numbers add to its readings."""
    return replace(
        sensor,
        models=outcome.compared.get(index),
        not_compared=outcome.not_compared.get(index, "" if index in outcome.compared else UNSOLVED),
        moving=outcome.moving.get(index, ()),
    )


def _with_start(
    sensor: SensorCalibration, start: FoundStart | None, options: CalibrationOptions
) -> SensorCalibration:
    """Return the same with where it started, and a warning if that was not the only place."""
    clear = options.search.clear
    if start is None or start.runner_up is None or not start.ambiguous(clear):
        return replace(sensor, start=start)
    if sensor.status is not SensorStatus.SOLVED:
        return replace(sensor, start=start)
    place = ", ".join(f"{value:.2f}" for value in start.runner_up)
    msg = (
        f"another place, ({place}) m, explains the readings about as well: it leaves "
        f"{start.margin:.2f} times as much; give `calibration.start` or drive more varied ways"
    )
    return replace(sensor, start=start, status=SensorStatus.AMBIGUOUS, message=msg)


def _with_contradictions(
    sensor: SensorCalibration, missed: tuple[Contradiction, ...], names: tuple[str, ...]
) -> SensorCalibration:
    """Return the same with a word on what was known beforehand and the readings speak against."""
    if not missed:
        return sensor
    worst = max(missed, key=lambda each: each.sigmas)
    others = [names[each] for each in worst.sensors if names[each] != sensor.sensor]
    where = f" with {others[0]}" if others else ""
    msg = (
        f"its {worst.kind}{where} contradicts the readings by {worst.sigmas:.1f} sigmas: correct "
        "`calibration.priors`, or give it a larger sigma"
    )
    if sensor.status is not SensorStatus.SOLVED:
        return replace(sensor, message=f"{sensor.message}; {msg}")
    return replace(sensor, status=SensorStatus.CONTRADICTED, message=msg)


def _with_neighbours(
    sensor: SensorCalibration, others: tuple[SensorCalibration, ...]
) -> SensorCalibration:
    """Return the same with a word on sensors at the same point: no baseline between them."""
    names = [other.sensor for other in others if _at_one_point(sensor, other)]
    if not names:
        return sensor
    place = f"its place is not distinguishable from {', '.join(names)}"
    return replace(sensor, message=f"{sensor.message}; {place}")


def _at_one_point(one: SensorCalibration, other: SensorCalibration) -> bool:
    """Whether two solved sensors lie so close that their sigmas do not separate them."""
    solved = SensorStatus.SOLVED
    if one is other or not one.status is other.status is solved:
        return False
    apart = one.t_lidar_mag - other.t_lidar_mag
    covariance = one.covariance[:3, :3] + other.covariance[:3, :3]
    return bool(apart @ np.linalg.solve(covariance, apart) < ONE_POINT)


def _assess(drive: SolvedDrive, options: CalibrationOptions) -> tuple[SensorCalibration, ...]:
    """Return what the solve itself says of every sensor."""
    alive, solution, solved = drive.readings, drive.outcome.solution, drive.explained
    outside = np.bincount(alive.sensor[~solution.inside], minlength=len(alive.sensors))
    rejected = np.bincount(alive.sensor[solution.rejected], minlength=len(alive.sensors))
    sensors = []
    for index, (name, counts) in enumerate(
        zip(alive.sensors, drive.synchronised.counts, strict=True)
    ):
        if index in solved:
            entry = _solved(
                name, solved[index], solution, counts, int(outside[index]), options.solve
            )
        else:
            usable = alive.rows_of(index)
            read = usable.stop - usable.start
            needed = options.solve.min_readings
            entry = _unsolved(name, read, counts, int(outside[index]), drive.moved, needed)
        sensors.append(_with_rejected(entry, int(rejected[index])))
    return tuple(sensors)


def _with_rejected(sensor: SensorCalibration, rejected: int) -> SensorCalibration:
    """Return the same with the number of its readings that nothing explains, and what follows."""
    sensor = replace(sensor, rejected=rejected)
    if rejected <= MOST_REJECTED * sensor.inside:
        return sensor
    msg = (
        f"{rejected} of {sensor.inside} readings inside the map fit no distortion that explains "
        "the others: is it the right map, and are the poses in its frame?"
    )
    if sensor.status not in (SensorStatus.SOLVED, SensorStatus.OUTSIDE_MAP):
        return sensor
    return replace(sensor, status=SensorStatus.CONTRADICTED, message=msg)


def _solved(
    name: str,
    explained: Explained,
    solution: OneKeySolution,
    counts: SyncCounts,
    outside: int,
    options: OneKeyOptions,
) -> SensorCalibration:
    found = explained.solution
    vector = solution.estimate.distortion[found.sensor]
    distortion = Distortion.from_vector(vector)
    status, message = _verdict(explained, solution, options)
    rotation = _no_rotation()
    axis = dead_axis(distortion.C)
    # what is not determined, or fits no place, may be short without a fault of the sensor
    fits = not (solution.contradicted or found.sensor in solution.stayed)
    if fits and axis and np.isfinite(found.covariance[3:12, 3:12].diagonal()).all():
        status = SensorStatus.DEAD_AXIS
        message = f"the sensor's {axis} axis does not follow the field; check its wiring"
    else:
        try:
            rotation = polar_rotation(distortion.C, found.covariance[3:12, 3:12])
        except CalibrationError as error:
            # the sign of a C that is not known says nothing about the axes
            if status is SensorStatus.SOLVED:
                status, message = SensorStatus.FLIPPED_AXIS, str(error)
    return SensorCalibration(
        sensor=name,
        status=status,
        message=message,
        t_lidar_mag=solution.estimate.t[found.sensor],
        distortion=distortion,
        R_lidar_mag=np.ascontiguousarray(rotation.R_mag_lidar.T),
        covariance=found.covariance,
        rotation_covariance=rotation.covariance,
        noise=float(solution.estimate.noise[found.sensor]),
        residuals=found.figures,
        undetermined=explained.words,
        sync=counts,
        outside_map=outside,
        time_offset=_time_offset(explained, solution),
        from_priors=explained.from_priors,
        unmodelled=found.unmodelled,
        variance_shares=variance_shares(found.covariance, found.variances),
    )


def _time_offset(explained: Explained, solution: OneKeySolution) -> TimeOffset:
    found = explained.solution
    return TimeOffset(
        seconds=0.0 if explained.held else float(solution.estimate.offset[found.sensor]),
        sigma=found.offset_sigma,
        cross_covariance=found.offset_covariance,
        held=explained.held,
    )


def _verdict(
    explained: Explained, solution: OneKeySolution, options: OneKeyOptions
) -> tuple[SensorStatus, str]:
    found, words = explained.solution, ". ".join(explained.words)
    open_ = f"this drive and map leave open: {words}" if words else ""
    because = f"{open_}; " if words else ""  # what keeps it from converging comes first
    if abs(solution.estimate.offset[found.sensor]) >= options.largest_offset_s > 0:
        return SensorStatus.NOT_CONVERGED, (
            f"{because}its clock seems to be off by {options.largest_offset_s:g} s or more: "
            "correct its stamps, or raise `calibration.solve.largest_offset_s`"
        )
    # A place that nothing holds need not come to rest: that it is open says it all.
    placeless = bool(np.isinf(np.diag(found.covariance)[:3]).all())
    if found.sensor in solution.unsettled and not placeless:
        return SensorStatus.NOT_CONVERGED, (
            f"{because}estimate and weights still change, round after round"
        )
    runs_away = found.sensor in solution.stayed
    if found.remaining_sigmas > CONVERGED_SIGMAS and not (runs_away or placeless):
        return SensorStatus.NOT_CONVERGED, (
            f"{because}{solution.ending.value}, {found.remaining_sigmas:.2g} standard deviations "
            "from the optimum"
        )
    if words:
        return SensorStatus.UNDETERMINED, open_
    if solution.contradicted:
        return SensorStatus.CONTRADICTED, (
            "hardly anything of what the map predicts is in its readings: is it the map of this "
            "place, and are the poses in its frame?"
        )
    if runs_away:
        return SensorStatus.NOT_CONVERGED, (
            "no place near where it started explains its readings: the solve leaves the map"
        )
    known = f"; from priors: {', '.join(explained.from_priors)}" if explained.from_priors else ""
    return SensorStatus.SOLVED, f"converged on {found.figures.readings} readings{known}"


def _unsolved(
    name: str, usable: int, counts: SyncCounts, outside: int, moved: Movement, needed: int
) -> SensorCalibration:
    status, inside = SensorStatus.NO_READINGS, usable - outside
    if usable < needed:
        message = _why_silent(usable, counts, moved, needed)
    elif inside >= needed:
        message = (
            f"none of its {inside} readings inside the map fits any distortion: is "
            "the sensor saturated, and is it the right map with poses in its frame?"
        )
    else:
        status = SensorStatus.OUTSIDE_MAP
        message = (
            f"{outside} of {usable} readings lie outside the map, at least {needed} must lie inside"
        )
    rotation = _no_rotation()
    return SensorCalibration(
        sensor=name,
        status=status,
        message=message,
        t_lidar_mag=np.full(3, np.nan),
        distortion=Distortion(np.full((3, 3), np.nan), np.full(3, np.nan)),
        R_lidar_mag=rotation.R_mag_lidar.T,
        covariance=np.diag(np.full(15, np.inf)),
        rotation_covariance=rotation.covariance,
        noise=float("nan"),
        residuals=None,
        undetermined=(),
        sync=counts,
        outside_map=outside,
    )


def _why_silent(usable: int, counts: SyncCounts, moved: Movement, needed: int) -> str:
    if counts.kept >= needed:
        return "the sensor reports one constant value: it is stuck"
    reason = f"{moved.rest}: " if moved.at_rest else ""
    without, elsewhere = counts.without_regressor, counts.elsewhere
    numbers = f", {without} without a recorded number" if without else ""
    beyond = f", {counts.saturated} beyond its range" if counts.saturated else ""
    apart = f", {elsewhere} in parts of the map that do not count" if elsewhere else ""
    remedy = _remedy(counts, moved, needed)
    return (
        f"{reason}{usable} usable readings of {counts.received} received "
        f"({counts.not_finite} not finite, {counts.repeated} repeated, "
        f"{counts.outside_trajectory} without a pose, {counts.in_pose_gap} in a gap or a "
        f"far turn between poses, "
        f"{counts.thinned} at a place already read{numbers}{beyond}{apart}), at least {needed} "
        f"are needed: {remedy}"
    )


def _remedy(counts: SyncCounts, moved: Movement, needed: int) -> str:
    """Return what gives a sensor more usable readings, by why most of them do not count."""
    if moved.at_rest:
        return "drive"
    if counts.received < needed:
        return "drive on, or record its readings more often"
    lost = {
        "check the sensor and its driver": counts.not_finite + counts.repeated,
        "record poses over the whole drive": counts.outside_trajectory,
        "record poses without gaps, and more often where it turns fast": counts.in_pose_gap,
        "drive on, through more places": counts.thinned,
        "record the number over the whole drive": counts.without_regressor,
        "choose a larger range, or keep the vehicle's iron away": counts.saturated,
        "raise `calibration.solve.most_weights`": counts.elsewhere,
    }
    return max(lost, key=lambda each: lost[each])


def _no_rotation() -> PolarRotation:
    return PolarRotation(np.full((3, 3), np.nan), np.diag(np.full(3, np.inf)))
