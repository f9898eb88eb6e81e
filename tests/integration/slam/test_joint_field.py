"""Drives with several sensors through a room without a map: one field for all of them."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from l2m_gtsam.data import KnownSensor
from l2m_gtsam.records.localisation import LocalisationResult, LocalisationStatus
from l2m_gtsam.slam.exploration import field_samples
from l2m_gtsam.slam.localisation import Localisation
from l2m_gtsam.studies.slam_array.odometry import walked
from tests.drives.exploring import TILES_ALONE, explored
from tests.drives.slam import SlamDrive, rounds, slam_drive
from tests.support.pose_errors import pose_nees, position_error
from tests.worlds.exact import dipole_world, random_sensors

SEED = 2
CHANGE = np.array([3.0, -2.0, 0.0])  # of one sensor's H since its calibration, uT


@dataclass(frozen=True)
class Room:
    """A drive on which one sensor is not as it was calibrated."""

    sensors: tuple[KnownSensor, ...]
    drive: SlamDrive

    def solved(self, **whole_field: int) -> Localisation:
        return explored(
            self.drive,
            self.sensors,
            key_poses={"distance_m": 0.3, "readings": 1},
            tiles={"modes": 100},
            calibration="refined",
            whole_field=whole_field,
        )


@pytest.fixture(scope="module")
def room() -> Room:
    sensors, truth = random_sensors(SEED, 3), rounds(30)
    drive = slam_drive(dipole_world(SEED), sensors, truth, np.random.default_rng(SEED))
    series = list(drive.recording.series)
    series[1] = replace(series[1], field=series[1].field + CHANGE)
    odometry = walked(truth, np.random.default_rng(SEED))
    recording = replace(drive.recording, series=tuple(series), trajectory=odometry)
    return Room(sensors, SlamDrive(recording, truth))


@pytest.fixture(scope="module")
def jointly(room: Room) -> Localisation:
    return room.solved()


def removed(room: Room, result: LocalisationResult) -> float:
    """Return the share of odometry's error that is removed."""
    truth = room.drive.truth
    return 1 - position_error(truth, result.trajectory) / position_error(truth, result.odometry)


def test_one_field_takes_drift_out_that_tiles_leave(room: Room, jointly: Localisation) -> None:
    result = jointly.result
    assert result.status is LocalisationStatus.LOCALISED
    assert result.explored is not None
    assert result.explored.tiles == 1
    assert result.gain is not None
    assert result.gain.shown
    tiles = room.solved(**TILES_ALONE).result
    assert tiles.explored is not None
    assert tiles.explored.tiles > 1
    assert removed(room, result) > max(0.5, removed(room, tiles))
    # Poses of one drive err together: no more than twice the six of one pose in the mean.
    assert pose_nees(room.drive.truth, result.trajectory).mean() < 12


def test_a_sensor_that_has_changed_is_found(room: Room, jointly: Localisation) -> None:
    refined = jointly.result.calibration
    assert refined is not None
    for number, known in enumerate(room.sensors):
        found = refined[known.sensor]
        off = found.distortion.H - known.distortion.H - (CHANGE if number == 1 else 0.0)
        assert np.linalg.norm(off) < 0.3
        # Chi squared of 3 degrees of freedom passes 16.3 once in 1,000.
        assert off @ np.linalg.solve(found.covariance[12:, 12:], off) < 16.3
    assert all(each.rejected < 0.05 * each.readings for each in jointly.result.sensors)


def test_the_field_of_the_room_is_what_it_was(jointly: Localisation) -> None:
    """But for the poses' errors of 0.1 m, in gradients of some uT/m."""
    points, field = field_samples(jointly.solution)
    truth = dipole_world(SEED).field_and_gradient(points)[0]
    assert np.sqrt(np.mean((field - truth) ** 2)) < 0.5


def test_a_field_of_too_many_waves_stays_in_tiles(room: Room, jointly: Localisation) -> None:
    """With sixty waves: more are heard, and what is left out would be no noise."""
    readings = len(jointly.solution.drive.readings)
    explored_so = room.solved(entries=60 * readings).result.explored
    assert explored_so is not None
    assert explored_so.tiles > 1
