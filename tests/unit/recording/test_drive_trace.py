"""A drive is recognised in whatever file it is, and no other drive is taken for it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.recording.drive_trace import is_of, same_drive, trace_of

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def curve(seed: int = 0, poses: int = 600, length: float = 1.0) -> Trajectory:
    """Return a minute of smooth driving, ten poses a second."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 2 * np.pi, poses)[:, None]
    p = length * sum(
        rng.normal(size=3) * np.sin(k * s + rng.uniform(0, 6, 3)) / k for k in range(1, 4)
    )
    stamp_ns = START + np.arange(poses) * (SECOND // 10)
    R = Rotation.identity(poses).as_matrix()
    return Trajectory(stamp_ns, R, np.asarray(p), "map", "lidar")


def recognised(trajectory: Trajectory, seed: int = 0) -> bool:
    return is_of(trace_of(curve(seed)), trajectory.stamp_ns, trajectory.p)


def moved(trajectory: Trajectory, by: FloatArray | float, later_ns: int = 0) -> Trajectory:
    return replace(trajectory, p=trajectory.p + by, stamp_ns=trajectory.stamp_ns + later_ns)


@given(st.integers(0, 50), st.integers(0, 400), st.integers(100, 600))
def test_a_part_of_a_drive_is_recognised(seed: int, first: int, poses: int) -> None:
    """From a sixth of it on: then three of forty poses or more are in it."""
    assert recognised(curve(seed)[np.arange(first, min(first + poses, 600))], seed)


@given(st.integers(0, 50))
def test_a_drive_that_was_written_with_millimetres_is_recognised(seed: int) -> None:
    """And with microseconds, as a table may hold it."""
    drive = curve(seed)
    stamps = np.round(drive.stamp_ns, -3)
    assert recognised(replace(drive, p=np.round(drive.p, 3), stamp_ns=stamps), seed)


@given(st.integers(0, 50), st.integers(2, 10), st.integers(0, 1))
def test_a_thinned_drive_is_recognised(seed: int, every: int, phase: int) -> None:
    """Poses that were throttled, down to one a second, and no other drive with so few."""
    few = curve(seed)[np.arange(phase, 600, every)]
    assert recognised(few, seed)
    assert not recognised(few, seed + 1)
    # half a metre beside it, as two vehicles drive
    assert not recognised(moved(few, np.array([0.0, 0.5, 0.0])), seed)


@given(st.integers(0, 50), st.integers(1, 50))
def test_another_drive_is_none(seed: int, more: int) -> None:
    drive = curve(seed)
    assert not recognised(curve(seed + more), seed)
    assert not recognised(moved(drive, 0, 3600 * SECOND), seed)
    # 5 mm beside it: as near as a vehicle that follows a line may come on another day
    assert not recognised(moved(drive, np.array([0.0, 0.005, 0.0])), seed)


@pytest.mark.parametrize("poses", [0, 1, 2])
def test_too_little_is_no_evidence(poses: int) -> None:
    drive = curve()[np.arange(poses)]
    assert not recognised(drive)
    if poses:
        assert not is_of(trace_of(drive), curve().stamp_ns, curve().p)


def test_a_vehicle_that_stands_is_anywhere() -> None:
    """At one place it is on every day; with clocks that start alike nothing tells them apart."""
    still = curve(length=1e-3)
    assert not is_of(trace_of(still), still.stamp_ns, still.p)


def test_traces_of_one_drive_are_alike() -> None:
    assert same_drive(trace_of(curve()), trace_of(moved(curve(), 0.0005)))
    assert not same_drive(trace_of(curve()), trace_of(curve(1)))
