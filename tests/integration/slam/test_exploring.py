"""Drives through places without a map, key pose by key pose."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.progress import silent
from l2m_gtsam.slam.online.belief import Belief
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.explorer import ExploringOptions
from l2m_gtsam.slam.unknown_field.field_memory import RememberedTile
from l2m_gtsam.slam.unknown_field.tiled_stages import map_drive
from l2m_gtsam.slam.unknown_field.tiles import drive_prior
from tests.drives.exploring import OnLine, prepared_drive, rms
from tests.drives.slam import calibrated, laps
from tests.worlds.exact import random_sensors

SMALL = (1.9, 1.4)  # radii of laps of 10 m
TILES = {"modes": 100, "learn_over_m": 9.0}
OFF = np.concatenate([np.full(3, 0.005), np.full(9, 0.005), np.full(3, 0.3)])
DENSE = {"distance_m": 0.055, "readings": 1}
QUICK = {"key_poses": {"distance_m": 0.3, "readings": 2}, "tiles": TILES}


def on_line(seed: int, truth: Trajectory, sensors: int, section_m: float) -> OnLine:
    options, own = SlamOptions.model_validate(QUICK), random_sensors(seed, sensors)
    drive, true = prepared_drive(seed, truth, own, calibrated(own), options)
    return OnLine.over(drive, true, options, ExploringOptions(section_m=section_m))


def assert_alike(last: Belief, other: Belief) -> None:
    """Two beliefs agree within their sigmas.

    Poses that were let go are held where they were linearised, robust weights as they were.
    """
    apart = gtsam.Pose3.Logmap(other.pose.between(last.pose))
    sigma = np.sqrt(np.diag(other.pose_covariance))
    assert np.abs(apart / sigma).max() < 0.5
    ratio = np.sqrt(np.diag(last.pose_covariance)) / sigma
    assert ratio.min() > 0.8
    assert ratio.max() < 1.3


@pytest.fixture(scope="module")
def round_and_round() -> OnLine:
    """Three laps of 10 m, with odometry that slips by 1 % of the way."""
    return on_line(2, laps(54, SMALL), 6, 6.0)


def test_laps_take_the_drift_out_while_they_are_driven(round_and_round: OnLine) -> None:
    """After the first lap less than half of the drift is left, in the end a quarter of all poses'.

    And sigmas cover it: poses of one drive err together, so that twice the six of one is allowed.
    """
    found, drift = round_and_round, round_and_round.off(round_and_round.drive.dead_reckoning())
    third = len(drift) // 3
    now = found.off([belief.pose for belief in found.beliefs])
    assert rms(now[third:]) < 0.5 * rms(drift[third:])
    assert rms(found.off(found.explorer.poses())) < rms(drift) / 4
    assert found.nees().mean() < 12


def test_poses_are_where_all_solved_together_are(round_and_round: OnLine) -> None:
    """To half of their sigmas: both have the same readings, of which none could tell them apart.

    Tiles are laid anew there, and poses that were let go hang on anchors here.
    """
    drive, options = round_and_round.drive, SlamOptions.model_validate(QUICK)
    begin = drive.dead_reckoning()
    one_size = options.tiles.model_copy(update={"last_core": options.tiles.core})  # as on line
    prior = drive_prior(drive, begin, one_size)
    batch = map_drive(drive, begin, prior, options, silent).solution
    sigma = np.sqrt(np.trace(batch.pose_covariance[:, 3:, 3:], axis1=1, axis2=2))
    pairs = zip(round_and_round.explorer.poses(), batch.poses, strict=True)
    apart = np.array([np.linalg.norm(a.translation() - b.translation()) for a, b in pairs])
    assert rms(apart) < 0.5 * rms(sigma)


def test_what_is_remembered_grows_with_the_place_alone(round_and_round: OnLine) -> None:
    """A lap and a half tell all tiles, to one at the rim; laps add nothing to that."""
    sizes = np.array(round_and_round.sizes)
    memory = round_and_round.explorer.memory
    assert sizes[-1] - sizes[len(sizes) // 2] <= max(len(each.field) + 6 for each in memory.tiles)
    kinds = [chr(gtsam.symbolChr(key)) for key in memory.known.sizes]
    assert kinds.count("M") == len(memory.tiles)
    assert kinds.count("X") <= len(memory.tiles) + 1  # anchors, and the last key pose


def test_what_waves_leave_out_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the vehicle had come to each place a thousand times before: little is learnt there.

    Less than a half of what first visits tell of the calibrations, and poses are as sure as they
    are right.
    """
    options = SlamOptions.model_validate({**QUICK, "calibration": "refined"})
    own = random_sensors(6, 6)
    known = calibrated(own, sigma=OFF)
    drive, true = prepared_drive(6, laps(45, SMALL), own, known, options)
    found = [OnLine.over(drive, true, options, ExploringOptions())]
    new = RememberedTile.new
    monkeypatch.setattr(RememberedTile, "new", lambda *its: replace(new(*its), returns=1000))
    found.append(OnLine.over(drive, true, options, ExploringOptions()))
    sigma = [
        np.sqrt(np.diagonal(each.beliefs[-1].calibration_covariance, axis1=1, axis2=2)) / OFF
        for each in found
    ]
    first, again = (1 - each**2 for each in sigma)
    assert again.sum() < 0.5 * first.sum()
    assert (again < first + 0.1).all()  # in prior variances; the poses differ, too
    assert found[1].nees().mean() < 6


def test_what_is_remembered_stays_a_covariance(round_and_round: OnLine) -> None:
    P = round_and_round.explorer.memory.known.covariance
    sigma = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / np.outer(sigma, sigma)).min() > 0


def test_before_the_prior_is_learnt_poses_are_those_of_odometry(round_and_round: OnLine) -> None:
    found, way = round_and_round, np.cumsum(np.linalg.norm(round_and_round.drive.steps.p, axis=1))
    early = int(np.searchsorted(way, TILES["learn_over_m"]))
    for belief, pose in zip(found.beliefs[:early], found.drive.dead_reckoning(), strict=False):
        assert belief.pose.equals(pose, 1e-9)
    assert not found.beliefs[early + 1].pose.equals(found.drive.dead_reckoning()[early + 1], 1e-3)


def test_sections_know_what_one_section_would() -> None:
    """Sections of 4 m and one of the whole drive, a lap and a bit: alike within sigmas."""
    short, whole = (on_line(4, laps(22, SMALL), 3, length) for length in (4.0, 1000.0))
    assert_alike(short.beliefs[-1], whole.beliefs[-1])


def test_dense_key_poses_are_let_go_once_they_settle() -> None:
    """A lap and a bit, 10 key poses a second: more than twice the sections, alike within sigmas."""
    options = SlamOptions.model_validate({**QUICK, "key_poses": DENSE})
    own = random_sensors(4, 4)
    drive, true = prepared_drive(4, laps(24, SMALL), own, calibrated(own), options)
    paces = [ExploringOptions(settled_m=settled_m) for settled_m in (0.1, 0.0)]
    short, long = (OnLine.over(drive, true, options, pace) for pace in paces)
    assert short.sections > 2 * long.sections
    assert_alike(short.beliefs[-1], long.beliefs[-1])


def test_where_nothing_is_read_odometry_carries_on() -> None:
    """A stretch of 7 m without readings, and spikes of 30 uT on the key poses before it."""
    options, own = SlamOptions.model_validate(QUICK), random_sensors(5, 3)
    drive, truth = prepared_drive(5, laps(32, SMALL), own, calibrated(own), options)
    at = drive.readings.key_pose
    spiked = np.where((at >= 34) & (at < 36), 30.0, 0.0)[:, None]
    readings = replace(drive.readings, field=drive.readings.field + spiked)
    kept = np.flatnonzero((at < 36) | (at > 60))
    found = OnLine.over(replace(drive, readings=readings[kept]), truth, options, ExploringOptions())
    variance = np.array([np.trace(belief.pose_covariance[3:, 3:]) for belief in found.beliefs])
    steps = drive.as_walk(options.drift.over_m).steps.covariance[:, 3:, 3:]
    alone = np.trace(steps[36:60], axis1=1, axis2=2).sum()
    # What odometry adds since the last reading, and a half of what was known before that.
    assert variance[60] > alone + 0.5 * variance[34]
    assert found.nees().mean() < 12
    drift = found.off(drive.dead_reckoning())
    assert rms(found.off([belief.pose for belief in found.beliefs])) < 1.2 * rms(drift)


@pytest.fixture(scope="module")
def refined() -> tuple[OnLine, OnLine, FloatArray]:
    """Three laps with calibrations off by what they state, held and refined, and their truth."""
    own = random_sensors(6, 6)
    known = calibrated(own, sigma=OFF, rng=np.random.default_rng(106))
    found = []
    for use in ("fixed", "refined"):
        options = SlamOptions.model_validate({**QUICK, "calibration": use})
        drive, true = prepared_drive(6, laps(54, SMALL), own, known, options)
        found.append(OnLine.over(drive, true, options, ExploringOptions()))
    truth = [each.vector() for each in own]
    return found[0], found[1], np.array(truth)


def test_refined_calibrations_take_errors_out_of_poses(
    refined: tuple[OnLine, OnLine, FloatArray],
) -> None:
    """Held, errors of 5 mm, 0.5 % and 0.3 uT put poses off by more than odometry drifts here."""
    held, free, _ = refined
    off = [rms(each.off([belief.pose for belief in each.beliefs])) for each in refined[:2]]
    assert off[1] < 0.5 * off[0]
    assert free.nees().mean() < 6 < held.nees().mean()


def test_sigmas_of_refined_calibrations_cover_their_errors(
    refined: tuple[OnLine, OnLine, FloatArray],
) -> None:
    """NEES of 15 parameters, over six sensors: 15 +- 2.2; five sigmas are allowed either way.

    And something is learnt: H of a sensor against the others', by a third at least. (Where tiles
    resolve little of a sensor's field, as for the first, it is hardly learnt.)
    """
    last = refined[1].beliefs[-1]
    error = last.sensors.vectors() - refined[2]
    known = last.calibration_covariance
    nees = np.mean([e @ np.linalg.solve(P, e) for e, P in zip(error, known, strict=True)])
    assert 4 < nees < 26
    sigma = np.sqrt(known[:, range(12, 15), range(12, 15)])
    assert (np.median(sigma, axis=0) < 2 / 3 * OFF[12:]).all()


def test_an_exact_calibration_stays_where_it_is() -> None:
    """A calibration may state no error at all; refined it is what it was."""
    own, options = random_sensors(2, 2), {**QUICK, "calibration": "refined"}
    known = calibrated(own, sigma=np.zeros(15))
    chosen = SlamOptions.model_validate(options)
    drive, true = prepared_drive(2, laps(22, SMALL), own, known, chosen)
    sensors = OnLine.over(drive, true, chosen, ExploringOptions()).beliefs[-1].sensors
    np.testing.assert_allclose(sensors.t, drive.sensors.t, atol=1e-6)
    np.testing.assert_allclose(sensors.distortion, drive.sensors.distortion, atol=1e-6)
