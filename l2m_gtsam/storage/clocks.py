"""Clocks of a bag's topics: stamps that are missing, of another time, or of a clock that was set.

Header stamps are held against the times at which the messages were recorded: what lies between is
how long they were transmitted. That jitters, but does not change for good all at once.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from l2m_gtsam.data import FieldSeries, FloatArray, IntArray, Trajectory
from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.messages import StampBuffer

# Clocks further apart than this are different clocks, not a late start.
OTHER_CLOCK_NS = 3_600_000_000_000
LEAST_S = 0.1  # by which a clock is set; less may be the load of a computer
USUAL = 10.0  # times what half of the messages jitter by, more than which is no jitter
UNSTAMPED = "all header stamps are 0; use the record time instead with `bag.stamps: record`"
OTHER_CLOCKS = (
    "their header stamps are of different clocks (simulated and record time?); try "
    "`bag.stamps: record`"
)
OTHER_TIMES = "their times are of different clocks, or since different moments"
# Before and after, over which delays are compared; what came at once, after a pause, says nothing.
NEAR_S, FAR_S = 1.0, 10.0
LEAST_MESSAGES = 5  # on either side
# Two topics whose clocks jump so near to each other, and by so nearly as much, have one clock.
SAME_NS, SAME_S = 1_000_000_000, 0.05


@dataclass(frozen=True)
class ClockJump:
    """A time at which header stamps jump against the time of recording.

    Attributes
    ----------
    record_ns
        When, by the time of recording in nanoseconds.
    after_s
        The same since the first message of the topic.
    seconds
        By how much they jump ahead; back if less than 0.
    """

    record_ns: int
    after_s: float
    seconds: float

    def is_shared(self, others: Iterable["ClockJump"]) -> bool:
        """Return whether another topic's clock jumped with this one."""
        return any(
            abs(self.record_ns - each.record_ns) < SAME_NS
            and abs(self.seconds - each.seconds) < SAME_S + 0.1 * abs(self.seconds)
            for each in others
        )

    def text(self, what: str) -> str:
        """Return a sentence about it, of stamps of a topic."""
        where = "ahead" if self.seconds > 0 else "back"
        return (
            f"header stamps of {what} jump {where} by {abs(self.seconds):.2f} s, "
            f"{self.after_s:.1f} s after the first, against the times at which they were recorded: "
            "a clock was set"
        )


def clock_jumps(stamps: StampBuffer) -> tuple[ClockJump, ...]:
    """Return where the clock of a topic was set while it was recorded.

    Delays before and after differ for good then: a message that was late, or a burst of them, is
    not meant, nor a clock that runs faster than another.
    """
    record = stamps.record()
    if len(record) <= 2 * LEAST_MESSAGES:
        return ()
    order = np.argsort(record, kind="stable")
    record, delay = record[order], np.asarray(1e-9 * (record - stamps.header())[order])
    change = np.diff(delay)
    least = LEAST_S + USUAL * float(np.median(np.abs(change)))
    found = list[ClockJump]()
    for row in np.flatnonzero(np.abs(change) > least).tolist():
        seconds = -_lasting(record, delay, row + 1)
        at = int(record[row + 1])
        again = bool(found) and at - found[-1].record_ns < 1e9 * FAR_S
        if abs(seconds) > least and not again:
            found.append(ClockJump(at, 1e-9 * float(at - record[0]), seconds))
    return tuple(found)


def _lasting(record: IntArray, delay: FloatArray, row: int) -> float:
    """Return by how much delays of some seconds from a message on exceed those before, seconds."""
    away = np.array([round(1e9 * NEAR_S), round(1e9 * FAR_S)])
    end, start = np.searchsorted(record, record[row - 1] - away)
    first, last = np.searchsorted(record, record[row] + away)
    before, after = delay[start:end], delay[first:last]
    if min(len(before), len(after)) < LEAST_MESSAGES:
        return 0.0
    return float(np.median(after) - np.median(before))


def clock_notes(
    path: Path, poses: Iterable[StampBuffer], sensors: Mapping[str, StampBuffer]
) -> tuple[str, ...]:
    """Return a sentence on each sensor whose clock was set during a recording.

    A jump that the clock of the poses makes as well is none between the two.

    Parameters
    ----------
    path
        The bag.
    poses
        Stamps of what poses are made from.
    sensors
        Stamps of magnetometers by topic.

    Raises
    ------
    BagError
        The clock of the poses was set, back, or not together with those of the sensors: poses of
        two times would lie between each other, or readings have those of other times.
    """
    own = {topic: clock_jumps(stamps) for topic, stamps in sensors.items()}
    every = [jump for jumps in own.values() for jump in jumps]
    leading = [jump for stamps in poses for jump in clock_jumps(stamps)]
    for jump in leading:
        if jump.seconds < 0 or not jump.is_shared(every):
            raise BagError(f"{path}: {jump.text('the poses')}; use `bag.stamps: record`")
    return tuple(
        f"{path}: {jump.text(f'topic {topic}')}, and its readings have poses of other times; use "
        "`bag.stamps: record`"
        for topic, jumps in own.items()
        for jump in jumps
        if not jump.is_shared(leading)
    )


def check_stamps(path: Path, what: str, stamps: IntArray) -> None:
    """Raise a BagError if no message was stamped."""
    if len(stamps) and not stamps.any():
        raise BagError(f"{path}: {what}: {UNSTAMPED}")


def check_clocks(
    path: Path, poses: Trajectory, series: tuple[FieldSeries, ...], pose_file: Path | None = None
) -> None:
    """Raise a BagError if poses and readings have different clocks.

    Parameters
    ----------
    path
        The log.
    poses, series
        What was read.
    pose_file
        File with the poses, if they are not in the log.
    """
    whose = "the poses" if pose_file is None else f"the poses of {pose_file}"
    clocks = OTHER_CLOCKS if pose_file is None else f"{OTHER_TIMES}; {set_to_meet(pose_file)}"
    for each in series:
        if not len(each) or not len(poses):
            continue
        apart = max(each.stamp_ns[0] - poses.stamp_ns[-1], poses.stamp_ns[0] - each.stamp_ns[-1])
        if apart > OTHER_CLOCK_NS:
            raise BagError(
                f"{path}: topic {each.topic} runs from {each.stamp_ns[0] * 1e-9:.3f} to "
                f"{each.stamp_ns[-1] * 1e-9:.3f} s, {whose} from {poses.stamp_ns[0] * 1e-9:.3f} "
                f"to {poses.stamp_ns[-1] * 1e-9:.3f} s: {clocks}"
            )


def set_to_meet(pose_file: Path | None) -> str:
    """Return what to do about times of poses, of a file or of the log, that miss the readings."""
    if pose_file is None:
        return "use the record time with `bag.stamps: record`"
    return f"add what lies between to the times of {pose_file} with `bag.pose_file.offset_s`"
