"""Whether poses and calibrations found on line err as much as they say, from values far off."""

from dataclasses import dataclass

import gtsam
import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.progress import silent
from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.smoother import localise_drive
from l2m_gtsam.solve.robust import RobustOptions
from l2m_gtsam.studies.statistics import nees
from tests.drives.drawn import DrawnDrive, drawn_drive
from tests.drives.following import followed_beliefs
from tests.drives.slam import rounds
from tests.support.pose_errors import mean_nees
from tests.worlds.exact import dipole_world, random_sensors

DRIVES, SENSORS, SECONDS = 50, 3, 60
RATE, EVERY = 2, 3  # every other pose of the drive, every third of these a key pose
FAR = np.concatenate([np.full(3, 0.1), np.full(9, 0.1), np.full(3, 20.0)])
REFINED = SlamOptions(calibration=CalibrationUse.REFINED)


@dataclass(frozen=True)
class Nees:
    """Mean squared errors in units of their covariances: of poses (6) and of calibrations (15)."""

    poses: float
    calibration: float


@dataclass(frozen=True)
class Outcome:
    """NEES on line and of all poses solved together, and how far apart both end.

    ``apart`` has the distance of the calibrations in the sigmas of the latter, shape (S, 15).
    """

    on_line: Nees
    batch: Nees
    apart: FloatArray


def nees_of(
    drawn: DrawnDrive,
    poses: list[gtsam.Pose3],
    pose_covariance: FloatArray,
    sensors: KnownSensors,
    covariance: FloatArray,
) -> Nees:
    wrong = drawn.calibration - sensors.vectors()
    return Nees(
        mean_nees(poses, pose_covariance, drawn.poses), float(nees(wrong, covariance).mean())
    )


def one_drive(seed: int) -> Outcome:
    rng, world = np.random.default_rng(seed), dipole_world(seed)
    sensors, truth = random_sensors(seed, SENSORS), rounds(SECONDS)
    rows = np.arange(0, len(truth), RATE)
    drawn = drawn_drive(world, sensors, truth[rows], rng, FAR, every=EVERY)
    beliefs = followed_beliefs(drawn.drive, world, RobustOptions(), free=True)
    last = beliefs[-1]
    on_line = nees_of(
        drawn,
        [each.pose for each in beliefs],
        np.stack([each.pose_covariance for each in beliefs]),
        last.sensors,
        last.calibration_covariance,
    )
    solved = localise_drive(drawn.drive, world, REFINED, silent)
    covariance = solved.calibration_covariance
    batch = nees_of(drawn, solved.poses, solved.pose_covariance, solved.drive.sensors, covariance)
    sigma = np.sqrt(np.einsum("sii->si", covariance))
    apart = np.abs(last.sensors.vectors() - solved.drive.sensors.vectors()) / sigma
    print(
        f"drive {seed}: NEES on line {on_line.poses:.2f} {on_line.calibration:.2f}, "
        f"batch {batch.poses:.2f} {batch.calibration:.2f}, apart {apart.max():.2f}",
        flush=True,
    )
    return Outcome(on_line, batch, apart)


@pytest.mark.study
def test_errors_on_line_are_as_large_as_told() -> None:
    """NEES of 6 (poses) and 15 (calibrations) is honest; poses of a drive count as one figure.

    The mean of 50 drives has to be within three of its standard errors of that.
    """
    outcomes = [one_drive(seed) for seed in range(DRIVES)]
    for found in ([each.on_line for each in outcomes], [each.batch for each in outcomes]):
        for figures, honest in (
            (np.array([each.poses for each in found]), 6.0),
            (np.array([each.calibration for each in found]), 15.0),
        ):
            error = figures.std(ddof=1) / np.sqrt(len(figures))
            print(f"{figures.mean():.2f} +- {error:.2f}, honest {honest}")
            assert abs(figures.mean() - honest) < 3 * error
    assert max(each.apart.max() for each in outcomes) < 1.0
