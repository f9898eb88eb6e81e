"""What a drive is recognised by, whatever file it is in."""

from dataclasses import dataclass

from l2m_gtsam.records.metrics import Row
from l2m_gtsam.records.record import Record


@dataclass(frozen=True)
class DriveTrace(Record):
    """Some poses of a drive, spread evenly over it.

    Attributes
    ----------
    stamp_ns
        Times in nanoseconds, strictly increasing, shape (N,).
    p
        Positions of the lidar in the map in metres, shape (N, 3).
    """

    stamp_ns: tuple[int, ...]
    p: tuple[Row, ...]
