"""Options of poses from point clouds, composed of those of their steps."""

from enum import StrEnum

from l2m_gtsam.lidar.loop_closures import LoopOptions
from l2m_gtsam.lidar.odometry import ScanOdometryOptions
from l2m_gtsam.lidar.scan_localisation import (
    ScanLocalisationOptions,
    ScanSearchOptions,
    ScanStartOptions,
)
from l2m_gtsam.options import Options
from l2m_gtsam.records.scans import ScanOptions


class PoseSource(StrEnum):
    """Where the poses of a drive in a map come from."""

    AUTO = "auto"
    CLOUDS = "clouds"


class PointCloudOptions(Options):
    """How poses come from point clouds."""

    poses: PoseSource = PoseSource.AUTO
    """`auto`: from the clouds where a bag has no poses of its own, and the map has a cloud; or
    `clouds`: from the clouds, whatever else there is."""
    topic: str | None = None
    """Topic of type sensor_msgs/PointCloud2; if not given, the only one of the bag. Scans are in
    the frame of the lidar."""
    scan: ScanOptions = ScanOptions()
    """What is taken of each scan."""
    odometry: ScanOdometryOptions = ScanOdometryOptions()
    """How the lidar is followed from scan to scan."""
    start: ScanStartOptions | None = None
    """Where the drive begins in the map; if not given, searched for along the mapping drives."""
    search: ScanSearchOptions = ScanSearchOptions()
    """How it is searched for."""
    localisation: ScanLocalisationOptions = ScanLocalisationOptions()
    """How scans are localised on the map's cloud."""
    loops: LoopOptions = LoopOptions()
    """How places are recognised that a drive returns to."""
