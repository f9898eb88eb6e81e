"""How far calibrations are off, and whether their covariances say so: NEES over many surveys."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.graph.alternation import OneKeyOptions
from l2m_gtsam.graph.one_key import OneKeySolution, solve_one_key
from tests.statistical.figures import (
    Band,
    chi_square_band,
    clustered_mean,
    ellipsoid_coverage,
    nees,
    wilson_interval,
)
from tests.statistical.study_maps import Build, Scene, StudiedMap
from tests.steel import MILD, CloudVariant, SteelHall, steel_hall, structure_cloud
from tests.steel_drives import CalibrationDrive, calibration_drive, survey

START_M = 0.05  # each axis of a start is at most this far from the truth
BLOCKS = {"t": slice(0, 3), "C, H": slice(3, 15), "all": slice(0, 15)}
OFFSET = slice(15, 16)


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


Trouble = Callable[[CalibrationDrive, int], CalibrationDrive]
"""What goes wrong on a drive, from a seed."""


def untroubled(drive: CalibrationDrive, _: int) -> CalibrationDrive:
    """Return the drive as it is."""
    return drive


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
    trouble
        What goes wrong on every drive.
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
    trouble: Trouble = untroubled


@dataclass(frozen=True)
class Outcomes:
    """What came of calibrations.

    Attributes
    ----------
    error
        Estimate minus truth of (t, C, H, time offset), shape (N, 16).
    covariance
        As the calibrations say, shape (N, 16, 16).
    survey
        Number of the survey of each, shape (N,).
    """

    error: FloatArray
    covariance: FloatArray
    survey: IntArray

    @classmethod
    def joined(cls, parts: "Sequence[Outcomes]") -> Self:
        """Return the outcomes of all parts."""
        return cls(
            np.concatenate([part.error for part in parts]),
            np.concatenate([part.covariance for part in parts]),
            np.concatenate([part.survey for part in parts]),
        )

    def determined(self) -> "Outcomes":
        """Return those of which t, C and H have a finite variance."""
        keep = np.isfinite(self.covariance[:, :15, :15]).all(axis=(1, 2))
        return Outcomes(self.error[keep], self.covariance[keep], self.survey[keep])


@dataclass(frozen=True)
class Honesty:
    """Whether the covariance of some parameters is true.

    Attributes
    ----------
    dof
        Number of the parameters: what the NEES is expected to be.
    nees
        Mean over all calibrations.
    standard_error
        Of that mean, surveys being independent.
    band
        Of chi-square, for as many independent calibrations as leave the mean equally unsure.
    narrow
        Of chi-square, had no two calibrations anything in common.
    coverage, coverage_band
        Of the 95 % ellipsoid, with Wilson's interval for the effective number.
    """

    dof: int
    nees: float
    standard_error: float
    band: Band
    narrow: Band
    coverage: float
    coverage_band: Band

    @property
    def honest(self) -> bool:
        """Whether the mean NEES is in its band."""
        return self.nees in self.band

    def __str__(self) -> str:
        mark = "in" if self.honest else "OUT of"
        return (
            f"NEES {self.nees:8.2f} +- {self.standard_error:<6.2f} {mark} {self.band!s:<10}"
            f" (independent: {self.narrow!s}),"
            f" 95 % ellipsoid holds {100 * self.coverage:5.1f} % ({self.coverage_band!s})"
        )


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
    honesty: dict[str, Honesty]

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


def honesty(outcomes: Outcomes, block: slice) -> Honesty:
    """Return whether the covariances of a block of the parameters are true.

    Raises
    ------
    ValueError
        If the outcomes are of fewer than two surveys.
    """
    dof = block.stop - block.start
    values = nees(outcomes.error[:, block], outcomes.covariance[:, block, block])
    mean = clustered_mean(values, outcomes.survey)
    covered = clustered_mean(ellipsoid_coverage(values, dof), outcomes.survey)
    return Honesty(
        dof,
        mean.mean,
        mean.standard_error,
        chi_square_band(dof, mean.effective),
        chi_square_band(dof, len(values)),
        covered.mean,
        wilson_interval(covered.mean, covered.effective),
    )


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
        field_map = case.build(Scene(surveyed, structure_cloud(hall, case.cloud, seed), hall))
        span = conditions.sensor_span or surveyed.span
        for number, drive in enumerate(_drives(hall, conditions, seed, span, noise)):
            start = _start(drive, seed, number)
            for method, calibrate in case.methods.items():
                solved = calibrate(drive, field_map, start)
                parts[method].append(_compared(solved, drive, seed))
    return {method: Outcomes.joined(part) for method, part in parts.items()}


def _drives(
    hall: SteelHall,
    conditions: CalibrationConditions,
    seed: int,
    span: tuple[float, float],
    noise: float,
) -> Iterator[CalibrationDrive]:
    """Yield the drives on one survey."""
    for number in range(conditions.drives):
        own = 1000 * seed + number  # no two drives of a study are alike
        drive = calibration_drive(hall, own, span, noise, conditions.sensors, conditions.readings)
        yield conditions.trouble(drive, own)


def _start(drive: CalibrationDrive, seed: int, number: int) -> FloatArray:
    """Return starts near the truth: the basin of attraction is not what is studied here."""
    rng = np.random.default_rng([seed, number, 6])
    away = rng.uniform(-START_M, START_M, (len(drive.sensors), 3))
    return np.asarray(drive.truth()[:, :3] + away)


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
    determined = outcomes.determined()
    enough = len(np.unique(determined.survey)) > 1
    variances = np.diagonal(determined.covariance, axis1=1, axis2=2)
    timed = {"offset": OFFSET} if np.isfinite(variances).all() else {}
    blocks = BLOCKS | timed
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
        honesty={name: honesty(determined, at) for name, at in blocks.items()} if enough else {},
    )
