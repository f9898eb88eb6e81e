"""Topics of what a simulation measured, but for odometry."""

from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSeries, IntArray, Trajectory
from l2m_gtsam.records.scans import Scan
from l2m_gtsam.storage.ros_messages import Channel, Dialect

TESLA_PER_MICROTESLA = 1e-6
MAGNETIC_FIELD = "sensor_msgs/msg/MagneticField"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
FLOAT32 = 7  # of PointField


class Scans(Protocol):
    """Scans of a drive, made one by one."""

    @property
    def stamp_ns(self) -> IntArray:
        """When they begin, shape (N,)."""

    def __getitem__(self, index: int, /) -> Scan: ...


def magnetic_field(dialect: Dialect, series: FieldSeries, noise: float) -> Channel:
    """Return the readings of one sensor in tesla, whose noise is given in microtesla."""
    field = series.field * TESLA_PER_MICROTESLA
    stamps = series.stamp_ns.tolist()
    covariance = np.eye(3).ravel() * (noise * TESLA_PER_MICROTESLA) ** 2

    def message(index: int) -> Any:
        return dialect.make(
            MAGNETIC_FIELD,
            header=dialect.header(index, stamps[index], series.frame),
            magnetic_field=dialect.vector(field[index]),
            magnetic_field_covariance=covariance,
        )

    return Channel(series.topic, MAGNETIC_FIELD, series.stamp_ns, message)


def poses(dialect: Dialect, trajectory: Trajectory, topic: str) -> Channel:
    """Return poses alone."""
    quaternions = Rotation.from_matrix(trajectory.R).as_quat()
    stamps = trajectory.stamp_ns.tolist()

    def message(index: int) -> Any:
        return dialect.make(
            POSE_STAMPED,
            header=dialect.header(index, stamps[index], trajectory.frame),
            pose=dialect.pose(trajectory.p[index], quaternions[index]),
        )

    return Channel(topic, POSE_STAMPED, trajectory.stamp_ns, message)


def point_clouds(dialect: Dialect, scans: Scans, frame: str, topic: str) -> Channel:
    """Return scans in single precision: x, y, z, and the seconds since the stamp if it has them."""

    def message(index: int) -> Any:
        scan = scans[index]
        columns = scan.points if scan.time_s is None else np.c_[scan.points, scan.time_s]
        names = ("x", "y", "z", "time")[: columns.shape[1]]
        fields = [
            dialect.make(
                "sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=FLOAT32, count=1
            )
            for k, name in enumerate(names)
        ]
        return dialect.make(
            POINT_CLOUD,
            header=dialect.header(index, scan.stamp_ns, frame),
            height=1,
            width=len(scan),
            fields=fields,
            is_bigendian=False,
            point_step=4 * len(names),
            row_step=4 * len(names) * len(scan),
            data=np.ascontiguousarray(columns, dtype="<f4").view(np.uint8).ravel(),
            is_dense=True,
        )

    return Channel(topic, POINT_CLOUD, scans.stamp_ns, message)
