"""A solved drive: poses, calibrations and residuals with their covariances."""

from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_gtsam.calibration.optimise import Ending
from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.records.localisation import OdometryScale, OdometryTurn
from l2m_gtsam.slam.drive import Drive, as_pose
from l2m_gtsam.slam.map_prediction import MapPrediction

REJECTED_WEIGHT = 1e-6  # below this a reading counts as rejected


@dataclass(frozen=True)
class DriveSolution:
    """A solved drive.

    Attributes
    ----------
    drive
        The drive with the estimates of its sensors.
    poses
        Estimates of the K key poses in the map.
    pose_covariance
        Of right perturbations of the poses, rotation (rad) before translation (m), shape (K, 6, 6).
    calibration_covariance
        Of (t, C row by row, H) in m and uT, shape (S, 15, 15); as given where it was fixed.
    prediction
        The map at the N readings.
    interpolation_covariance
        Covariance of residuals by odometry's errors between key poses, uT^2, shape (N, 3, 3).
    squared
        Squared lengths of the whitened residuals, shape (N,).
    weights
        Robust weight of each reading, 0 to 1, shape (N,); zero outside of the map.
    near_changes
        Which readings are left out because others near them do not fit, shape (N,).
    odometry_chi2
        Mean square of the whitened components by which the steps between the poses differ from
        odometry's; 1 is consistent.
    scale
        Scale of odometry; None where it is no variable.
    turn
        Steady turning of odometry; None where it is no variable.
    steady
        Estimate of odometry's steady drift in its standard deviations, shape (8,), if it was a
        variable.
    link_squared
        Squared lengths of the scan links' whitened residuals, shape (L,).
    ending
        Why the last optimisation stopped.
    step_covariance
        Joint covariance of the poses before and after each of the drive's J jumps, (J, 12, 12).
    """

    drive: Drive
    poses: list[gtsam.Pose3]
    pose_covariance: FloatArray
    calibration_covariance: FloatArray
    prediction: MapPrediction
    interpolation_covariance: FloatArray
    squared: FloatArray
    weights: FloatArray
    near_changes: BoolArray
    odometry_chi2: float
    link_squared: FloatArray
    ending: Ending
    step_covariance: FloatArray
    scale: OdometryScale | None = None
    turn: OdometryTurn | None = None
    steady: FloatArray | None = None

    @property
    def scale_error(self) -> float:
        """Relative error of odometry's lengths: true ones are ``1 + scale_error`` times as long."""
        return 0.0 if self.scale is None else self.scale.longer

    @property
    def start_chi2(self) -> float:
        """Mean square of the whitened components by which the first pose differs from the start."""
        start = self.drive.start
        off = gtsam.Pose3.Logmap(as_pose(start.T_map_lidar).between(self.poses[0]))
        return float(off @ np.linalg.solve(start.covariance, off) / len(off))

    @property
    def bent(self) -> float:
        """What the poses cost against odometry, in nats."""
        return 0.5 * self.odometry_chi2 * 6 * len(self.drive)

    @property
    def used(self) -> BoolArray:
        """Which readings count, shape (N,)."""
        return np.asarray(self.weights > REJECTED_WEIGHT)
