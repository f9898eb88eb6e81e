"""Drives whose odometry drifts, localised in magnetic maps."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.localisation import LocalisationResult, LocalisationStatus
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.localisation import in_decoy, localise
from l2m_gtsam.slam.misfit import DecoyMap, begins_elsewhere, decoy_maps
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions, StartPoseOptions
from l2m_gtsam.slam.pose_graph import solve_pose_graph
from l2m_gtsam.slam.result import localisation_result
from l2m_gtsam.slam.smoother import localise_drive
from l2m_gtsam.slam.solution import DriveSolution
from tests.drives.slam import COARSE, WIDE, SlamDrive, calibrated, small_hall
from tests.support.pose_errors import position_error
from tests.worlds.exact import BoundedWorld, dipole_world


def located(
    drive: SlamDrive,
    field_map: QueryableMap,
    known: CalibrationResult,
    **options: object,
) -> LocalisationResult:
    chosen = SlamOptions.model_validate({"key_poses": COARSE, **options})
    return localise(drive.recording, field_map, known, chosen, silent).result


def test_a_known_map_takes_the_drift_out() -> None:
    """36 m with odometry that drifts by about 1 %: within 5 cm rms throughout (contract)."""
    sensors, drive = small_hall(11, seconds=60)
    result = located(drive, dipole_world(1), calibrated(sensors))
    assert result.status is LocalisationStatus.LOCALISED
    before = position_error(drive.truth, result.odometry)
    after = position_error(drive.truth, result.trajectory)
    assert before > 0.1
    assert after < 0.05
    assert after < 0.5 * before
    # The reported drift is that from the localised poses: as true as these are.
    end = float(np.linalg.norm(result.odometry.p[-1] - drive.truth.p[-1]))
    assert result.drift.end_m == pytest.approx(end, abs=0.1)


def test_a_calibration_is_refined_unless_it_is_fixed_or_known_too_well() -> None:
    sensors, drive = small_hall(11, seconds=12)
    known, exact = calibrated(sensors, sigma=WIDE), calibrated(sensors)
    refined = [
        located(drive, dipole_world(1), each, calibration=use.value).calibration is not None
        for each in (known, exact)
        for use in (CalibrationUse.AUTO, CalibrationUse.FIXED, CalibrationUse.REFINED)
    ]
    assert refined == [True, False, True, False, False, True]


def test_a_calibration_that_is_off_is_refined() -> None:
    """C off by 0.05, H by 10 uT, t by 5 cm, and known to be: it comes nearer, within its sigmas."""
    sensors, drive = small_hall(12, seconds=24)
    rough = calibrated(sensors, sigma=WIDE, rng=np.random.default_rng(3))
    result = located(drive, dipole_world(1), rough, calibration=CalibrationUse.REFINED.value)
    assert result.status is LocalisationStatus.LOCALISED
    assert result.calibration is not None
    squared = []
    for truth, before in zip(sensors, rough.sensors, strict=True):
        after = result.calibration[truth.sensor]
        wrong = [each.vector() - truth.vector() for each in (before, after)]
        assert np.linalg.norm(wrong[1][12:]) < 0.3 * np.linalg.norm(wrong[0][12:])
        assert np.linalg.norm(wrong[1][3:12]) < 0.6 * np.linalg.norm(wrong[0][3:12])
        assert np.all(after.H_sigma < before.H_sigma)
        squared.append(wrong[1] @ np.linalg.solve(after.covariance, wrong[1]))
    # Chi squared of 15 degrees of freedom passes 37.7 once in 1,000.
    assert max(squared) < 37.7


def test_what_the_map_does_not_explain_is_rejected() -> None:
    """A steel door beside three metres of the way: 20 uT on all sensors for five seconds."""
    sensors, drive = small_hall(13, seconds=20)
    series = []
    for each in drive.recording.series:
        field = each.field.copy()
        field[160:260] += np.array([20.0, -12.0, 8.0])
        series.append(replace(each, field=field))
    shut = replace(drive, recording=replace(drive.recording, series=tuple(series)))
    result = located(shut, dipole_world(1), calibrated(sensors))
    plain = located(drive, dipole_world(1), calibrated(sensors))
    assert result.status is LocalisationStatus.LOCALISED
    rejected = [each.rejected for each in result.sensors]
    assert min(rejected) > 0.9 * 100 * 3 / 8  # three of about eight readings of a key pose
    error, reference = (position_error(drive.truth, each.trajectory) for each in (result, plain))
    assert error < reference + 0.02


def test_another_building_is_not_here() -> None:
    sensors, drive = small_hall(14, seconds=12)
    result = located(drive, dipole_world(99), calibrated(sensors))
    assert result.status is LocalisationStatus.NOT_HERE
    assert "another place" in result.message


def test_a_decoy_without_a_solution_is_no_evidence_for_the_map(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A test that could not be made is reported; a wrong map would pass it unseen."""

    def failing(drive: Drive, field_map: QueryableMap, *rest: Any) -> DriveSolution:
        if isinstance(field_map, DecoyMap):
            raise CalibrationError("the covariances of the poses cannot be computed")
        return localise_drive(drive, field_map, *rest)

    monkeypatch.setattr("l2m_gtsam.slam.localisation.localise_drive", failing)
    monkeypatch.setattr("l2m_gtsam.slam.localisation.needs_misfit_test", lambda _: True)
    sensors, drive = small_hall(14, seconds=12)
    result = located(drive, dipole_world(1), calibrated(sensors))
    assert any("in 0 of 2 decoys" in note for note in result.notes)


def test_a_drive_has_a_solution_in_decoys_of_a_map_that_ends() -> None:
    """Poses go beyond a map that is wrong: the test against decoys must not end there."""
    inner = dipole_world(1)
    world = BoundedWorld(inner.uniform, inner.positions, inner.moments)
    sensors, drive = small_hall(14, seconds=20)
    options = SlamOptions.model_validate({"key_poses": COARSE})
    solved = localise(drive.recording, world, calibrated(sensors), options, silent).solution.drive
    found = [in_decoy(solved, each, options) for each in decoy_maps(solved, world)]
    assert all(each is not None for each in found)


def test_a_map_that_fits_badly_and_only_from_another_start_is_of_another_place() -> None:
    """A rough map alone is none, nor is a start that was given inexactly."""
    sensors, drive = small_hall(14, seconds=20)
    options = SlamOptions.model_validate({"key_poses": COARSE})
    right = localise(drive.recording, dipole_world(1), calibrated(sensors), options, silent)
    good, start = right.solution, right.solution.drive.start
    away = replace(start.T_map_lidar, t=start.T_map_lidar.t + np.array([0.9, 0.0, 0.0]))
    moved = replace(good.drive, start=replace(start, T_map_lidar=away))
    rough = replace(good, squared=2 * good.squared)
    assert good.start_chi2 < 1
    assert not begins_elsewhere(rough)
    assert not begins_elsewhere(replace(good, drive=moved))
    both = replace(rough, drive=moved)
    assert begins_elsewhere(both)
    links = solve_pose_graph(moved, 0.99)
    result = localisation_result(moved, both, links, None)
    assert result.status is LocalisationStatus.NOT_HERE
    assert "and the drive would begin 0.89 m" in result.message
    assert "from the given start: another place" in result.message


def test_a_start_elsewhere_can_be_given() -> None:
    """Odometry in a frame of its own, as most is: the given start puts it into the map."""
    sensors, drive = small_hall(15, seconds=8)
    odometry, R = drive.recording.trajectory, Rotation.from_euler("z", 70, degrees=True).as_matrix()
    elsewhere = replace(odometry, R=R @ odometry.R, p=odometry.p @ R.T + np.array([30.0, 5.0, 1.0]))
    moved = replace(drive, recording=replace(drive.recording, trajectory=elsewhere))
    start = StartPoseOptions(
        position=tuple(drive.truth.p[0]),
        quaternion_xyzw=tuple(Rotation.from_matrix(drive.truth.R[0]).as_quat()),
    )
    result = located(moved, dipole_world(1), calibrated(sensors), start=start)
    plain = located(drive, dipole_world(1), calibrated(sensors))
    # The same problem but for rounding; the optimiser stops a part of a sigma early.
    np.testing.assert_allclose(result.trajectory.p, plain.trajectory.p, atol=1e-3)


def test_sensors_without_a_calibration_are_left_out() -> None:
    sensors, drive = small_hall(16, seconds=5)
    known = calibrated(sensors)
    result = located(drive, dipole_world(1), replace(known, sensors=known.sensors[:1]))
    assert [each.sensor for each in result.sensors] == ["mag_00"]
    assert result.notes == ("mag_01 is left out: it has no calibration",)
    nobody = replace(known, sensors=(replace(known.sensors[0], sensor="other"),))
    with pytest.raises(CalibrationError, match=r"none of its sensors \(mag_00, mag_01\)"):
        located(drive, dipole_world(1), nobody)
