"""What a LiDAR saw in one turn: the record that readers, simulation and registration share."""

from dataclasses import dataclass

from l2m_gtsam.data import FloatArray


@dataclass(frozen=True)
class Scan:
    """The points of one turn of a LiDAR.

    Attributes
    ----------
    stamp_ns
        Time in nanoseconds.
    points
        In metres, shape (N, 3), finite. Without ``time_s`` all are in the lidar frame at the stamp;
        with it, each is in the lidar frame at its own time.
    time_s
        When each point was measured in seconds after the stamp, shape (N,); None for a snapshot.
    """

    stamp_ns: int
    points: FloatArray
    time_s: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.points)
