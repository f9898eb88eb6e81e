"""Drives with several sensors through places that are mapped: recordings of others, and simulated.

Each place has the map of other drives, the calibration of its sensors, and one drive whose true
poses are known. Odometry is made of these.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap, for_solvers
from l2m_gtsam.data import (
    Distortion,
    FieldSeries,
    FloatArray,
    IntArray,
    KnownSensor,
    Recording,
    Trajectory,
)
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.mapping.map_building import map_recordings
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.maps.build import MapOptions, build_map
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.simulate.odometry import OdometryDriftOptions, drifting
from l2m_gtsam.simulate.scenario import ScenarioOptions, simulate
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.storage.files import source_file
from l2m_gtsam.studies.slam.methods import given_sensors
from l2m_gtsam.studies.slam.recordings import ROBOT, arrays_of, rotations
from l2m_gtsam.studies.slam_array.odometry import slipping, slipping_on_floor, walked
from l2m_gtsam.studies.slam_array.robot import RUNS, other_passes, robot_pass

ARRAY = "array30_simulated_10runs.npz"
ARRAY_UT, SIMULATED_UT = 0.1, 0.1  # noise of a reading
MAPPED = range(5)  # runs of the array that make its map
PERIOD_NS = 10_000_000  # of the array
EVERY = 5  # of the robot's and the array's poses: 10 and 20 a second
WALK_M = 0.06  # of simulated odometry's random walk, along each axis after a metre
FLOOR = {"height_share": 0.0, "tilt_deg_per_m": 0.0}
# Of simulated odometry: gravity holds roll and pitch, and turns are no worse than straight ways.
SCALE = {
    "stated": "ignored",
    "scale": 0.01,
    "position_share": 0.0032,
    "rotation_deg_per_m": 0.016,
    "rotation_share": 0.0,
    "tilt_deg_per_m": 0.0,
}


class Drift(StrEnum):
    """How odometry errs."""

    SLIP = "slip"
    WALK = "walk"


# A heading that wanders by 0.05 degrees after a metre wanders by 0.16 after ten. Slips are steady:
# beside them odometry errs by millimetres.
WHEELS: dict[Drift, dict[str, object]] = {
    Drift.SLIP: {
        "steady": 0.01,
        "position_share": 0.002,
        "rotation_deg_per_m": 0.016,
        "rotation_share": 0.0,
    },
    Drift.WALK: {"steady": 0.0},
}


@dataclass(frozen=True)
class DriveInMap:
    """A drive through a mapped place.

    Attributes
    ----------
    recording
        Of S sensors; its poses are the true ones.
    calibration
        Of the sensors.
    field_map
        By other drives.
    drifted
        By kind of drift, what returns odometry with the errors of a generator.
    options
        Of a localisation, by kind of drift.
    """

    recording: Recording
    calibration: CalibrationResult
    field_map: QueryableMap
    drifted: Mapping[Drift, Callable[[Trajectory, np.random.Generator], Trajectory]]
    options: dict[Drift, SlamOptions]

    @property
    def truth(self) -> Trajectory:
        """True poses."""
        return self.recording.trajectory

    def with_odometry(self, odometry: Trajectory) -> Recording:
        """Return the drive as a vehicle would record it."""
        return replace(self.recording, trajectory=odometry)


def robot(folder: Path, run: int) -> DriveInMap:
    """Return a pass of a wheeled robot with three magnetometers, in the map of the other passes.

    Raises
    ------
    ConfigError
        There is no such file, or it has no such pass.
    """
    drive = robot_pass(folder, run, EVERY)
    if run not in RUNS:
        raise ConfigError(f"{folder / ROBOT}: pass {run} is not one of {RUNS[0]} to {RUNS[-1]}")
    others = other_passes(folder, run)
    common = {"key_poses": {"distance_m": 0.1, "readings": 1}, "calibration": "refined"}
    options = {
        kind: SlamOptions.model_validate({**common, "drift": {**FLOOR, **own}})
        for kind, own in WHEELS.items()
    }
    drifted = {Drift.SLIP: slipping_on_floor, Drift.WALK: walked}
    return DriveInMap(drive, others.suite, for_solvers(others.field_map), drifted, options)


def array(folder: Path, run: int) -> DriveInMap:
    """Return a run of an array of thirty magnetometers, in the map of the first five runs.

    Raises
    ------
    ConfigError
        There is no such file, or it has no such run beyond those that are mapped.
    """
    path = folder / ARRAY
    with arrays_of(path, f"run {run} of the array", ARRAY) as arrays:
        p, quaternion = arrays["position"].astype(np.float64), arrays["quaternion_wxyz"]
        field, t = arrays["mag_uT"].astype(np.float64), arrays["sensor_positions_body"]
    if run in MAPPED or run >= len(p):
        raise ConfigError(f"{path}: run {run} is not one of 5 to {len(p) - 1}")
    R = rotations(quaternion.reshape(-1, 4)).reshape(*p.shape[:2], 3, 3)
    mapped = list(MAPPED)
    points = np.einsum("rnij,sj->rnsi", R[mapped], t) + p[mapped][:, :, None]
    there = np.einsum("rnij,rnsj->rnsi", R[mapped], field[mapped])
    field_map = build_map(points.reshape(-1, 3), there.reshape(-1, 3), MapOptions())
    stamps = PERIOD_NS * np.arange(p.shape[1], dtype=np.int64)
    names = [f"mag_{number:02d}" for number in range(len(t))]
    series = tuple(
        FieldSeries(name, f"/{name}", "lidar", stamps, field[run, :, number])
        for number, name in enumerate(names)
    )
    rows = np.arange(0, len(stamps), EVERY)
    poses = Trajectory(stamps[rows], R[run, rows], p[run, rows], "map", "lidar")
    recording = Recording(poses, series, source_file(path))
    known = [
        KnownSensor(name, at, Distortion.identity()) for name, at in zip(names, t, strict=True)
    ]
    options = SlamOptions.model_validate({"key_poses": {"distance_m": 0.1, "readings": 1}})
    return DriveInMap(
        recording,
        given_sensors(known, ARRAY_UT),
        for_solvers(field_map),
        {Drift.SLIP: slipping, Drift.WALK: walked},
        dict.fromkeys(Drift, options),
    )


def simulated(world: ScenarioOptions) -> DriveInMap:
    """Return a simulated drive with twelve sensors, in the map of its survey."""
    made = simulate(world)
    suite = {each.sensor: each for each in made.suite}
    field_map = map_recordings([made.mapping.recording], suite, MappingOptions())
    recording = replace(made.calibration.recording, trajectory=made.calibration.truth())
    walk = OdometryDriftOptions(scale=0.0, position_walk=WALK_M, frame="map")
    scale = OdometryDriftOptions(frame="map")
    of_all = {"key_poses": {"readings": 2}}
    return DriveInMap(
        recording,
        given_sensors(made.truth, SIMULATED_UT),
        for_solvers(field_map),
        {
            Drift.WALK: lambda truth, rng: drifting(truth, walk, world.noise, rng),
            Drift.SLIP: lambda truth, rng: drifting(truth, scale, world.noise, rng),
        },
        {
            Drift.WALK: SlamOptions.model_validate(of_all),
            Drift.SLIP: SlamOptions.model_validate({**of_all, "drift": SCALE}),
        },
    )


def warehouse(_: Path, seed: int) -> DriveInMap:
    """Return three laps round the racks of a simulated warehouse."""
    return simulated(scenario(seed, {"calibration_route": {"laps": 3, "turns": 0}}))


def corridor(_: Path, seed: int) -> DriveInMap:
    """Return a simulated corridor without a feature, driven twice to its end and back."""
    return simulated(scenario(seed, {"calibration_route": {"laps": 2}, "corridor": {"length": 40}}))


def scenario(seed: int, place: dict[str, object]) -> ScenarioOptions:
    """Return the options of a simulated place."""
    common = {"seed": seed, "noise": {"field": SIMULATED_UT}, "array": {"count": 12}}
    return ScenarioOptions.model_validate({**common, **place})


def strengths(
    recording: Recording, calibration: CalibrationResult, stamp_ns: IntArray
) -> FloatArray:
    """Return the field's strength at N times at the S sensors of a calibration, uT, shape (N, S).

    Readings are interpolated; NaN where a sensor has none around.
    """
    recorded = {each.sensor: each for each in recording.series}
    columns = []
    for sensor in calibration.sensors:
        series = recorded[sensor.sensor]
        offset = 0.0 if sensor.time_offset is None else sensor.time_offset.seconds
        at = stamp_ns - round(1e9 * offset)
        axes = [
            np.interp(at, series.stamp_ns, axis, left=np.nan, right=np.nan)
            for axis in series.field.T
        ]
        columns.append(np.linalg.norm(sensor.distortion.undo(np.column_stack(axes)), axis=1))
    return np.column_stack(columns)


PLACES = {"robot": robot, "array": array, "warehouse": warehouse, "corridor": corridor}
