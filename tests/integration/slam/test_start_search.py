"""Drives whose start is looked for all over a map."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from l2m_gtsam.data import FloatArray, KnownSensor
from l2m_gtsam.errors import MapError
from l2m_gtsam.progress import silent
from l2m_gtsam.records.localisation import LocalisationStatus, StartSearch, StartVerdict
from l2m_gtsam.slam.localisation import localise, prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.start.search import find_start
from tests.drives.lost import lost_drive, searching
from tests.drives.slam import SlamDrive, calibrated
from tests.support.pose_errors import position_error
from tests.worlds.exact import DipoleWorld, dipole_world
from tests.worlds.surveyed import SurveyedWorld, strange_hall, surveyed


def searched(
    lost: tuple[tuple[KnownSensor, ...], SlamDrive], field_map: SurveyedWorld, **search: object
) -> StartSearch:
    sensors, drive = lost
    options = searching(**search)
    prepared_drive, _ = prepared(drive.recording, calibrated(sensors), options)
    return find_start(prepared_drive, field_map, options, silent)


def away(found: StartSearch, start: FloatArray) -> list[float]:
    """Return how far each candidate is from a place in metres."""
    return [float(np.linalg.norm(each.T_map_lidar.t - start)) for each in found.candidates]


@pytest.mark.parametrize("seed", range(4))
def test_a_start_anywhere_is_found(seed: int) -> None:
    """A place and a heading at random, and one that is off by no more than its sigmas say."""
    world = strange_hall(seed)
    lost = lost_drive(world, seed)
    found = searched(lost, surveyed(world))
    assert found.verdict is StartVerdict.UNIQUE
    truth, best = lost[1].truth, found.candidates[0]
    assert away(found, truth.p[0])[0] < 0.2
    turn = best.T_map_lidar.R.T @ truth.R[0]
    assert np.arccos((np.trace(turn) - 1) / 2) < np.deg2rad(3)
    # Odometry, the calibration and the tilt are better than is assumed: less is left than noise.
    assert best.chi2_per_dof < 1.5
    assert found.looked_at > 1e5


def test_the_drive_is_followed_from_there() -> None:
    world = strange_hall(7)
    sensors, drive = lost_drive(world, 7)
    options = searching()
    found = localise(drive.recording, surveyed(world), calibrated(sensors), options, silent).result
    assert found.status is LocalisationStatus.LOCALISED
    assert found.start is not None
    assert found.start.verdict is StartVerdict.UNIQUE
    assert position_error(drive.truth, found.trajectory) < 0.05


def test_a_uniform_field_tells_no_place() -> None:
    nothing = DipoleWorld(np.array([22.0, 3.0, -38.0]), np.full((1, 3), -50.0), np.zeros((1, 3)))
    found = searched(lost_drive(nothing, 1, seconds=10), surveyed(nothing))
    assert found.verdict is StartVerdict.AMBIGUOUS
    assert len(found.candidates) > 2
    # The field still tells the heading, but for its own noise and what is up.
    headings = [each.yaw_deg for each in found.candidates]
    assert np.ptp(np.unwrap(np.deg2rad(headings))) < np.deg2rad(20)


def test_a_step_into_a_hall_is_too_little() -> None:
    """Half a metre: some places look like each other."""
    world = dipole_world(1)
    lost = lost_drive(world, 2, seconds=0.8, sensors=1)
    found = searched(lost, surveyed(world))
    assert found.verdict is StartVerdict.AMBIGUOUS
    assert "longer drive" in found.message


def test_two_rooms_alike_are_both_reported() -> None:
    """The second room is the first once more, 30 m away."""
    room = strange_hall(3)
    apart = np.array([30.0, 0.0, 0.0])
    both = room.with_dipoles(room.positions + apart, room.moments)
    sensors, drive = lost_drive(both, 3)
    field_map = surveyed(both, 0.0, 30.0)
    found = searched((sensors, drive), field_map, longest_m=8.0)
    assert found.verdict is StartVerdict.AMBIGUOUS
    start = drive.truth.p[0]
    assert away(found, start)[0] < 0.2 or away(found, start + apart)[0] < 0.2
    assert min(away(found, start)) < 0.2
    assert min(away(found, start + apart)) < 0.2
    options = searching(longest_m=8.0)
    with pytest.raises(MapError, match="places of the map or more explain the readings"):
        localise(drive.recording, field_map, calibrated(sensors), options, silent)


def test_another_building_is_not_here() -> None:
    found = searched(lost_drive(strange_hall(4), 4), surveyed(strange_hall(5)))
    assert found.verdict is StartVerdict.NOT_HERE
    assert "another place" in found.message


def test_a_start_outside_of_the_map_is_not_there() -> None:
    """The drive is in a room that was not surveyed."""
    world = strange_hall(6)
    found = searched(lost_drive(world, 6), surveyed(world, 12.0))
    assert found.verdict is StartVerdict.NOT_HERE


def test_a_door_that_was_opened_does_not_hide_the_place() -> None:
    """20 uT on all sensors for a tenth of the first window."""
    world = strange_hall(8)
    sensors, drive = lost_drive(world, 8)
    series = []
    for each in drive.recording.series:
        field = each.field.copy()
        field[100:127] += np.array([20.0, -12.0, 8.0])
        series.append(replace(each, field=field))
    shut = replace(drive, recording=replace(drive.recording, series=tuple(series)))
    found = searched((sensors, shut), surveyed(world))
    assert found.verdict is StartVerdict.UNIQUE
    assert away(found, drive.truth.p[0])[0] < 0.2
    assert found.candidates[0].explained < 1


def silent_until(drive: SlamDrive, seconds: float) -> SlamDrive:
    """Return a drive whose sensors begin to send after a time."""
    first = drive.recording.trajectory.stamp_ns[0] + round(1e9 * seconds)
    series = tuple(
        replace(each, stamp_ns=each.stamp_ns[late], field=each.field[late])
        for each in drive.recording.series
        for late in [each.stamp_ns > first]
    )
    return replace(drive, recording=replace(drive.recording, series=series))


def test_sensors_that_begin_late_are_searched_with_or_the_drive_is_refused() -> None:
    """They are silent for 9 m: longer than the first window, or than the longest."""
    world = strange_hall(0)
    sensors, drive = lost_drive(world, 0, seconds=30)
    late = silent_until(drive, 15.0)
    found = searched((sensors, late), surveyed(world), window_m=4.0)
    assert found.verdict is StartVerdict.UNIQUE
    assert away(found, drive.truth.p[0])[0] < 0.5  # by odometry
    options = searching(window_m=4.0, longest_m=8.0)
    with pytest.raises(MapError, match=r"^there are no readings over the first [78]\.\d m of the"):
        localise(late.recording, surveyed(world), calibrated(sensors), options, silent)


def test_a_known_height_is_kept() -> None:
    world = strange_hall(9)
    lost = lost_drive(world, 9)
    found, free = (searched(lost, surveyed(world), height_m=h) for h in (0.5, None))
    assert found.verdict is StartVerdict.UNIQUE
    assert abs(found.candidates[0].T_map_lidar.t[2] - 0.5) < 0.1
    assert found.looked_at < 0.8 * free.looked_at


def test_a_longer_window_decides() -> None:
    """What is too little at first is enough in the end."""
    world = strange_hall(10)
    lost = lost_drive(world, 10)
    short = searched(lost, surveyed(world), window_m=0.5, longest_m=0.5)
    assert short.verdict is not StartVerdict.UNIQUE
    grown = searched(lost, surveyed(world), window_m=0.5, longest_m=8.0)
    assert grown.verdict is StartVerdict.UNIQUE
    assert grown.window_m > short.window_m
    assert away(grown, lost[1].truth.p[0])[0] < 0.2


def test_a_map_without_a_survey_is_refused() -> None:
    sensors, drive = lost_drive(dipole_world(1), 1, seconds=3)
    with pytest.raises(MapError, match="does not state where it has data"):
        localise(drive.recording, dipole_world(1), calibrated(sensors), searching(), silent)


def test_a_known_start_is_not_looked_for() -> None:
    with pytest.raises(ValidationError, match="give one of them"):
        SlamOptions.model_validate({"start": {"anywhere": True, "position": [0, 0, 0]}})
