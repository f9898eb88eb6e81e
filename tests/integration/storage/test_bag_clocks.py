"""Clocks that are set while a bag is recorded."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bag import read_recording
from l2m_gtsam.storage.bag_options import BagOptions, Stamps
from l2m_gtsam.storage.clocks import clock_jumps
from l2m_gtsam.storage.messages import StampBuffer
from tests.drives.bags import Entry, ros, write

START = 1_700_000_000_000_000_000
RATE_HZ = 10
COUNT = 60 * RATE_HZ
MIDDLE = COUNT // 2


def times(ahead_s: FloatArray, delay_s: FloatArray) -> StampBuffer:
    """Return stamps of a clock that is so far ahead, of messages that took so long."""
    buffer = StampBuffer()
    for k, (ahead, delay) in enumerate(zip(ahead_s, delay_s, strict=True)):
        true = START + k * 1_000_000_000 // RATE_HZ
        buffer.add(true + round(1e9 * ahead), true + round(1e9 * delay))
    return buffer


def usual(seed: int) -> FloatArray:
    """Return delays of 20 ms that jitter by some."""
    return 0.02 + np.random.default_rng(seed).exponential(0.005, COUNT)


@given(
    st.integers(3 * RATE_HZ, COUNT - 3 * RATE_HZ),
    st.floats(0.2, 1e9),
    st.sampled_from([-1, 1]),
    st.integers(0, 99),
)
def test_a_clock_that_is_set_is_found(row: int, seconds: float, sign: int, seed: int) -> None:
    ahead = np.where(np.arange(COUNT) < row, 0.0, sign * seconds)
    (jump,) = clock_jumps(times(ahead, usual(seed)))
    assert jump.seconds == pytest.approx(sign * seconds, abs=0.01)
    assert jump.after_s == pytest.approx(row / RATE_HZ, abs=0.1)
    assert jump.text("topic /mag").startswith(
        f"header stamps of topic /mag jump {'ahead' if sign > 0 else 'back'} by "
    )


@given(st.integers(1, COUNT - 2), st.integers(1, 100), st.integers(0, 99))
def test_messages_that_are_late_are_no_jump(row: int, count: int, seed: int) -> None:
    """A pause of up to ten seconds, after which all come at once; one late message."""
    delay, end = usual(seed), min(row + count, COUNT - 1)
    held = np.arange(row, end)
    delay[held] = np.maximum(delay[held], (end - held) / RATE_HZ)
    assert clock_jumps(times(np.zeros(COUNT), delay)) == ()
    # Some of them are lost.
    kept = np.delete(np.arange(COUNT), held[5:-5])
    whole, some = times(np.zeros(COUNT), delay), StampBuffer()
    for k in kept:
        some.add(int(whole.header()[k]), int(whole.record()[k]))
    assert clock_jumps(some) == ()


@given(st.floats(0.2, 5.0), st.integers(0, 99))
def test_a_clock_of_another_speed_is_no_jump(speed: float, seed: int) -> None:
    """Simulated time runs slower or faster than that of recording."""
    true = np.arange(COUNT) / RATE_HZ
    assert clock_jumps(times((speed - 1) * true, usual(seed))) == ()


def bag(folder: Path, **ahead_s: float) -> Path:
    """Write a minute in which the clocks of some topics are set half way."""
    make, entries = ros("mcap"), []
    for k in range(COUNT):
        true = START + k * 1_000_000_000 // RATE_HZ
        set_by = {name: round(1e9 * by) if k >= MIDDLE else 0 for name, by in ahead_s.items()}
        stamp = true + set_by.get("pose", 0)
        pose = make.pose_stamped(stamp, [0.06 * k, 0, 0], [0, 0, 0, 1])
        entries.append(Entry("/pose", "geometry_msgs/PoseStamped", true + 20_000_000, pose))
        for name in ("front", "rear"):
            field = np.array([20, 5, -40]) + np.sin([k, 2 * k, 3 * k])
            reading = make.magnetic(true + set_by.get(name, 0), 1e-6 * field)
            entry = Entry(f"/{name}", "sensor_msgs/MagneticField", true + 1_000_000, reading)
            entries.append(entry)
    return write(folder, "mcap", entries)


def test_a_sensor_whose_clock_is_set_is_named(tmp_path: Path) -> None:
    path = bag(tmp_path, rear=0.3)
    (note,) = read_recording(path, BagOptions()).notes
    assert "header stamps of topic /rear jump ahead by 0.30 s, 30.0 s after the first" in note
    assert "`bag.stamps: record`" in note
    assert read_recording(path, BagOptions(stamps=Stamps.RECORD)).notes == ()


@pytest.mark.parametrize(("seconds", "where"), [(2.0, "ahead"), (-2.0, "back")])
def test_poses_whose_clock_is_set_are_refused(tmp_path: Path, seconds: float, where: str) -> None:
    path = bag(tmp_path, pose=seconds)
    line = f"header stamps of the poses jump {where} by 2.00 s.*`bag.stamps: record`"
    with pytest.raises(BagError, match=line):
        read_recording(path, BagOptions())
    found = read_recording(path, BagOptions(stamps=Stamps.RECORD))
    assert len(found.trajectory) == COUNT


def test_clocks_that_are_set_together_agree(tmp_path: Path) -> None:
    """Ahead, they leave a gap; back, times come twice, and poses lie between each other."""
    ahead = read_recording(bag(tmp_path, pose=2.0, front=2.0, rear=2.0), BagOptions())
    assert ahead.notes == ()
    (tmp_path / "back").mkdir()
    back = bag(tmp_path / "back", pose=-2.0, front=-2.0, rear=-2.0)
    with pytest.raises(BagError, match=r"the poses jump back by 2\.00 s"):
        read_recording(back, BagOptions())
