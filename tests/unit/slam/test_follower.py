"""A drive followed on line, beside the graph of it that is solved at once."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_factors import D, T, X
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FieldSample, FloatArray, Trajectory
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.links import MAP, Links
from l2m_gtsam.slam.online.belief import Belief
from l2m_gtsam.slam.online.follower import Follower
from l2m_gtsam.slam.online.key_pose import key_poses_of
from l2m_gtsam.slam.online.measurements import CELL_M, CachedVariance
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import calibration_values, odometry_graph, pose_values
from l2m_gtsam.slam.smoother import SmoothingProblem
from l2m_gtsam.solve.robust import RobustOptions
from tests.drives.drawn import DrawnDrive, drawn_drive
from tests.drives.following import followed_beliefs
from tests.drives.slam import rounds
from tests.worlds.exact import DipoleWorld, dipole_world, random_sensors

NEAR = np.concatenate([np.full(3, 0.01), np.full(9, 0.01), np.full(3, 1.0)])
FAR = np.concatenate([np.full(3, 0.1), np.full(9, 0.1), np.full(3, 20.0)])
NOISE = 0.2  # uT
WORLD = dipole_world(3)


class CountingMap:
    """A map that counts the places it is asked for."""

    def __init__(self, world: DipoleWorld) -> None:
        self._world, self.asked = world, 0

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        self.asked += len(points)
        return self._world.field_and_gradient(points)

    def query(self, points: FloatArray, /) -> FieldSample:
        self.asked += len(points)
        return self._world.query(points)


class HalfMap:
    """A map of the half of the hall where x is positive, whose variance is x squared."""

    def __init__(self) -> None:
        self.asked = 0

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        return WORLD.field_and_gradient(points)

    def query(self, points: FloatArray, /) -> FieldSample:
        self.asked += len(points)
        told, inside = WORLD.query(points), points[:, 0] > 0
        variance = np.where(inside, points[:, 0] ** 2, np.inf)
        return replace(told, variance=np.tile(variance[:, None], 3), inside=inside)


def thinned(seconds: float) -> Trajectory:
    truth = rounds(seconds)
    return truth[np.arange(0, len(truth), 2)]


def drawn(seconds: float) -> DrawnDrive:
    rng = np.random.default_rng(4)
    return drawn_drive(WORLD, random_sensors(3, 2), thinned(seconds), rng, NEAR, NOISE, every=2)


def followed(drive: Drive, world: QueryableMap = WORLD, section: int = 200) -> list[Belief]:
    return followed_beliefs(drive, world, RobustOptions(), free=True, section=section)


def apart(one: Belief, other: Belief) -> float:
    """Return the largest difference of two beliefs in sigmas of the second."""
    pose = gtsam.Pose3.Logmap(other.pose.between(one.pose))
    sensors = [each.sensors.vectors() for each in (one, other)]
    off = np.concatenate([pose, (sensors[0] - sensors[1]).ravel()])
    return float(np.abs(off / np.sqrt(np.diag(other.covariance))).max())


def solved_at_once(drive: Drive) -> Belief:
    """Return what the whole graph says of the last key pose and the sensors."""
    problem = SmoothingProblem(drive, WORLD, SlamOptions(calibration=CalibrationUse.REFINED))
    values, all_of_them = calibration_values(drive.sensors), np.ones(len(drive.readings))
    values.insert(pose_values(drive.dead_reckoning()))
    for _ in range(2):  # readings hang on their ways as these came out the first time
        seen = problem.predict(values)
        graph = problem.graph(seen, all_of_them, seen.prediction.map_variance, None)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    last = len(drive) - 1
    order = [key for i in range(len(drive.sensors.names)) for key in (T(i), D(i))]
    keys = [X(last), *order]
    joint = gtsam.Marginals(graph, values).jointMarginalCovariance(keys)
    covariance = np.block([[joint.at(a, b) for b in keys] for a in keys])
    sensors = replace(
        drive.sensors,
        t=np.stack([values.atPoint3(key) for key in order[::2]]),
        distortion=np.stack([values.atVector(key) for key in order[1::2]]),
    )
    return Belief(values.atPose3(X(last)), sensors, covariance)


@pytest.mark.parametrize("seconds", [3.0, 8.0])
def test_a_drive_on_line_ends_where_its_graph_does(seconds: float) -> None:
    """Over four sections, or not quite two: what they handed over is all that is left of a drive.

    It stays linearised where a section of ten key poses, a twentieth of the usual, had it at its
    end: by that it may be off by a quarter of a sigma, and sigmas by three per cent.
    """
    drive = drawn(seconds).drive
    whole, last = solved_at_once(drive), followed(drive, section=10)[-1]
    assert apart(last, whole) < 0.25
    sigmas = [np.sqrt(np.diag(each.covariance)) for each in (last, whole)]
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=0.03)


def test_the_filter_agrees_with_isam2_between_groups() -> None:
    """Key pose 14 is known from the filter in one drive, and ends another that iSAM2 settles."""
    drive = drawn(8.0).drive
    short = drive.until(15)
    # Five linearisations of the filter, not repeated, beside converged ones.
    assert apart(followed(drive)[14], followed(short)[14]) < 0.2


def test_a_field_that_bends_does_not_lead_astray() -> None:
    """A sensor 0.6 m beside a dipole at the start, and 10 cm from where it is taken to be.

    Whole steps of the filter led it 0.65 m away, and never back.
    """
    rng, world, sensors = np.random.default_rng(35), dipole_world(35), random_sensors(35, 3)
    given = drawn_drive(world, sensors, thinned(4.0), rng, FAR, NOISE, every=3)
    near = np.linalg.norm(
        given.p[0] + given.R[0] @ given.calibration[0, :3] - world.positions, axis=1
    )
    assert near.min() < 0.7
    for each in followed(given.drive, world):
        found = each.sensors.vectors() - given.calibration
        for error, covariance in zip(found, each.calibration_covariance, strict=True):
            # Chi squared of 15 degrees of freedom passes 37.7 once in 1,000.
            assert error @ np.linalg.solve(covariance, error) < 37.7


def test_what_a_key_pose_costs_does_not_grow() -> None:
    """The map is asked as often late in a drive as early, once the calibration has settled."""
    field_map, drive = CountingMap(WORLD), drawn(40.0).drive
    options = SlamOptions(calibration=CalibrationUse.REFINED)
    follower = Follower(drive.start, drive.sensors, field_map, options, section=20)
    asked = []
    for key_pose in key_poses_of(drive):
        follower.add(key_pose)
        asked.append(field_map.asked)
    fifths = np.array_split(np.diff([0, *asked]), 5)
    assert fifths[-1].mean() < 1.1 * fifths[1].mean()
    assert follower.values().size() == len(drive) + 4


def test_scans_take_part_and_wrong_ones_do_not() -> None:
    """A fix of 1 cm on every key pose from the 20th on; one of them is 2 m off."""
    given = drawn(8.0)
    drive, numbers = given.drive, np.arange(20, len(given.drive))
    p = given.p[numbers].copy()
    p[5] += np.array([2.0, 0.0, 0.0])
    covariance = np.tile(np.diag(np.repeat([np.deg2rad(0.2) ** 2, 0.01**2], 3)), (len(p), 1, 1))
    links = Links(np.full(len(p), MAP), numbers, given.R[numbers], p, covariance)
    fixed, plain = followed(replace(drive, links=links)), followed(drive)
    errors = [
        np.linalg.norm(each.pose.translation() - given.p[k])
        for k, each in enumerate(fixed)
        if k >= 20
    ]
    assert max(errors) < 0.05
    sigma, before = (np.sqrt(np.diag(each[-1].pose_covariance)[3:]) for each in (fixed, plain))
    assert np.all(sigma < before)


def test_a_belief_is_carried_as_gtsam_carries_it() -> None:
    given = drawn(3.0)
    start, drive = given.drive.start, given.drive
    step, covariance = drive.step(0), drive.steps.covariance[0]
    pose = gtsam.Pose3(gtsam.Rot3(start.T_map_lidar.R), start.T_map_lidar.t)
    behind = Belief(pose, drive.sensors, start.covariance)
    ahead = behind.predicted(step, covariance).marginalize_previous()
    graph, values = odometry_graph(drive), pose_values(drive.dead_reckoning())
    expected = gtsam.Marginals(graph, values).marginalCovariance(X(1))
    np.testing.assert_allclose(ahead.covariance, expected, rtol=1e-6, atol=1e-12)


def test_variance_is_remembered_by_place() -> None:
    field_map = HalfMap()
    known = CachedVariance(field_map)
    points = np.array([[1.0, 0.0, 0.5], [1.02, 0.02, 0.52], [2.0, 1.0, 0.5], [-1.0, 0.0, 0.5]])
    told = known.at(points)
    assert field_map.asked == 3
    # Half a cell away the sigma differs by half a cell in this map.
    np.testing.assert_allclose(np.sqrt(told[:3, 0]), points[:3, 0], atol=0.51 * CELL_M)
    assert np.isinf(told[3]).all()
    np.testing.assert_array_equal(known.at(points), told)
    assert field_map.asked == 3


@given(counts=st.lists(st.integers(1, 4), min_size=1, max_size=12), noise=st.floats(0.01, 10.0))
@settings(deadline=None, max_examples=50)
def test_readings_of_a_visit_say_what_their_mean_does(counts: list[int], noise: float) -> None:
    """The map's error is one in a cell: of k readings u + s^2 / k is left."""
    known, at = CachedVariance(HalfMap()), np.array([[1.0, 0.0, 0.5]])
    u, said = known.at(at)[0], np.zeros(3)
    for key_pose, count in enumerate(counts):
        near = at + 0.01 * np.random.default_rng(key_pose).random((count, 3))
        own = np.full(count, noise)
        said += np.sum(1 / (noise**2 + known.one_by_one(near, own, key_pose)), axis=0)
    np.testing.assert_allclose(1 / said, u + noise**2 / sum(counts), rtol=1e-9)


def test_elsewhere_and_later_the_error_of_the_map_is_another() -> None:
    known, at = CachedVariance(HalfMap()), np.array([[1.0, 0.0, 0.5], [2.0, 1.0, 0.5]])
    first = known.one_by_one(at, np.full(2, NOISE), 3)
    np.testing.assert_allclose(first, known.at(at))
    assert (known.one_by_one(at, np.full(2, NOISE), 4) > first).all()
    np.testing.assert_allclose(known.one_by_one(at, np.full(2, NOISE), 4 + 21), first)


def test_the_heading_of_the_start_is_found() -> None:
    """Five degrees and 0.2 m more off at the first pose, which the start's sigmas allow.

    What the prior still pulls by goes with its share in all that is known of the heading then.
    """
    whole = drawn(8.0)
    start = whole.drive.start
    R = Rotation.from_euler("z", 5, degrees=True).as_matrix() @ start.T_map_lidar.R
    off = replace(start, T_map_lidar=replace(start.T_map_lidar, R=R))
    last, plain = (followed(each)[-1] for each in (replace(whole.drive, start=off), whole.drive))
    share = last.pose_covariance[2, 2] / start.covariance[2, 2]
    assert share < 0.25
    heading = gtsam.Rot3.Logmap(plain.pose.rotation().between(last.pose.rotation()))[2]
    assert abs(heading) < 1.2 * share * np.deg2rad(5.0)
