"""The drives through one hall at one noise level: errors, stated covariances, and the bound."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.one_key import solve_one_key
from l2m_gtsam.data import FloatArray
from l2m_gtsam.recording.sync import with_offsets
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.studies.bound import bound_at
from l2m_gtsam.studies.honesty.conditions import Condition, HonestyOptions
from l2m_gtsam.studies.honesty.outcomes import Outcomes
from l2m_gtsam.studies.honesty.place import Place, drive_through, start_near
from l2m_gtsam.studies.honesty.trouble import Disturbed
from l2m_gtsam.studies.json_array import JsonFloats

PARAMETERS = 16


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
class Cell:
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


def cell_of(options: HonestyOptions, place: Place, condition: Condition) -> Cell:
    """Calibrate on all drives through a hall."""
    drives = [drive_through(options, place, condition, n) for n in range(options.drives)]
    return Cell(
        condition=condition,
        noise=place.noise,
        survey=place.seed,
        full=stated_by(options, place, drives, Uncertainty.FULL),
        independent=stated_by(options, place, drives, Uncertainty.INDEPENDENT),
        bound=np.stack([bound_of(place, drive, options.solve) for drive in drives]),
    )


def stated_by(
    options: HonestyOptions, place: Place, drives: Sequence[Disturbed], uncertainty: Uncertainty
) -> Stated:
    """Return what calibrations of drives of one sensor say."""
    solve = options.solve.model_copy(update={"uncertainty": uncertainty})
    error = np.full((len(drives), PARAMETERS), np.nan)
    covariance = np.full((len(drives), PARAMETERS, PARAMETERS), np.nan)
    for number, disturbed in enumerate(drives):
        drive = disturbed.drive
        start = start_near(drive, place.seed, number, options.start)
        solution = solve_one_key(
            drive.readings, place.field_map, start, solve, trajectory=drive.trajectory
        )
        for found in solution.solved:
            vector = np.append(solution.estimate.vector(0), solution.estimate.offset[0])
            error[number] = vector - drive.truth()[0]
            covariance[number] = found.joint_covariance
    return Stated(error, covariance)


def bound_of(place: Place, disturbed: Disturbed, options: OneKeyOptions) -> FloatArray:
    """Return the Cramer-Rao bound of the full model for one sensor, shape (16, 16).

    Of the readings that are not spoilt, which the solve has to find out by itself; see
    ``bound_at``.
    """
    drive = disturbed.drive
    readings = drive.readings.select(disturbed.change == 0)
    if readings.motion is not None:
        readings = with_offsets(readings, drive.trajectory, drive.offset)
    truth = true_estimate(drive.truth(), place.noise)
    return bound_at(readings, place.field_map, truth, options)


def true_estimate(truth: FloatArray, noise: float) -> Estimate:
    """Return the estimate of S sensors that is true; rows as of ``Outcomes``, shape (S, 16)."""
    nothing = np.zeros(len(truth))
    return Estimate(
        t=truth[:, :3],
        distortion=truth[:, 3:15],
        noise=np.full(len(truth), noise),
        ridge=nothing,
        offset=truth[:, 15],
    )
