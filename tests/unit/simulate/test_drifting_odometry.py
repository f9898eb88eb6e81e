"""Odometry that drifts: by how much, and whether its covariances say so."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform, Trajectory
from l2m_gtsam.geometry import moved
from l2m_gtsam.simulate.odometry import OdometryDriftOptions, OdometryOrigin, drifting
from l2m_gtsam.simulate.sensors import NoiseOptions
from l2m_gtsam.slam.odometry import odometry_steps
from l2m_gtsam.slam.options import DriftOptions, Usage

SILENT = NoiseOptions(field=0.0, position=0.0, rotation=0.0)
RUNS = 300


def along(p: FloatArray, sway: float = 0.02) -> Trajectory:
    """Poses that look where they go, with a little roll and pitch."""
    count = len(p)
    ahead = np.gradient(p, axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    wave = sway * np.sin(0.3 * np.arange(count))
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, wave, -wave])).as_matrix()
    return Trajectory(np.arange(count) * 100_000_000, R, p, "map", "lidar")


def straight(length: float, poses: int = 100) -> Trajectory:
    x = np.linspace(0, length, poses + 1)
    return along(np.column_stack([x, np.full_like(x, 2.0), np.full_like(x, 0.8)]))


def loop(radius: float = 15.0, poses: int = 120) -> Trajectory:
    """One round and a third of a circle."""
    angle = np.linspace(0, 2.7 * np.pi, poses)
    p = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    return along(p)


def error(true: Trajectory, found: Trajectory, row: int) -> FloatArray:
    """The right perturbation that makes a pose the true one, rotation before position."""
    back = found.R[row].T
    turn = Rotation.from_matrix(back @ true.R[row]).as_rotvec()
    return np.concatenate([turn, back @ (true.p[row] - found.p[row])])


def nees(true: Trajectory, rows: tuple[int, ...], options: OdometryDriftOptions) -> FloatArray:
    """Normalised squared errors, runs by rows."""
    found = []
    for seed in range(RUNS):
        odometry = drifting(true, options, NoiseOptions(), np.random.default_rng(seed))
        assert odometry.covariance is not None
        errors = [(error(true, odometry, row), odometry.covariance[row]) for row in rows]
        found.append([e @ np.linalg.solve(P, e) for e, P in errors])
    return np.array(found)


def test_a_scale_error_alone_is_one_percent_of_the_way() -> None:
    true = straight(80.0)
    options = OdometryDriftOptions(yaw_walk=0, position_walk=0)
    ends = []
    for seed in range(20):
        odometry = drifting(true, options, SILENT, np.random.default_rng(seed))
        ends.append(odometry.p[-1, 0])
        # The start is off by a micrometre and a microradian, the least error there is.
        np.testing.assert_allclose(odometry.p[-1, 1:], true.p[-1, 1:], rtol=0, atol=1e-3)
    short, long = np.unique(np.round(ends, 3))
    assert (short, long) == (79.2, 80.8)


def test_a_scale_is_drawn_anew_after_its_length() -> None:
    true = straight(1000.0, poses=500)
    options = OdometryDriftOptions(yaw_walk=0, position_walk=0, scale_length=50.0)
    odometry = drifting(true, options, SILENT, np.random.default_rng(1))
    share = np.diff(odometry.p[:, 0]) / np.diff(true.p[:, 0]) - 1
    pieces = share.reshape(20, 25)
    # The start's pitch of a microradian, squared, and rounding of a kilometre.
    np.testing.assert_allclose(np.abs(pieces), 0.01, rtol=0, atol=1e-9)
    assert np.ptp(pieces, axis=1).max() < 1e-9
    assert 0 < (pieces[:, 0] > 0).sum() < 20


def test_without_any_drift_poses_are_true_up_to_the_start() -> None:
    true = loop()
    options = OdometryDriftOptions(scale=0, yaw_walk=0, position_walk=0)
    odometry = drifting(true, options, SILENT, np.random.default_rng(3))
    # A start off by a microradian, 30 m further on; five standard deviations.
    np.testing.assert_allclose(odometry.p, true.p, rtol=0, atol=5 * 30e-6)
    np.testing.assert_allclose(odometry.R, true.R, rtol=0, atol=1e-5)


@pytest.mark.parametrize("length", [100.0, 300.0])
def test_on_a_straight_way_of_whole_pieces_covariances_are_those_of_the_errors(
    length: float,
) -> None:
    found = nees(straight(length), (1, 100), OdometryDriftOptions())
    # Means of chi-square of 6, whose variance is 12: five standard deviations. After one step the
    # scale counts as redrawn, which it is not: less than 6 by up to one.
    within = 5 * np.sqrt(12 / RUNS)
    assert found[:, 1].mean() == pytest.approx(6.0, abs=within)
    assert 5 - within < found[:, 0].mean() < 6 + within


def test_on_a_bent_way_covariances_are_no_less_than_the_errors() -> None:
    """Errors of a scale cancel on the way back, what is stated does not; all else is exact."""
    found = nees(loop(), (40, 80, 119), OdometryDriftOptions())
    within = 5 * np.sqrt(12 / RUNS)
    mean = found.mean(axis=0)
    assert np.all(mean < 6 + within)
    assert np.all(mean > 4.5 - within)
    exact = nees(loop(), (119,), OdometryDriftOptions(scale=0.0))
    assert exact.mean() == pytest.approx(6.0, abs=within)


def test_covariances_accumulate_step_by_step() -> None:
    """P' = Ad P Ad^T + Q, against the sums at the first pose."""
    true = loop()
    odometry = drifting(true, OdometryDriftOptions(), NoiseOptions(), np.random.default_rng(2))
    assert odometry.covariance is not None
    drift = DriftOptions(least_m=1e-12, least_deg=1e-12)
    steps = odometry_steps(odometry, np.arange(len(true)), drift)
    P = odometry.covariance[0]
    for R, p, Q in zip(steps.R, steps.p, steps.covariance, strict=True):
        P = moved(P[None], RigidTransform(R, p))[0] + Q
    # Steps' own covariances are differences of poses', whose negative rounding is cut off.
    np.testing.assert_allclose(odometry.covariance[-1], P, rtol=0, atol=1e-9)


@pytest.mark.parametrize("true", [straight(60.0), loop()], ids=["straight", "loop"])
def test_localisation_takes_the_stated_covariances_of_steps(true: Trajectory) -> None:
    """They accumulate as that of odometry does, so that each step's own is found again."""
    options = OdometryDriftOptions()
    odometry = drifting(true, options, NoiseOptions(), np.random.default_rng(2))
    rows = np.arange(0, len(true), 4)
    drift = DriftOptions(least_m=1e-9, least_deg=1e-9)
    steps = odometry_steps(odometry, rows, drift)
    assert steps.stated
    way = np.linalg.norm(steps.p, axis=1)
    along_way = np.einsum("ni,nij,nj->n", steps.p, steps.covariance[:, 3:, 3:], steps.p) / way**2
    expected = way * (options.position_walk**2 + options.scale**2 * options.scale_length)
    # A chord of a bent way is up to 4 % shorter than it, and not along all of it.
    np.testing.assert_allclose(along_way, expected, rtol=0.1)
    turn = np.trace(steps.covariance[:, :3, :3], axis1=1, axis2=2)
    np.testing.assert_allclose(turn, way * np.deg2rad(options.yaw_walk) ** 2, rtol=0.05)


def test_an_origin_at_the_start_changes_the_frame_alone() -> None:
    true = loop()
    at_map, at_start = (
        drifting(
            true, OdometryDriftOptions(origin=origin), NoiseOptions(), np.random.default_rng(4)
        )
        for origin in OdometryOrigin
    )
    np.testing.assert_allclose(at_start.R[0], np.eye(3), rtol=0, atol=1e-15)
    np.testing.assert_allclose(at_start.p[0], 0.0, rtol=0, atol=0)
    # Rounding of positions of 30 m.
    back = (at_map.p - at_map.p[0]) @ at_map.R[0]
    np.testing.assert_allclose(at_start.p, back, rtol=0, atol=1e-12)
    assert at_map.covariance is not None
    assert at_start.covariance is not None
    np.testing.assert_allclose(at_start.covariance, at_map.covariance, rtol=0, atol=1e-12)


def test_a_seed_gives_the_same_drift_and_another_another() -> None:
    true = loop()
    one, again, other = (
        drifting(true, OdometryDriftOptions(), NoiseOptions(), np.random.default_rng(seed))
        for seed in (5, 5, 6)
    )
    assert one.p.tobytes() == again.p.tobytes()
    assert one.R.tobytes() == again.R.tobytes()
    assert np.abs(one.p - other.p).max() > 0.01
    assert (one.frame, one.child_frame) == ("odom", "lidar")


def test_what_odometry_states_may_be_left() -> None:
    """Then steps are as sure as the options say, as if nothing were stated."""
    odometry = drifting(loop(), OdometryDriftOptions(), NoiseOptions(), np.random.default_rng(2))
    rows = np.arange(0, len(odometry), 4)
    left = odometry_steps(odometry, rows, DriftOptions(stated=Usage.IGNORED))
    silent = odometry_steps(replace(odometry, covariance=None), rows, DriftOptions())
    assert not left.stated
    np.testing.assert_array_equal(left.covariance, silent.covariance)
