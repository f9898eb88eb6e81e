"""What is kept of a localisation: figures beside slow references, and the file of them."""

from dataclasses import fields, replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from l2m_factors import X
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.geometry import to_ros
from l2m_gtsam.qa.metrics.evidence import DriveEvidence
from l2m_gtsam.qa.metrics.evidence import sensor_evidence as asked_again
from l2m_gtsam.qa.metrics.trajectory import localised_trajectory
from l2m_gtsam.records.localisation import OdometryScale, OdometryTurn
from l2m_gtsam.records.localisation_file import LocalisationRecord
from l2m_gtsam.slam.drive import stacked
from l2m_gtsam.slam.map_prediction import poses_in
from l2m_gtsam.slam.pose_graph import drive_values, odometry_graph
from l2m_gtsam.slam.record import odometry_covariance, sensor_evidence
from l2m_gtsam.storage.record_files import read_slam, write_slam
from tests.drives.localised import WORLD, driven, localised, record
from tests.support.pose_errors import pose_nees, position_error


@pytest.mark.parametrize(
    ("scale", "vertical", "turn"),
    [(0.03, None, 0.0), (0.0, 1.0, 0.0), (0.0, 0.3, 0.0), (0.0, None, 0.02), (0.0, 1.0, 0.02)],
)
def test_odometry_with_shared_errors_is_as_sure_as_its_graph(
    scale: float, vertical: float | None, turn: float
) -> None:
    """A scale, or a steady drift, of which less may be vertical, and which may turn."""
    drive = localised().solution.drive
    steady = drive.steps.steady
    assert steady is not None
    kept = None if vertical is None else steady * np.array([1.0, 1.0, vertical])
    turning = turn * np.abs(steady[:, :, 0]) / np.abs(steady[:, 1, 0]).mean() if turn else None
    drive = replace(drive, steps=replace(drive.steps, scale=scale, steady=kept, turning=turning))
    values = drive_values(drive, drive.dead_reckoning())
    marginals = gtsam.Marginals(odometry_graph(drive), values)
    found = odometry_covariance(drive)
    for k in range(len(drive)):
        expected = marginals.marginalCovariance(X(k))
        np.testing.assert_allclose(found[k], expected, rtol=1e-6, atol=1e-9 * expected.max())


def test_steps_along_fixed_axes_do_not_turn_with_the_vehicle() -> None:
    """Errors of positions are those of the steps: a wrong heading moves none of them."""
    drive = localised().solution.drive
    _, p = stacked(drive.dead_reckoning())
    along = np.diff(p, axis=0) @ drive.start.T_map_lidar.R
    steps = replace(drive.steps, steady=None, fixed_axes=along)
    drive = replace(drive, steps=steps)
    found = odometry_covariance(drive)
    of_steps = np.trace(steps.covariance[:, 3:, 3:], axis1=1, axis2=2)
    start = np.trace(drive.start.covariance[3:, 3:])
    expected = start + np.append(0.0, np.cumsum(of_steps))
    np.testing.assert_allclose(np.trace(found[:, 3:, 3:], axis1=1, axis2=2), expected, rtol=1e-6)


def test_odometry_is_as_sure_as_its_graph() -> None:
    drive = localised().solution.drive
    values = drive_values(drive, drive.dead_reckoning())
    marginals = gtsam.Marginals(odometry_graph(drive), values)
    found, R = odometry_covariance(drive), localised().result.odometry.R
    for k, pose in enumerate(poses_in(values, len(drive))):
        np.testing.assert_allclose(
            found[k], marginals.marginalCovariance(X(k)), rtol=1e-6, atol=1e-12
        )
        np.testing.assert_allclose(pose.rotation().matrix(), R[k], atol=1e-12)
    sigma = np.sqrt(np.diagonal(to_ros(found, R), axis1=1, axis2=2))
    drawn = localised_trajectory(record()).odometry_sigma
    # Nine digits are kept.
    np.testing.assert_allclose(drawn[:, :3], sigma[:, :3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(drawn[:, 3:], np.rad2deg(sigma[:, 3:]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("index", [0, 1])
def test_residuals_are_those_of_the_map_asked_again(index: int) -> None:
    found = localised()
    solution, calibration = found.solution, found.result.calibration
    assert calibration is not None
    rows = np.flatnonzero(solution.drive.readings.sensor == index)
    seen = sensor_evidence(solution, rows)
    everything = DriveEvidence(seen.readings, np.ones(len(rows), dtype=bool), ~seen.used)
    again = asked_again(everything, calibration[solution.drive.sensors.names[index]], WORLD)
    for name in ("place", "B_map", "b_lidar", "residual", "map_share"):
        # Rounding; fields are some 50 uT.
        np.testing.assert_allclose(getattr(seen, name), getattr(again, name), rtol=0, atol=1e-8)
    # Whitened residuals count what poses between key poses may be off, too.
    own = solution.drive.sensors.noise[index] ** 2 * np.eye(3) + seen.map_share
    e, S = seen.residual[:, :, None], own + seen.pose_share
    whole = (e * np.linalg.solve(S, e)).sum(axis=(1, 2))
    np.testing.assert_allclose((seen.white**2).sum(axis=1), whole, rtol=1e-9)
    fractions = solution.drive.readings.fraction[rows]
    between = (fractions > 0) & (fractions < 1)
    assert np.linalg.eigvalsh(seen.pose_share[between]).max(axis=1).min() > 0
    np.testing.assert_allclose(seen.pose_share[~between], 0, atol=1e-12)


def test_every_reading_is_in_the_timeline() -> None:
    for sensor in record().sensors:
        use, line = sensor.use, sensor.timeline
        assert sum(line.used) == use.used
        assert sum(line.rejected) == use.rejected
        assert sum(line.outside) == use.outside_map
        assert use.rejected > 10  # the door
        spans = np.array(line.edges)[:-1][np.array(line.rejected) > 0]
        assert 2.5 < spans.min() < spans.max() < 5.5  # it was passed from 3 s to 5 s
        assert sensor.fit is not None
        assert sensor.fit.readings == use.used


def test_errors_against_the_truth() -> None:
    truth, result, drive = record().truth, localised().result, driven()[0]
    assert truth is not None
    assert truth.poses == len(result.trajectory)
    for stated, found in ((truth.odometry, result.odometry), (truth.localised, result.trajectory)):
        assert stated.rms_m == pytest.approx(position_error(drive.truth, found), rel=1e-9)
    assert truth.nees == pytest.approx(pose_nees(drive.truth, result.trajectory).mean(), rel=1e-6)


def test_a_refined_calibration_has_both_sigmas() -> None:
    result, known = localised().result, driven()[1]
    assert result.calibration is not None
    for each in record().refined:
        before, after = known[each.sensor], result.calibration[each.sensor]
        np.testing.assert_allclose(each.before[:3], before.t_lidar_mag, atol=1e-9)
        np.testing.assert_allclose(each.after[12:], after.distortion.H, atol=1e-9)
        change = np.subtract(each.after, each.before)
        wanted = change @ np.linalg.solve(before.covariance, change)
        assert each.change.value == pytest.approx(wanted, rel=1e-4)  # nine digits of a change
        assert np.all(np.array(each.sigma_after) <= np.array(each.sigma_before) * (1 + 1e-6))


def test_the_file_comes_back(tmp_path: Path) -> None:
    path, whole = tmp_path / "slam.json", record()
    nothing = replace(whole.sensors[0].use, rms=float("nan"), chi2_per_dof=float("nan"))
    dead = replace(whole.sensors[0], use=nothing, fit=None, normalised=None, series=None)
    poses = (replace(whole.poses[0], covariance=None), *whole.poses[1:])
    less = replace(whole, sensors=(dead,), truth=None, refined=(), poses=poses)
    for each in (
        whole,
        less,
        replace(whole, scale=OdometryScale(-0.011, 0.002), turn=OdometryTurn(0.2, 0.01)),
    ):
        write_slam(path, each)
        back = read_slam(path)
        write_slam(tmp_path / "again.json", back)
        # NaN is not equal to itself, its text is.
        assert (tmp_path / "again.json").read_bytes() == path.read_bytes()
        for field in fields(LocalisationRecord):
            if field.name not in ("sensors", "truth", "picture"):
                assert getattr(back, field.name) == getattr(each, field.name)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not a localisation file of this program"),
        ('{"format": "l2m-slam", "version": 1}', "version"),
        ('{"format": "l2m-metrics", "version": 2}', "format"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "slam.json"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=message):
        read_slam(path)
