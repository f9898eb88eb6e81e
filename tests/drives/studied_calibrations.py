"""How far calibrations with any kind of map are off, and whether their covariances say so."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.one_key import OneKeySolution, solve_one_key
from l2m_gtsam.data import FloatArray, joined_rows
from l2m_gtsam.simulate.hall_drives import CalibrationDrive, calibration_drive, survey
from l2m_gtsam.simulate.steel_hall import MILD, SteelHall, steel_hall
from l2m_gtsam.studies.honesty.cells import Outcomes
from l2m_gtsam.studies.honesty.drives import drive_seed, start_near
from l2m_gtsam.studies.honesty.summary import Consistency, consistency
from tests.worlds.hall_clouds import CloudVariant, hall_cloud
from tests.worlds.studied_maps import Build, Scene, StudiedMap

START_M = 0.05  # each axis of a start is at most this far from the truth


@dataclass(frozen=True)
class Solved:
    """What a calibration says of one sensor.

    Attributes
    ----------
    sensor
        Its index in the readings.
    vector
        t in metres, C row by row, H in uT, time offset in seconds, shape (16,).
    covariance
        Of the same, shape (16, 16); infinite for what is undetermined.
    """

    sensor: int
    vector: FloatArray
    covariance: FloatArray


Calibrate = Callable[[CalibrationDrive, StudiedMap, FloatArray], Sequence[Solved]]
"""From a drive of S sensors, a map and starts (S, 3); sensors not solved are left out."""


def independent(
    drive: CalibrationDrive, field_map: StudiedMap, t_start: FloatArray
) -> Sequence[Solved]:
    """Calibrate as if the map's errors were independent between readings."""
    return solved_by(solve_one_key(drive.readings, field_map, t_start, OneKeyOptions()))


def solved_by(solution: OneKeySolution) -> Sequence[Solved]:
    """Return what a solve says of its sensors."""
    estimate = solution.estimate
    return [
        Solved(
            found.sensor,
            np.append(estimate.vector(found.sensor), estimate.offset[found.sensor]),
            found.joint_covariance,
        )
        for found in solution.solved
    ]


@dataclass(frozen=True)
class CalibrationCase:
    """A kind of map, the cloud it is given, and the ways to calibrate with it, by name."""

    build: Build
    cloud: CloudVariant
    methods: Mapping[str, Calibrate]


@dataclass(frozen=True)
class CalibrationConditions:
    """Worlds, surveys and drives of a study of calibrations.

    Attributes
    ----------
    surveys
        Independent worlds, each with its own survey.
    drives
        On each survey.
    sensors
        On each drive.
    readings
        Of each sensor on each drive.
    noises
        Of survey and sensors alike in uT.
    heights
        Passes of the surveys in metres, one tuple each.
    sensor_span
        Lowest and highest sensor over the floor in metres; where absent, the survey's passes.
    strength
        Factor on the polarisation of posts and racks.
    survey_readings
        Of each survey.
    seed
        Of the first world.
    """

    surveys: int = 20
    drives: int = 10
    sensors: int = 1
    readings: int = 220
    noises: tuple[float, ...] = (0.1, 0.2, 0.5)
    heights: tuple[tuple[float, ...], ...] = ((0.4, 0.7, 1.0),)
    sensor_span: tuple[float, float] | None = None
    strength: float = MILD
    survey_readings: int = 1500
    seed: int = 100


@dataclass(frozen=True)
class CalibrationRow:
    """One kind of map and one way to calibrate, under one condition, over all surveys.

    Attributes
    ----------
    case, method, noise, heights
        What was studied.
    wanted, solved, determined
        Calibrations tried, solved, and with all fifteen parameters determined.
    error, sigma
        Of t along x, y, z in metres, root mean square, shape (3,); sigmas of the determined.
    honesty
        Of t, (C, H) and all fifteen by name, over the determined; empty with too few. Of the time
        offset, too, where all of these know it.
    """

    case: str
    method: str
    noise: float
    heights: tuple[float, ...]
    wanted: int
    solved: int
    determined: int
    error: FloatArray
    sigma: FloatArray
    honesty: dict[str, Consistency]

    def __str__(self) -> str:
        heights = "/".join(f"{height:g}" for height in self.heights)
        error, sigma = (
            " ".join(f"{1e3 * axis:6.1f}" for axis in axes) for axes in (self.error, self.sigma)
        )
        first = (
            f"{self.case}, {self.method}, {self.noise:g} uT, survey at {heights} m: "
            f"e_t rms x y z {error} mm, sigma {sigma} mm; of {self.wanted} solved {self.solved}, "
            f"determined {self.determined}"
        )
        return "\n".join([first, *(f"  {name:<5}{h}" for name, h in self.honesty.items())])


def calibration_study(
    cases: Mapping[str, CalibrationCase],
    conditions: CalibrationConditions,
    tell: Callable[[str], None] = print,
) -> tuple[CalibrationRow, ...]:
    """Return a row for every noise, set of heights, kind and method, telling each at once.

    All kinds and methods get the same surveys, drives and starts.
    """
    rows = []
    for noise, heights in product(conditions.noises, conditions.heights):
        for name, case in cases.items():
            outcomes = _outcomes(case, conditions, noise, heights)
            for method, outcome in outcomes.items():
                wanted = conditions.surveys * conditions.drives * conditions.sensors
                rows.append(_row(name, method, noise, heights, outcome, wanted))
                tell(str(rows[-1]))
    return tuple(rows)


def _outcomes(
    case: CalibrationCase,
    conditions: CalibrationConditions,
    noise: float,
    heights: tuple[float, ...],
) -> dict[str, Outcomes]:
    """Return the outcomes of each method over all surveys."""
    parts: dict[str, list[Outcomes]] = {method: [] for method in case.methods}
    for seed in range(conditions.seed, conditions.seed + conditions.surveys):
        hall = steel_hall(seed, conditions.strength)
        surveyed = survey(hall, seed, heights, noise, conditions.survey_readings)
        field_map = case.build(Scene(surveyed, hall_cloud(hall, case.cloud, seed), hall))
        span = conditions.sensor_span or (min(heights), max(heights))
        for number, drive in enumerate(_drives(hall, conditions, seed, span, noise)):
            start = start_near(drive, seed, number, START_M)
            for method, calibrate in case.methods.items():
                solved = calibrate(drive, field_map, start)
                parts[method].append(_compared(solved, drive, seed))
    return {method: joined_rows(part) for method, part in parts.items()}


def _drives(
    hall: SteelHall,
    conditions: CalibrationConditions,
    seed: int,
    span: tuple[float, float],
    noise: float,
) -> Iterator[CalibrationDrive]:
    """Yield the drives on one survey."""
    for number in range(conditions.drives):
        own = drive_seed(seed, number)
        yield calibration_drive(hall, own, span, noise, conditions.sensors, conditions.readings)


def _compared(solved: Sequence[Solved], drive: CalibrationDrive, seed: int) -> Outcomes:
    """Return what came of one drive."""
    truth = drive.truth()
    error = [found.vector - truth[found.sensor] for found in solved]
    return Outcomes(
        np.reshape(error, (-1, 16)),
        np.reshape([found.covariance for found in solved], (-1, 16, 16)),
        np.full(len(solved), seed),
    )


def _row(
    case: str,
    method: str,
    noise: float,
    heights: tuple[float, ...],
    outcomes: Outcomes,
    wanted: int,
) -> CalibrationRow:
    """Return the figures of a method under one condition."""
    determined = outcomes[outcomes.determined_rows()]
    enough = determined.enough
    variances = np.diagonal(determined.covariance, axis1=1, axis2=2)
    blocks = determined.blocks
    return CalibrationRow(
        case,
        method,
        noise,
        heights,
        wanted,
        len(outcomes.error),
        len(determined.error),
        error=np.sqrt(np.mean(outcomes.error[:, :3] ** 2, axis=0)),
        sigma=np.sqrt(np.mean(variances[:, :3], axis=0)) if enough else np.full(3, np.nan),
        honesty={name: consistency(determined, at) for name, at in blocks.items()}
        if enough
        else {},
    )
