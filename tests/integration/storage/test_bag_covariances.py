"""Covariances of poses in bags: read, moved to the lidar, or taken as unknown."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.geometry import from_ros
from l2m_gtsam.storage.bag import read_recording, read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions, FixedTransform
from l2m_gtsam.storage.inspect import inspect_bag
from tests.drives.bags import KINDS, Entry, ros, write

START = 1_700_000_000_000_000_000
STEP = 100_000_000
COUNT = 20


def stated(index: int) -> FloatArray:
    """Covariance of the k-th pose in ROS' order and axes, correlated and growing."""
    root = np.tril(np.random.default_rng(4).normal(size=(6, 6)))
    scale = np.repeat([1e-2, 2e-3], 3) * (1 + 0.1 * index)
    return np.asarray(root @ root.T * np.outer(scale, scale))


def rotations() -> FloatArray:
    return Rotation.from_rotvec(np.outer(np.arange(COUNT), [0.02, -0.01, 0.1])).as_matrix()


def poses(kind: str, covariances: list[FloatArray], *, stamped: bool = False) -> list[Entry]:
    """Odometry, or PoseWithCovarianceStamped, and a reading beside each pose."""
    make = ros(kind)
    zero = make.vector([0, 0, 0])
    twist = make("geometry_msgs/Twist", linear=zero, angular=zero)
    found = []
    for k, (R, covariance) in enumerate(zip(rotations(), covariances, strict=True)):
        stamp = START + k * STEP
        pose = make(
            "geometry_msgs/PoseWithCovariance",
            pose=make.pose([0.2 * k, 1.0, 0.5], Rotation.from_matrix(R).as_quat()),
            covariance=covariance.ravel(),
        )
        header = make.header(stamp, "map")
        if stamped:
            name = "geometry_msgs/PoseWithCovarianceStamped"
            message = make(name, header=header, pose=pose)
        else:
            name = "nav_msgs/Odometry"
            message = make(
                name,
                header=header,
                child_frame_id="base",
                pose=pose,
                twist=make(
                    "geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
                ),
            )
        found.append(Entry("/pose", name, stamp, message))
        field = np.array([20e-6, 5e-6, -40e-6]) * (1 + 0.01 * k)
        reading = make.magnetic(stamp, field)
        found.append(Entry("/mag", "sensor_msgs/MagneticField", stamp + 1, reading))
    return found


ALL = [stated(k) for k in range(COUNT)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("stamped", [False, True])
def test_covariances_are_read(tmp_path: Path, kind: str, stamped: bool) -> None:
    path = write(tmp_path, kind, poses(kind, ALL, stamped=stamped))
    found = read_recording(path, BagOptions()).trajectory.covariance
    assert found is not None
    # Rounding of the quaternions, on entries up to 1e-2 m^2.
    np.testing.assert_allclose(found, from_ros(np.array(ALL), rotations()), rtol=0, atol=1e-16)
    assert inspect_bag(path, BagOptions()).topics[1].use.endswith(", with covariance")


def test_they_are_those_of_the_lidar(tmp_path: Path) -> None:
    path = write(tmp_path, "mcap", poses("mcap", ALL))
    quaternion = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_quat()
    fixed = FixedTransform(
        translation=(0.4, -0.1, 1.2),
        quaternion_xyzw=tuple(quaternion.tolist()),
    )
    plain, moved = (
        read_trajectory(path, BagOptions(tracked_to_lidar=each)).covariance
        for each in (FixedTransform(), fixed)
    )
    rigid = fixed.rigid()
    adjoint = gtsam.Pose3(gtsam.Rot3(rigid.R), rigid.t).inverse().AdjointMap()
    assert plain is not None
    assert moved is not None
    # Roundings of entries up to 1e-2 m^2.
    np.testing.assert_allclose(moved, adjoint @ plain @ adjoint.T, rtol=0, atol=1e-16)


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((6, 6)),
        np.full((6, 6), np.nan),
        np.diag([1e-3, 1e-3, 1e6, 1e6, 1e6, 1e3]),
        -stated(0),
    ],
)
def test_one_unusable_covariance_makes_all_unknown(tmp_path: Path, wrong: FloatArray) -> None:
    path = write(tmp_path, "mcap", poses("mcap", [*ALL[:7], wrong, *ALL[8:]]))
    recording = read_recording(path, BagOptions())
    assert recording.trajectory.covariance is None
    assert len(recording.trajectory) == COUNT
    report = inspect_bag(path, BagOptions())
    assert report.topics[1].use.endswith("covariance is unknown: not usable in 1 of 20")
    assert report.obstacles == ()


def test_all_zero_is_unknown(tmp_path: Path) -> None:
    path = write(tmp_path, "ros1", poses("ros1", [np.zeros((6, 6))] * COUNT))
    assert read_trajectory(path, BagOptions()).covariance is None
    use = inspect_bag(path, BagOptions()).topics[1].use
    assert use.endswith("their covariance is unknown: all zero")


def test_a_pose_that_is_not_used_does_not_count(tmp_path: Path) -> None:
    """A stamp that is repeated, with a covariance that is nonsense, after a good one."""
    found = poses("mcap", ALL)
    again = poses("mcap", [np.full((6, 6), -1.0)] * COUNT)[6]
    path = write(
        tmp_path, "mcap", [*found, Entry("/pose", again.msgtype, START * 2, again.message)]
    )
    trajectory = read_trajectory(path, BagOptions())
    assert len(trajectory) == COUNT
    assert trajectory.covariance is not None


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_poses_of_another_topic_are_named(tmp_path: Path, kind: str) -> None:
    """Which are used and why, and how others are chosen; nothing where they were."""
    odometry = poses(kind, [np.zeros((6, 6))] * COUNT)
    other = [e for e in poses(kind, ALL, stamped=True) if e.topic == "/pose"]
    both = [*odometry, *(replace(each, topic="/lio") for each in other)]
    path = write(tmp_path, kind, sorted(both, key=lambda e: e.record_ns))
    why = "preferred to /lio; `bag.poses` chooses"
    lio, _, used = inspect_bag(path, BagOptions()).topics
    assert used.use.startswith(f"poses ({why}), their covariance is unknown")
    assert lio.use.startswith("poses, with covariance, not used")
    found = read_recording(path, BagOptions())
    assert found.notes == (f"{path}: poses are those of /pose, {why}",)
    assert found.trajectory.covariance is None
    chosen = BagOptions(poses="/lio")
    assert read_recording(path, chosen).notes == ()
    assert inspect_bag(path, chosen).topics[0].use == "poses (named by bag.poses), with covariance"
