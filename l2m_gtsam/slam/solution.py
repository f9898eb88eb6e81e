"""A drive in the map: what a localisation comes to."""

from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_gtsam.calibration.optimise import Ending
from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.records.localisation import OdometryScale
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.map_prediction import MapPrediction

NOTHING = 1e-6  # a weight that is as good as none


@dataclass(frozen=True)
class DriveSolution:
    """A drive in the map.

    Attributes
    ----------
    drive
        With its sensors as they came out.
    poses
        Key poses, K of them.
    pose_covariance
        Of right perturbations of them, rotation (rad) before translation (m), shape (K, 6, 6).
    calibration_covariance
        Of (t, C row by row, H) in m and uT, shape (S, 15, 15); as given where it was fixed.
    prediction
        What the map says at the readings.
    interpolation_covariance
        What odometry's errors on the ways between key poses contribute to the covariance of their
        residuals, uT^2, shape (N, 3, 3).
    squared
        Squared lengths of their whitened residuals, shape (N,).
    weights
        How far each reading counts, shape (N,); zero outside of the map.
    near_changes
        Which do not because of where they are: others about them do not fit, shape (N,).
    bent
        Mean square of the whitened components by which the steps between the poses differ from
        odometry's; 1 is consistent.
    scale
        Of odometry; absent where it is no variable.
    link_squared
        Squared lengths of the whitened residuals of what scans say, shape (L,).
    ending
        How the last optimisation ended.
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
    bent: float
    scale: OdometryScale | None
    link_squared: FloatArray
    ending: Ending

    @property
    def scale_error(self) -> float:
        """Relative error of odometry's lengths: true ones are ``1 + scale_error`` times as long."""
        return 0.0 if self.scale is None else self.scale.longer

    @property
    def used(self) -> BoolArray:
        """Which readings count, shape (N,)."""
        return np.asarray(self.weights > NOTHING)
