"""The drives through one hall at one noise level: errors, stated covariances, and the bound."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.one_key import solve_one_key
from l2m_gtsam.data import FloatArray, IntArray, RowTable
from l2m_gtsam.recording.sync import with_offsets
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.studies.honesty.drives import (
    Condition,
    Disturbed,
    HonestyOptions,
    MappedHall,
    drive_through,
    start_near,
)
from l2m_gtsam.studies.json_arrays import JsonFloats
from l2m_gtsam.studies.methods import cramer_rao

PARAMETERS = 16
OFFSET = slice(15, 16)
BLOCKS = {"t": slice(0, 3), "C, H": slice(3, 15), "all": slice(0, 15)}


@dataclass(frozen=True)
class Outcomes(RowTable):
    """What came of N calibrations.

    Attributes
    ----------
    error
        Estimate minus truth of t in metres, C row by row, H in uT and time offset in seconds,
        NaN where there is none, shape (N, 16).
    covariance
        As the calibrations say, not finite for what is undetermined, shape (N, 16, 16).
    survey
        Number of the survey of each, shape (N,).
    """

    error: FloatArray
    covariance: FloatArray
    survey: IntArray

    def __len__(self) -> int:
        return len(self.survey)

    def solved(self) -> "Outcomes":
        """Return those that have a result."""
        return self[np.flatnonzero(np.isfinite(self.error).all(axis=1))]

    def determined_rows(self) -> IntArray:
        """Return the rows of those of which t, C and H have a result and a finite variance."""
        finite = np.isfinite(self.covariance[:, :15, :15]).all(axis=(1, 2))
        return np.flatnonzero(finite & np.isfinite(self.error).all(axis=1))

    @property
    def blocks(self) -> dict[str, slice]:
        """Parameters to judge together by name; the time offset where all of these know it."""
        timed = len(self) > 0 and bool(np.isfinite(self.covariance[:, OFFSET, OFFSET]).all())
        return BLOCKS | ({"offset": OFFSET} if timed else {})

    @property
    def enough(self) -> bool:
        """Whether these are of more than one survey."""
        return len(np.unique(self.survey)) > 1


@dataclass(frozen=True)
class Stated:
    """What calibrations of D drives say; see ``Outcomes`` for the order and the units.

    Attributes
    ----------
    error
        Estimate minus truth, NaN where there is no result, shape (D, 16).
    covariance
        Not finite for what is undetermined, shape (D, 16, 16).
    """

    error: JsonFloats
    covariance: JsonFloats


@dataclass(frozen=True)
class HonestyCell:
    """What came of the drives through one hall.

    Attributes
    ----------
    condition, noise, survey
        Which cell this is; noise in uT.
    full, independent
        What the calibrations say with each way to count the map's errors.
    bound
        Covariances that no unbiased estimate of the same data undercuts on average, shape
        (D, 16, 16); see ``bound_of``.
    """

    condition: Condition
    noise: float
    survey: int
    full: Stated
    independent: Stated
    bound: JsonFloats

    def outcomes(self, uncertainty: Uncertainty) -> Outcomes:
        """Return what the calibrations of one kind say."""
        stated = self.full if uncertainty is Uncertainty.FULL else self.independent
        survey = np.full(len(stated.error), self.survey)
        return Outcomes(stated.error, stated.covariance, survey)


def cell_of(options: HonestyOptions, hall: MappedHall, condition: Condition) -> HonestyCell:
    """Calibrate on all drives through a hall."""
    drives = [drive_through(options, hall, condition, n) for n in range(options.drives)]
    return HonestyCell(
        condition=condition,
        noise=hall.noise,
        survey=hall.seed,
        full=stated_by(options, hall, drives, Uncertainty.FULL),
        independent=stated_by(options, hall, drives, Uncertainty.INDEPENDENT),
        bound=np.stack([bound_of(hall, drive, options.solve) for drive in drives]),
    )


def stated_by(
    options: HonestyOptions, hall: MappedHall, drives: Sequence[Disturbed], uncertainty: Uncertainty
) -> Stated:
    """Return what calibrations of drives of one sensor say."""
    solve = options.solve.model_copy(update={"uncertainty": uncertainty})
    error = np.full((len(drives), PARAMETERS), np.nan)
    covariance = np.full((len(drives), PARAMETERS, PARAMETERS), np.nan)
    for number, disturbed in enumerate(drives):
        drive = disturbed.drive
        start = start_near(drive, hall.seed, number, options.start)
        solution = solve_one_key(
            drive.readings, hall.field_map, start, solve, trajectory=drive.trajectory
        )
        for found in solution.solved:
            vector = np.append(solution.estimate.vector(0), solution.estimate.offset[0])
            error[number] = vector - drive.truth()[0]
            covariance[number] = found.joint_covariance
    return Stated(error, covariance)


def bound_of(hall: MappedHall, disturbed: Disturbed, options: OneKeyOptions) -> FloatArray:
    """Return the Cramer-Rao bound of the full model for one sensor, shape (16, 16).

    Of the readings that are not spoilt, which the solve has to find out by itself; see
    ``cramer_rao``.
    """
    drive = disturbed.drive
    readings = drive.readings.select(disturbed.change == 0)
    if readings.motion is not None:
        readings = with_offsets(readings, drive.trajectory, drive.offset)
    return cramer_rao(readings, hall.field_map, drive.truth()[0], hall.noise, options)
