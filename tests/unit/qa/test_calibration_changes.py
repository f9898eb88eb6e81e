"""Two calibrations beside each other, against closed forms."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, SourceFile
from l2m_gtsam.geometry import polar_rotation
from l2m_gtsam.qa.fleet import rotations_apart
from l2m_gtsam.qa.metrics.changes import (
    compare_calibrations,
    compare_sensor,
    rotation_difference,
    shape_derivatives,
)
from l2m_gtsam.qa.metrics.mounting import gains, skews_deg
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.validation import judge_validation
from l2m_gtsam.records.calibration import SensorCalibration, SensorStatus
from l2m_gtsam.records.validation import CalibrationPart
from l2m_gtsam.solve.chi_square import noticed_sigmas
from tests.drives.calibrations import SIGMA, calibration, open_in, rotations, sensor, unsolved

CHANCE = 1e-3
SEEDS = st.integers(0, 10_000)


def plain(**changes: Any) -> SensorCalibration:
    """A sensor whose errors are not correlated."""
    return sensor(**{"covariance": np.diag(SIGMA**2), **changes})


def altered(old: SensorCalibration, vector: FloatArray) -> SensorCalibration:
    """The sensor with this added to (t, C row by row, H), its rotation as it follows from C."""
    C = old.distortion.C + vector[3:12].reshape(3, 3)
    turn = polar_rotation(C, old.covariance[3:12, 3:12])
    return replace(
        old,
        t_lidar_mag=old.t_lidar_mag + vector[:3],
        distortion=Distortion(C, old.distortion.H + vector[12:]),
        R_lidar_mag=turn.R_mag_lidar.T,
        rotation_covariance=turn.covariance,
    )


def test_the_same_calibration_has_not_changed() -> None:
    found = compare_sensor(sensor(), sensor(), CHANCE)
    assert found.changes == ()
    assert all(test.chi_square == 0 and test.chance == 1 for test in found.tests)
    np.testing.assert_allclose(found.sigma, np.sqrt(2 * np.diag(sensor().covariance)), rtol=1e-6)


@given(st.floats(-20, 20), st.floats(0.1, 10))
def test_one_coordinate_by_hand(sigmas: float, ratio: float) -> None:
    """Chi-square of a shift in one uncorrelated coordinate: its square over both variances."""
    old = plain(covariance=np.diag((ratio * SIGMA) ** 2))
    shift = sigmas * SIGMA[0]
    found = compare_sensor(altered(plain(), shift * np.eye(15)[0]), old, CHANCE)
    expected = sigmas**2 / (1 + ratio**2)
    for name in ("place", "all"):
        assert found.test(name).chi_square == pytest.approx(expected, rel=1e-6, abs=1e-12)
    assert found.test("offset").chi_square == 0
    assert found.test("all").freedom == 15


@given(SEEDS)
def test_the_whole_is_the_distance_under_both_covariances(seed: int) -> None:
    d = np.random.default_rng(seed).normal(size=15) * SIGMA
    new, old = altered(sensor(), d), sensor(covariance=3 * sensor().covariance)
    S = new.covariance + old.covariance
    found = compare_sensor(new, old, CHANCE)
    assert found.test("all").chi_square == pytest.approx(d @ np.linalg.solve(S, d), rel=1e-6)
    C = d[3:12] @ np.linalg.solve(S[3:12, 3:12], d[3:12])
    assert found.test("C").chi_square == pytest.approx(C, rel=1e-6)


@given(SEEDS)
def test_it_does_not_matter_which_is_the_new_one(seed: int) -> None:
    d = 3 * np.random.default_rng(seed).normal(size=15) * SIGMA
    new, old = altered(sensor(), d), sensor()
    there, back = compare_sensor(new, old, CHANCE), compare_sensor(old, new, CHANCE)
    for name in ("place", "offset", "C", "all"):
        forth = there.test(name).chi_square
        assert back.test(name).chi_square == pytest.approx(forth, rel=1e-6)
    np.testing.assert_allclose(there.difference, -np.array(back.difference), atol=1e-9)


@pytest.mark.parametrize(
    ("part", "vector", "size"),
    [
        (CalibrationPart.PLACE, 0.03 * np.eye(15)[1], 0.03),
        (CalibrationPart.OFFSET, -3.0 * np.eye(15)[13], 3.0),
        (CalibrationPart.GAINS, 0.05 * np.eye(15)[3], 0.05),
    ],
)
def test_the_part_that_changed_is_named(
    part: CalibrationPart, vector: FloatArray, size: float
) -> None:
    (change,) = compare_sensor(altered(plain(), vector), plain(), CHANCE).changes
    assert change.part is part
    assert change.size == pytest.approx(size, rel=1e-5)
    assert change.chance < 1e-6


@given(rotations(), st.floats(1.5, 40))
def test_a_turn_is_found_about_the_axes_of_the_sensor(R: FloatArray, angle: float) -> None:
    """With its sign: from R_lidar_mag to R_lidar_mag Rz(angle), as of a fleet's drives."""
    turned = R.T @ Rotation.from_euler("z", angle, degrees=True).as_matrix()
    new, old = sensor(R_mag_lidar=turned.T), sensor(R_mag_lidar=R)
    (change,) = [
        each
        for each in compare_sensor(new, old, CHANCE).changes
        if each.part is CalibrationPart.ROTATION
    ]
    np.testing.assert_allclose(change.change, [0, 0, angle], atol=1e-5)
    assert change.size == pytest.approx(angle, rel=1e-5)
    quaternions = Rotation.from_matrix([R.T, turned]).as_quat()
    before, after = rotations_apart(quaternions)
    np.testing.assert_allclose(after - before, change.change, atol=1e-5)


@given(rotations(), SEEDS)
def test_errors_of_a_rotation_are_along_the_axes_of_the_new_one(R: FloatArray, seed: int) -> None:
    """Derivatives of the turn by both errors, differenced, about a sensor that turned little."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(0.02 * rng.normal(size=3)).as_matrix()
    roots = 1e-5 * rng.normal(size=(2, 3, 3))
    spreads = [root @ root.T for root in roots]
    old = sensor(R_mag_lidar=R, rotation_covariance=spreads[0])
    new = sensor(R_mag_lidar=turn.T @ R, rotation_covariance=spreads[1])
    expected = np.zeros((3, 3))
    for k, spread in enumerate(spreads):
        J = np.empty((3, 3))
        for axis, error in enumerate(1e-6 * np.eye(3)):
            R_old, R_new = R, new.R_lidar_mag.T
            shift = Rotation.from_rotvec(error).as_matrix()
            R_old, R_new = (shift @ R_old, R_new) if k == 0 else (R_old, shift @ R_new)
            off = Rotation.from_matrix(turn.T @ R_old @ R_new.T).as_rotvec()
            J[:, axis] = off / 1e-6
        expected += J @ spread @ J.T
    found = rotation_difference(new, old).covariance
    # differences over 1e-6 of rotations that are rounded at 1e-16
    np.testing.assert_allclose(
        found, np.rad2deg(1.0) ** 2 * expected, atol=1e-5 * np.abs(found).max()
    )


@given(SEEDS)
def test_derivatives_of_gains_and_angles(seed: int) -> None:
    """Central differences with steps of 1e-6: exact to about their square."""
    C = np.eye(3) + 0.2 * np.random.default_rng(seed).normal(size=(3, 3))
    J, step = np.empty((6, 9)), 1e-6
    for k, direction in enumerate(np.eye(9).reshape(9, 3, 3)):
        up, down = C + step * direction, C - step * direction
        J[:3, k] = (gains(up) - gains(down)) / (2 * step)
        J[3:, k] = (skews_deg(up) - skews_deg(down)) / (2 * step)
    np.testing.assert_allclose(shape_derivatives(C), J, atol=1e-6)


def test_what_one_leaves_open_is_left_out() -> None:
    """A place that the old calibration did not know may be anywhere."""
    old = open_in("mag", slice(0, 3), "t: too even a field")
    new = altered(sensor(), np.concatenate([[0.5, 0, 0], np.zeros(12)]))
    found = compare_sensor(new, old, CHANCE)
    assert found.test("place").freedom == 0
    assert found.test("all").freedom == 12
    assert found.changes == ()
    assert np.isnan(found.difference[0])
    assert np.isinf(found.sigma[0])


def test_chance_makes_as_much_as_stated() -> None:
    """Estimates of one truth with correlated errors: chi-squares are chi-squares."""
    rng, base = np.random.default_rng(1), sensor()
    root = np.linalg.cholesky(base.covariance)
    pairs = [[altered(base, root @ rng.normal(size=15)) for _ in range(2)] for _ in range(300)]
    found = [compare_sensor(new, old, 1e-2) for new, old in pairs]
    for name, freedom in (("place", 3), ("rotation", 3), ("gains", 3), ("angles", 3), ("all", 15)):
        mean = np.mean([each.test(name).chi_square for each in found])
        # five standard errors
        assert mean == pytest.approx(freedom, abs=5 * np.sqrt(2 * freedom / 300)), name
    # three expected
    assert sum(bool(each.changes) for each in found) <= 10


def test_sensors_of_one_calibration_alone_are_told() -> None:
    silent = unsolved("mag_2", SensorStatus.NO_READINGS, "it is stuck")
    new = calibration(sensor("mag_0"), sensor("mag_1"), silent)
    old = calibration(sensor("mag_0"), sensor("mag_2"), sensor("mag_3"))
    found = compare_calibrations(new, old, CHANCE)
    assert [each.sensor for each in found.sensors] == ["mag_0"]
    reasons = {each.sensor: each.reason for each in found.missing}
    assert "new calibration only" in reasons["mag_1"]
    assert "it is stuck" in reasons["mag_2"]
    assert "old calibration only" in reasons["mag_3"]


def test_it_says_how_errors_go_together() -> None:
    new = calibration(sensor())
    other = SourceFile("b", "00" * 32)
    same_map = compare_calibrations(new, replace(new, bag=other), CHANCE)
    assert "rest on one map" in same_map.assumption
    assert not same_map.same_bag
    assert compare_calibrations(new, new, CHANCE).same_bag
    apart = compare_calibrations(new, replace(new, bag=other, map=other), CHANCE)
    assert "independent" in apart.assumption
    assert "one map" not in apart.assumption


def test_joint_calibrations_that_share_a_drive_say_so() -> None:
    """One of several drives is enough, in either order; a joint calibration has no bag."""
    monday, tuesday, friday = (SourceFile(f"{k}.bag", f"{k}" * 64) for k in range(3))
    copied = replace(tuesday, path="elsewhere/1.bag")
    alone = calibration(sensor(), bag=copied)
    first = calibration(sensor(), bag=None, bags=(monday, tuesday))
    second = calibration(sensor(), bag=None, bags=(copied, friday))
    for new, old in ((first, second), (second, first), (first, alone), (alone, first)):
        found = compare_calibrations(new, old, CHANCE)
        assert found.same_bag
        assert "A drive took part in both" in found.assumption
        verdict = judge_validation(None, found, QaOptions())
        assert verdict.level == "warn"
    other = calibration(sensor(), bag=None, bags=(friday,))
    assert not compare_calibrations(first, other, CHANCE).same_bag
    unknown = calibration(sensor(), bag=None)
    assert not compare_calibrations(unknown, unknown, CHANCE).same_bag


def test_what_both_calibrations_could_not_have_shown_is_a_warning() -> None:
    """Two of them with sigmas of 10 mm each: a place that is off by 60 mm would be no news."""
    sigma = SIGMA.copy()
    sigma[:3] = 0.01
    vague = plain(covariance=np.diag(sigma**2))
    found = compare_calibrations(calibration(vague), calibration(vague), CHANCE)
    (place,) = [e for e in found.sensors[0].detectable if e.part is CalibrationPart.PLACE]
    sigmas = noticed_sigmas(3, CHANCE / 6, 0.01)
    assert place.size == pytest.approx(sigmas * np.sqrt(2) * 0.01)
    (verdict,) = judge_validation(None, found, QaOptions()).sensors
    assert verdict.level == "warn"
    assert "its place t (they show changes from 94 mm on)" in verdict.reasons[0].text


def test_a_change_by_itself_shows_where_its_part_is_known_with_others() -> None:
    """H to 3 uT and C to 0.1, but both together well: a change of one of them shows."""
    root = np.diag(SIGMA)
    root[3, 12], root[12, 12] = 0.1, 3.0
    known = plain(covariance=root @ root.T)
    found = compare_sensor(known, known, CHANCE)
    S = 2 * known.covariance
    (offset,) = [each for each in found.detectable if each.part is CalibrationPart.OFFSET]
    least = np.linalg.eigvalsh(np.linalg.inv(S)[12:, 12:])[0]
    of_whole, of_part = (noticed_sigmas(freedom, CHANCE / 6, 0.01) for freedom in (15, 3))
    assert offset.size == pytest.approx(of_whole / np.sqrt(least), rel=1e-6)
    assert offset.size < of_part * found.sigma[12]


def test_what_one_calibration_leaves_open_could_not_have_shown() -> None:
    found = compare_sensor(open_in("mag", slice(0, 1), "no height"), plain(), CHANCE)
    (place,) = [each for each in found.detectable if each.part is CalibrationPart.PLACE]
    assert np.isinf(place.size)
