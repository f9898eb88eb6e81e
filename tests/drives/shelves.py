"""Steel that is brought to a place: bars of known moment, by magpylib."""

from dataclasses import dataclass, replace
from typing import Any

import magpylib
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from l2m_gtsam.data import FloatArray, Recording
from l2m_gtsam.records.calibration import CalibrationResult

LIBRARY: Any = magpylib  # its classes carry no types


@dataclass(frozen=True)
class Shelf:
    """A bar: its middle in metres, moment in A m^2, and edges in metres."""

    position: tuple[float, float, float]
    moment: tuple[float, float, float]
    size: tuple[float, float, float]

    def field(self, points: FloatArray) -> FloatArray:
        """Return its field in uT, shape (N, 3)."""
        volume = np.prod(self.size)
        bar = LIBRARY.magnet.Cuboid(
            dimension=self.size,
            magnetization=np.array(self.moment) / volume,
            position=self.position,
        )
        return np.asarray(1e6 * bar.getB(points))


def with_shelves(
    recording: Recording, shelves: tuple[Shelf, ...], places: FloatArray, known: CalibrationResult
) -> Recording:
    """Return a recording whose sensors read shelves, too.

    Parameters
    ----------
    recording
        Of S sensors.
    shelves
        What was brought.
    places
        Where the sensors truly are in the lidar frame in metres, shape (S, 3).
    known
        Their distortions and clocks.
    """
    poses, series = recording.trajectory, []
    ns = poses.stamp_ns - poses.stamp_ns[0]
    turn = Slerp(ns, Rotation.from_matrix(poses.R))
    for place, each in zip(places, recording.series, strict=True):
        sensor = known[each.sensor]
        late = 0.0 if sensor.time_offset is None else sensor.time_offset.seconds
        at = np.clip(each.stamp_ns + int(1e9 * late) - poses.stamp_ns[0], 0, ns[-1])
        R = turn(at).as_matrix()
        x = R @ place + np.stack([np.interp(at, ns, axis) for axis in poses.p.T], axis=1)
        field = sum((shelf.field(x) for shelf in shelves), np.zeros_like(x))
        b_lidar = np.einsum("nji,nj->ni", R, field)
        series.append(replace(each, field=each.field + b_lidar @ sensor.distortion.C.T))
    return replace(recording, series=tuple(series))
