"""A calibration as it is seen in three dimensions: map, drive, sensors and what does not fit."""

from collections.abc import Sequence

import numpy as np

from l2m_gtsam.calibration.calibrate import Calibrated
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, Recording, Trajectory
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.qa.evaluate import evidence_of
from l2m_gtsam.qa.metrics.assemble import solved_sensors
from l2m_gtsam.qa.metrics.evidence import DriveEvidence, sensor_evidence
from l2m_gtsam.qa.metrics.fit import curves
from l2m_gtsam.qa.metrics.plain import evenly
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.scene import DriveView, MapView, Scene, SensorView

AROUND = 1.5  # metres of the map on each side of a drive
LATTICE = 4000  # places of the map, about
POSES, READINGS = 2000, 2000  # of all drives, and of each sensor, at most
PAUSE_S = 1.0  # between two drives on the view's time line


@one_blas_thread()
def scene_of(recording: Recording, calibrated: Calibrated) -> Scene:
    """Return what there is to see of the sensors that were solved.

    Parameters
    ----------
    recording
        That was calibrated.
    calibrated
        The calibration, with what it rests on.
    """
    evidence = evidence_of(calibrated)
    solved = solved_sensors(calibrated.result)
    sensors = tuple(_sensor(each, evidence, calibrated.solver_map) for each in solved)
    places = np.concatenate([each.place for each in sensors])
    drives = [each.trajectory for each in recording.parts]
    seen = map_view(calibrated.field_map, places)
    return Scene(recording.source.sha256, seen, drive_views(drives), sensors)


def map_view(field_map: QueryableMap, places: FloatArray) -> MapView:
    """Return a map on a level lattice through the middle of places, shape (N, 3), around them."""
    low, high = places[:, :2].min(axis=0) - AROUND, places[:, :2].max(axis=0) + AROUND
    cell = float(np.sqrt(np.prod(high - low) / LATTICE))
    x, y = (np.arange(low[k], high[k] + cell, cell) for k in (0, 1))
    lattice = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    level = np.full(len(lattice), np.median(places[:, 2]))
    place = np.column_stack([lattice, level])
    sample = field_map.query(place)
    return MapView(place[sample.inside], sample.field[sample.inside], cell)


def drive_views(drives: Sequence[Trajectory]) -> tuple[DriveView, ...]:
    """Return the drives one after another."""
    views, start = [], 0.0
    for trajectory in drives:
        keep = evenly(len(trajectory), POSES // len(drives))
        seconds = start + 1e-9 * (trajectory.stamp_ns[keep] - trajectory.stamp_ns[0])
        views.append(DriveView(seconds, trajectory.R[keep], trajectory.p[keep]))
        start = seconds[-1] + PAUSE_S
    return tuple(views)


def _sensor(sensor: SensorCalibration, drive: DriveEvidence, field_map: QueryableMap) -> SensorView:
    evidence = sensor_evidence(drive, sensor, field_map)
    found = curves(evidence, sensor)
    keep = evenly(len(evidence.used), READINGS)
    R = evidence.readings.R_map_lidar[keep]
    return SensorView(
        sensor=sensor.sensor,
        t_lidar_mag=sensor.t_lidar_mag,
        covariance=sensor.covariance[:3, :3],
        place=evidence.place[keep],
        misfit=np.einsum("nij,nj->ni", R, (found.after - found.map)[keep]),
        rejected=~evidence.used[keep],
    )
