"""Recordings of a mapping suite -> map. Pure: no files, no terminal."""

from collections.abc import Mapping, Sequence

import numpy as np

from l2m_gtsam.config import MappingOptions
from l2m_gtsam.data import FloatArray, KnownSensor, Readings, Recording
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.build import build_map
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.sync import stuck_sensors, synchronise


def map_recordings(
    recordings: Sequence[Recording],
    suite: Mapping[str, KnownSensor] | None,
    options: MappingOptions,
) -> FieldMap:
    """Build a map from one or several drives of a suite whose calibration is known.

    Parameters
    ----------
    recordings
        Drives with poses in one map frame.
    suite
        Position and distortion of every sensor by name; None means that all are ideal and sit at
        the lidar's origin.
    options
        Which readings enter, and the kind of map.

    Raises
    ------
    MapError
        Recordings in different frames, a sensor that the suite does not list, or no map from
        these readings.
    SyncError
        Readings and poses of a recording do not overlap.
    """
    frames = sorted({recording.trajectory.frame for recording in recordings})
    if len(frames) > 1:
        named = ", ".join(f"{r.source.path} in {r.trajectory.frame!r}" for r in recordings)
        msg = f"the recordings' poses are in different frames: {named}; one map frame is needed"
        raise MapError(msg)
    points, fields = [], []
    for recording in recordings:
        readings = synchronise(recording, options.sync).readings
        _refuse_stuck(readings, recording)
        known = [_known(name, suite, recording) for name in readings.sensors]
        points.append(sensor_positions(readings, known))
        fields.append(map_fields(readings, known))
    return build_map(np.concatenate(points), np.concatenate(fields), options.model)


def _refuse_stuck(readings: Readings, recording: Recording) -> None:
    """Raise a MapError for a sensor that reports one constant value: it would poison the map."""
    if stuck := [readings.sensors[index] for index in stuck_sensors(readings)]:
        msg = (
            f"{recording.source.path}: the sensor {stuck[0]!r} is stuck on one value; choose the "
            "others with `bag.fields`"
        )
        raise MapError(msg)


def sensor_positions(readings: Readings, known: Sequence[KnownSensor]) -> FloatArray:
    """Return where each reading was taken in the map frame in metres, shape (N, 3)."""
    t = np.stack([sensor.t_lidar_mag for sensor in known])[readings.sensor]
    return np.asarray(
        np.einsum("nij,nj->ni", readings.R_map_lidar, t) + readings.p_map_lidar, dtype=float
    )


def map_fields(readings: Readings, known: Sequence[KnownSensor]) -> FloatArray:
    """Return the field that each reading stands for in the map frame in uT, shape (N, 3)."""
    b_lidar = np.empty_like(readings.field)
    for index, sensor in enumerate(known):
        rows = readings.rows_of(index)
        b_lidar[rows] = sensor.distortion.undo(readings.field[rows])
    return np.asarray(np.einsum("nij,nj->ni", readings.R_map_lidar, b_lidar))


def _known(name: str, suite: Mapping[str, KnownSensor] | None, recording: Recording) -> KnownSensor:
    if suite is None:
        return KnownSensor.ideal(name)
    if name not in suite:
        msg = (
            f"{recording.source.path}: the suite does not list the sensor {name!r}; it lists "
            f"{', '.join(sorted(suite))} (choose sensors with `bag.fields`)"
        )
        raise MapError(msg)
    return suite[name]
