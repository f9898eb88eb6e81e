"""Path over which there are readings: over other path nothing of a field is learnt."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.training import FEWEST
from l2m_gtsam.slam.drive import Drive

MOST_SILENT_M = 1.0  # path without readings that still counts: fields are like that far apart


@dataclass
class ReadPath:
    """Path so far but for what is further than a metre behind the last reading.

    Attributes
    ----------
    length_m
        Its length in metres.
    silent_m
        Path since the last reading in metres.
    readings
        Number of readings.
    """

    length_m: float = 0.0
    silent_m: float = 0.0
    readings: int = 0

    @property
    def is_enough(self) -> bool:
        """Whether there are as many readings as a field can be learnt from."""
        return self.readings >= FEWEST

    def add(self, step_m: float, readings: int) -> None:
        """Add a step with so many readings."""
        self.readings += readings
        self.silent_m = 0.0 if readings else self.silent_m + step_m
        if self.silent_m <= MOST_SILENT_M:
            self.length_m += step_m


def path_with_readings(drive: Drive) -> FloatArray:
    """Return the path with readings from the start to each of K key poses, metres, shape (K,)."""
    steps = np.linalg.norm(drive.steps.p, axis=1)
    readings = np.bincount(drive.readings.key_pose, minlength=len(steps))[: len(steps)]
    path, found = ReadPath(), [0.0]
    for step_m, own in zip(steps.tolist(), readings.tolist(), strict=True):
        path.add(step_m, own)
        found.append(path.length_m)
    return np.array(found)
