"""Whether sigmas of poses are consistent where odometry errs between key poses."""

from dataclasses import dataclass

import gtsam
import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.progress import silent
from l2m_gtsam.slam.options import DriftOptions, SlamOptions
from l2m_gtsam.slam.smoother import localise_drive
from l2m_gtsam.solve.robust import RobustOptions
from l2m_gtsam.studies.statistics import nees
from tests.drives.drawn import DrawnDrive, drawn_drive
from tests.drives.following import followed_beliefs
from tests.drives.slam import rounds
from tests.support.pose_errors import pose_errors
from tests.worlds.exact import dipole_world, random_sensors

DRIVES, SECONDS, NOISE = 10, 30, 0.2
EVERY = 3  # of poses 6 cm apart is a key pose
EXACT = np.full(15, 1e-6)
# 6 cm and 0.1 degrees of walk per root metre.
WALKING = DriftOptions(
    steady=0.0,
    position_share=0.06 / np.sqrt(10),
    rotation_deg_per_m=0.1 / np.sqrt(10),
    rotation_share=0.0,
    least_m=1e-5,
    least_deg=1e-4,
)


@dataclass(frozen=True)
class Errors:
    """NEES of poses (6 is honest), and errors of positions in metres, rms."""

    nees: float
    position: float


def drive(seed: int, sensors: int, every: int) -> DrawnDrive:
    """Return a drive of 18 m; how far apart key poses are changes nothing else."""
    poses = rounds(SECONDS)[np.arange(0, 20 * SECONDS, 2)]
    whole = poses[np.arange((len(poses) - 1) // EVERY * EVERY + 1)]
    rng, world = np.random.default_rng(seed), dipole_world(seed)
    known = random_sensors(seed, sensors)
    return drawn_drive(world, known, whole, rng, EXACT, NOISE, every, WALKING)


def errors(
    drawn: DrawnDrive, poses: list[gtsam.Pose3], covariance: FloatArray, every: int
) -> Errors:
    """Compare each so manieth key pose with the truth."""
    off = pose_errors(poses, drawn.poses)[::every]
    squared = nees(off, covariance[::every])
    return Errors(float(squared.mean()), float(np.sqrt(np.mean(np.sum(off[:, 3:] ** 2, axis=1)))))


def solved(seed: int, sensors: int, every: int) -> tuple[Errors, Errors]:
    """Return errors of all poses solved together, and of those found on line."""
    drawn, world = drive(seed, sensors, every), dipole_world(seed)
    batch = localise_drive(drawn.drive, world, SlamOptions(), silent)
    beliefs = followed_beliefs(drawn.drive, world, RobustOptions(), free=False)
    covariance = np.stack([each.pose_covariance for each in beliefs])
    poses, each = [belief.pose for belief in beliefs], EVERY // every
    found = errors(drawn, batch.poses, batch.pose_covariance, each)
    return found, errors(drawn, poses, covariance, each)


@pytest.mark.study
@pytest.mark.parametrize("sensors", [6, 12])
def test_walks_of_odometry_between_key_poses_are_told(sensors: int) -> None:
    """Three readings of a sensor between key poses, beside a key pose at each reading.

    NEES is 6 where sigmas are true; drives count as one figure each, and their mean has to be
    within three of its standard errors. Nothing that the readings know may be lost: errors are
    those of key poses at each reading, within 3 %, on line, where a step is taken at once, 10 %.
    """
    figures = np.array(
        [
            [
                [each.nees, each.position]
                for every in (EVERY, 1)
                for each in solved(seed, sensors, every)
            ]
            for seed in range(DRIVES)
        ]
    )
    for name, (each, position) in zip(
        ("together", "on line", "key poses at readings", "these on line"),
        figures.transpose(1, 2, 0),
        strict=True,
    ):
        error = each.std(ddof=1) / np.sqrt(DRIVES)
        rms = 1e3 * np.sqrt(np.mean(position**2))
        print(f"{sensors} sensors, {name}: NEES {each.mean():.2f} +- {error:.2f}, {rms:.1f} mm")
        assert abs(each.mean() - 6) < 3 * error
    rms = np.sqrt(np.mean(figures[:, :, 1] ** 2, axis=0))
    assert rms[0] < 1.03 * rms[2]
    assert rms[1] < 1.1 * rms[3]
