"""Drives followed in a map, key pose by key pose."""

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.online.belief import Belief
from l2m_gtsam.slam.online.follower import SECTION, Follower
from l2m_gtsam.slam.online.key_pose import key_poses_of
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.solve.robust import RobustOptions


def followed_beliefs(
    drive: Drive,
    field_map: QueryableMap,
    robust: RobustOptions,
    *,
    free: bool,
    section: int = SECTION,
) -> list[Belief]:
    """Return what was known of each key pose when it came, of the last when all was solved."""
    use = CalibrationUse.REFINED if free else CalibrationUse.FIXED
    options = SlamOptions(robust=robust, calibration=use)
    follower = Follower(drive.start, drive.sensors, field_map, options, section)
    beliefs = [follower.add(each) for each in key_poses_of(drive)]
    return [*beliefs[:-1], follower.finish()]
