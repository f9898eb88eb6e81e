"""A wheeled robot with three magnetometers under motion capture, pass by pass."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import Distortion, FieldSeries, KnownSensor, Recording, SourceFile
from l2m_gtsam.mapping.map_building import map_recordings
from l2m_gtsam.mapping.options import MappingOptions, SuiteCalibrationOptions
from l2m_gtsam.mapping.suite_calibration import calibrate_suite
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.studies.slam.recordings import ROBOT, arrays_of, tracked

SENSORS = ("invensense", "trivisio", "nexus")
TRIVISIO_UT = 46.0  # its readings are in units of about so many microtesla
RUNS = (1, 2, 3, 4)


def robot_pass(folder: Path, run: int, every: int = 1) -> Recording:
    """Return a pass with its captured poses, each ``every``-th of those at 50 Hz.

    Raises
    ------
    ConfigError
        There is no such file, or it has no such pass.
    """
    with arrays_of(folder / ROBOT, f"pass {run} of the robot", ROBOT) as arrays:
        rows = np.flatnonzero((arrays["run"] == run) & arrays["ok"])
        poses, field = tracked(arrays, rows), arrays["mag_body"][rows].astype(np.float64)
    field[:, 1] *= TRIVISIO_UT
    series = tuple(
        FieldSeries(name, f"/{name}", "lidar", poses.stamp_ns, field[:, i])
        for i, name in enumerate(SENSORS)
    )
    return Recording(poses[np.arange(0, len(poses), every)], series, SourceFile(f"run{run}", ""))


def assumed_sensors(folder: Path) -> dict[str, KnownSensor]:
    """Return the sensors at their measured places, otherwise ideal."""
    with np.load(folder / ROBOT, allow_pickle=False) as arrays:
        places = arrays["sensor_positions_body"]
    ideal = Distortion.identity()
    return {name: KnownSensor(name, at, ideal) for name, at in zip(SENSORS, places, strict=True)}


@dataclass(frozen=True)
class OtherPasses:
    """The calibration and the map that the passes but one give.

    Attributes
    ----------
    suite
        Calibrations of the three sensors.
    field_map
        Map by all of them.
    """

    suite: CalibrationResult
    field_map: QueryableMap


def other_passes(folder: Path, held_out: int) -> OtherPasses:
    """Return what the passes but one give; 14 to 24 s of one core."""
    others = [robot_pass(folder, run) for run in RUNS if run != held_out]
    options = SuiteCalibrationOptions.model_validate(
        {
            "position_m": 0.005,
            "clock_s": 0.1,
            "matrix": 0.03,
            "offset_ut": 10.0,
            "sync": {"thin_distance_m": 0.05},
            "windows": 2,
            "readings": 1500,
            "modes": 250,
        }
    )
    suite = calibrate_suite(others, assumed_sensors(folder), options, silent)
    known = {
        each.sensor: KnownSensor(
            each.sensor,
            each.t_lidar_mag,
            each.distortion,
            0.0 if each.time_offset is None else each.time_offset.seconds,
        )
        for each in suite.sensors
    }
    return OtherPasses(suite, map_recordings(others, known, MappingOptions()))
