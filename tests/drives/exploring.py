"""Drives through places without a map, batch and key pose by key pose."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_gtsam.data import FloatArray, KnownSensor, Trajectory
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.slam.drive import EXACT_START, Drive, as_poses
from l2m_gtsam.slam.exploration import explore
from l2m_gtsam.slam.localisation import Localisation, prepared
from l2m_gtsam.slam.online.belief import Belief
from l2m_gtsam.slam.online.key_pose import key_poses_of
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.explorer import Explorer, ExploringOptions
from l2m_gtsam.studies.statistics import nees
from tests.drives.slam import SlamDrive, calibrated, slam_drive
from tests.support.pose_errors import pose_errors
from tests.worlds.exact import dipole_world

COARSE = {"distance_m": 0.3, "readings": 2}  # enough, and quick


@dataclass(frozen=True)
class OnLine:
    """What was known of each key pose when it came, and where it truly was."""

    explorer: Explorer
    drive: Drive
    beliefs: list[Belief]
    truth: list[gtsam.Pose3]
    sizes: list[int]
    sections: int

    @classmethod
    def over(
        cls, drive: Drive, truth: list[gtsam.Pose3], options: SlamOptions, pace: ExploringOptions
    ) -> "OnLine":
        """Follow a drive."""
        drive = drive.as_walk(options.drift.over_m)
        explorer, beliefs, sizes = Explorer(drive.start, drive.sensors, options, pace=pace), [], []
        memory, sections = explorer.memory, 1
        for key_pose in key_poses_of(drive):
            beliefs.append(explorer.add(key_pose))
            sizes.append(len(explorer.memory.known.covariance))
            sections += explorer.memory is not memory
            memory = explorer.memory
        beliefs[-1] = explorer.finish()
        return cls(explorer, drive, beliefs, truth, sizes, sections)

    def off(self, poses: list[gtsam.Pose3]) -> FloatArray:
        """Return how far poses are off, in metres."""
        pairs = zip(poses, self.truth, strict=True)
        return np.array([np.linalg.norm(a.translation() - b.translation()) for a, b in pairs])

    def nees(self) -> FloatArray:
        errors = pose_errors([each.pose for each in self.beliefs], self.truth)
        return nees(errors, np.stack([each.pose_covariance for each in self.beliefs]))


def rms(off: FloatArray) -> float:
    return float(np.sqrt(np.mean(off**2)))


def prepared_drive(
    seed: int,
    truth: Trajectory,
    sensors: tuple[KnownSensor, ...],
    known: CalibrationResult,
    options: SlamOptions,
) -> tuple[Drive, list[gtsam.Pose3]]:
    """Return a drive through a hall, from its first pose on, and its true key poses."""
    recorded = slam_drive(dipole_world(seed), sensors, truth, np.random.default_rng(seed))
    drive, _ = prepared(recorded.recording, known, options)
    rows = np.searchsorted(truth.stamp_ns, drive.stamp_ns)
    true = as_poses(truth.R[rows], truth.p[rows])
    return replace(drive, start=replace(drive.start, covariance=EXACT_START)), true


TILES_ALONE = {"entries": 0}  # several sensors have no field in common


def explored(drive: SlamDrive, sensors: tuple[KnownSensor, ...], **options: object) -> Localisation:
    """Return a drive solved in tiles, unless options say otherwise."""
    given = {"key_poses": COARSE, "whole_field": TILES_ALONE, **options}
    chosen = SlamOptions.model_validate(given)
    return explore(drive.recording, calibrated(sensors), chosen, silent)
