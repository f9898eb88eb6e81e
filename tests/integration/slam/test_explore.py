"""Drives through places without a map: what an unknown field takes out of the drift."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.data import KnownSensor, Trajectory
from l2m_gtsam.progress import silent
from l2m_gtsam.records.localisation import LocalisationStatus
from l2m_gtsam.slam.exploration import explore, field_samples
from l2m_gtsam.slam.localisation import Localisation
from l2m_gtsam.slam.options import SlamOptions
from tests.drives.exploring import COARSE, TILES_ALONE, explored
from tests.drives.slam import SlamDrive, calibrated, laps, slam_drive
from tests.support.pose_errors import pose_nees, position_error
from tests.worlds.exact import dipole_world, random_sensors

SENSORS = 4
FAR_APART = {"distance_m": 0.5, "readings": 2}  # on long drives
FEW_WAVES = {"modes": 100}  # as quick, and enough for as few readings


def drive_in(seed: int, truth: Trajectory) -> tuple[tuple[KnownSensor, ...], SlamDrive]:
    known = random_sensors(seed, SENSORS)
    return known, slam_drive(dipole_world(seed), known, truth, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def lapped() -> tuple[tuple[KnownSensor, ...], SlamDrive]:
    """Two and a half laps of 21 m, with odometry that slips by 1 % of the way."""
    return drive_in(1, laps(90))


@pytest.fixture(scope="module")
def plain(lapped: tuple[tuple[KnownSensor, ...], SlamDrive]) -> Localisation:
    return explored(lapped[1], lapped[0], key_poses=FAR_APART, tiles=FEW_WAVES)


def test_a_place_that_is_come_to_again_takes_the_drift_out(
    lapped: tuple[tuple[KnownSensor, ...], SlamDrive], plain: Localisation
) -> None:
    """Eight tenths of the drift over 53 m (contract), and sigmas that cover what is left."""
    truth, result = lapped[1].truth, plain.result
    assert result.status is LocalisationStatus.LOCALISED
    before = position_error(truth, result.odometry)
    assert before > 0.3
    assert position_error(truth, result.trajectory) < 0.2 * before
    # Poses of one drive err together: no more than twice the six of one pose in the mean.
    assert pose_nees(truth, result.trajectory).mean() < 12
    assert result.notes == ()
    assert result.gain is not None
    assert result.gain.shown
    assert result.gain.doubt < 1e-3


def test_the_field_along_the_way_is_what_it_was(
    lapped: tuple[tuple[KnownSensor, ...], SlamDrive], plain: Localisation
) -> None:
    """Where readings are said to be, the true field is theirs but for noise and poses' errors."""
    points, field = field_samples(plain.solution)
    truth = dipole_world(1).field_and_gradient(points)[0]
    assert np.sqrt(np.mean((field - truth) ** 2)) < 0.5
    assert len(points) == plain.solution.used.sum()


@pytest.fixture(scope="module")
def short() -> tuple[tuple[KnownSensor, ...], SlamDrive]:
    """Less than a lap."""
    return drive_in(2, laps(24))


@pytest.fixture(scope="module")
def short_plain(short: tuple[tuple[KnownSensor, ...], SlamDrive]) -> Localisation:
    return explored(short[1], short[0], tiles=FEW_WAVES)


def spiked(drive: SlamDrive) -> SlamDrive:
    """Return a drive with spikes of 30 uT on a twentieth of its readings."""
    rng, series = np.random.default_rng(7), []
    for each in drive.recording.series:
        rows = rng.random(len(each.field)) < 0.05
        field = each.field + 30 * rows[:, None] * rng.choice([-1, 1], (len(each.field), 3))
        series.append(replace(each, field=field))
    return replace(drive, recording=replace(drive.recording, series=tuple(series)))


def rejected(found: Localisation) -> float:
    """Return the share of readings that do not count."""
    sensors = found.result.sensors
    return sum(each.rejected for each in sensors) / sum(each.readings for each in sensors)


def test_readings_that_no_tile_explains_are_rejected(
    short: tuple[tuple[KnownSensor, ...], SlamDrive], short_plain: Localisation
) -> None:
    """Nearly all are found, and sigmas hold."""
    found = explored(spiked(short[1]), short[0], tiles=FEW_WAVES)
    assert rejected(short_plain) < 0.01
    assert 0.04 < rejected(found) < 0.07
    assert pose_nees(short[1].truth, found.result.trajectory).mean() < 12


@pytest.mark.study
def test_little_is_lost_where_readings_are_rejected(
    lapped: tuple[tuple[KnownSensor, ...], SlamDrive], plain: Localisation
) -> None:
    """Where the drift is taken out; on a shorter drive neither of the errors is determined."""
    sensors, drive = lapped
    found = explored(spiked(drive), sensors, key_poses=FAR_APART, tiles=FEW_WAVES)
    assert 0.04 < rejected(found) < 0.07
    error = position_error(drive.truth, found.result.trajectory)
    assert error < position_error(drive.truth, plain.result.trajectory) + 0.03


def test_where_no_place_is_come_to_again_it_is_said(
    short: tuple[tuple[KnownSensor, ...], SlamDrive], short_plain: Localisation
) -> None:
    """Little can be taken out: no gain is shown, and the poses stay those of odometry."""
    result = short_plain.result
    assert any("no place was revisited" in note for note in result.notes)
    assert result.gain is not None
    assert not result.gain.shown
    assert any(result.gain.reason in note for note in result.notes)
    trajectory = result.trajectory
    np.testing.assert_allclose(trajectory.p, result.odometry.p, atol=1e-9)
    assert pose_nees(short[1].truth, trajectory).mean() < 12
    assert trajectory.covariance is not None
    assert np.sqrt(trajectory.covariance[-1, 3:, 3:].diagonal()).min() > 0.05


def test_a_calibration_is_refined_without_a_map() -> None:
    """Places on the vehicle known to 5 cm: those of sensors to each other come out; all is covered.

    Where the whole array sits follows from turns alone, and hardly: the map shifts with it.
    """
    sensors, drive = drive_in(3, laps(60))
    sigma = np.concatenate([np.full(3, 0.05), np.full(9, 0.01), np.full(3, 1.0)])
    rough = calibrated(sensors, sigma=sigma, rng=np.random.default_rng(5))
    # Tiles that are larger than by default, of as many waves: fewer, in less time. With 100 waves
    # no gain is shown (odometry is nearer with a probability of 7 %).
    chosen = {"key_poses": COARSE, "calibration": "refined", "tiles": {"core": 4.0}}
    options = SlamOptions.model_validate({**chosen, "whole_field": TILES_ALONE})
    found = explore(drive.recording, rough, options, silent).result
    assert found.calibration is not None
    before, after, nees = [], [], []
    for truth, start in zip(sensors, rough.sensors, strict=True):
        refined = found.calibration[truth.sensor]
        error = refined.vector() - truth.vector()
        before.append(start.t_lidar_mag - truth.t_lidar_mag)
        after.append(error[:3])
        nees.append(error @ np.linalg.solve(refined.covariance, error))
    assert np.std(after, axis=0).mean() < 0.6 * np.std(before, axis=0).mean()
    # Chi squared of 15 degrees of freedom passes 37.7 once in 1,000.
    assert max(nees) < 37.7
