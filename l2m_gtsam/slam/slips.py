"""Where localised poses leave odometry by more than it states: it slipped, or a clock was set."""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.stats import chi2

from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.runs import runs

CHANCE = 1e-4  # that a step of an odometry that is as good as it states is told
FREEDOM = 6
TOLD = 3  # slips that are told one by one, the largest


@dataclass(frozen=True)
class Slip:
    """Steps in a row at which poses and odometry part.

    Attributes
    ----------
    start_s, end_s
        From and to when, since the first key pose.
    distance_m, angle_deg
        By what the poses moved further than odometry says, or less.
    times
        So many times what odometry's covariance lets expect, as a ratio of lengths.
    """

    start_s: float
    end_s: float
    distance_m: float
    angle_deg: float
    times: float

    def __str__(self) -> str:
        return (
            f"from {self.start_s:.1f} to {self.end_s:.1f} s poses move on by "
            f"{self.distance_m:.2f} m and {self.angle_deg:.1f} deg other than odometry has it, "
            f"{self.times:.1f} times what its variance allows: it slipped there, or a clock was set"
        )


def slip_notes(drive: Drive, poses: list[gtsam.Pose3], longer: float = 0.0) -> tuple[str, ...]:
    """Return a sentence on each of the largest slips, and how many more there are.

    Parameters
    ----------
    drive
        With odometry's steps.
    poses
        Key poses as they were found.
    longer
        Share by which ways are longer than odometry has them.
    """
    found = sorted(slips(drive, poses, longer), key=lambda each: -each.times)
    told = [str(each) for each in sorted(found[:TOLD], key=lambda each: each.start_s)]
    more = [f"the same is true of {len(found) - TOLD} more stretches"]
    return (*told, *(more if len(found) > TOLD else []))


def slips(drive: Drive, poses: list[gtsam.Pose3], longer: float = 0.0) -> Iterator[Slip]:
    """Yield where poses and odometry part, in order of time; arguments as above."""
    if not len(drive.steps):
        return
    errors = np.array(
        [
            gtsam.Pose3.Logmap(drive.step(k, longer).between(poses[k].between(poses[k + 1])))
            for k in range(len(drive.steps))
        ]
    )
    squared = np.einsum(
        "ni,ni->n", errors, np.linalg.solve(drive.steps.covariance, errors[:, :, None])[:, :, 0]
    )
    apart = squared > chi2.isf(CHANCE / len(squared), FREEDOM)
    seconds = 1e-9 * (drive.stamp_ns - drive.stamp_ns[0])
    for first, last in runs(apart):
        moved = errors[first:last].sum(axis=0)
        yield Slip(
            start_s=float(seconds[first]),
            end_s=float(seconds[last]),
            distance_m=float(np.linalg.norm(moved[3:])),
            angle_deg=float(np.rad2deg(np.linalg.norm(moved[:3]))),
            times=float(np.sqrt(squared[first:last].max() / FREEDOM)),
        )
