"""Drives over the default warehouse floor: where they go and how they move."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, KnownSensor, Trajectory
from l2m_gtsam.simulate.drive import VehicleMotion, drive
from l2m_gtsam.simulate.floor_plan import FloorPlan, plan_floor
from l2m_gtsam.simulate.route import calibration_route, mapping_route
from l2m_gtsam.simulate.scenario import ScenarioOptions
from l2m_gtsam.simulate.sensors import mapping_suite, random_array, sensor_points
from l2m_gtsam.simulate.warehouse import build_warehouse

OPTIONS = ScenarioOptions()
START_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def plan() -> FloorPlan:
    return plan_floor(OPTIONS.floor_plan)


@pytest.fixture(scope="module")
def mapping(plan: FloorPlan) -> VehicleMotion:
    route = mapping_route(OPTIONS.mapping_route, plan)
    return drive(OPTIONS.mapping_drive, route, START_NS, np.random.default_rng(1))


@pytest.fixture(scope="module")
def calibration(plan: FloorPlan) -> VehicleMotion:
    route = calibration_route(OPTIONS.calibration_route, plan)
    return drive(OPTIONS.calibration_drive, route, START_NS, np.random.default_rng(2))


@pytest.fixture(params=["mapping", "calibration"])
def motion(request: pytest.FixtureRequest) -> VehicleMotion:
    chosen: VehicleMotion = request.getfixturevalue(request.param)
    return chosen


def poses_at(motion: VehicleMotion, rate: float) -> Trajectory:
    seconds = np.arange(0.0, motion.duration, 1 / rate)
    return motion.at(motion.start_ns + (seconds * 1e9).astype(np.int64))


def all_points(poses: Trajectory, sensors: tuple[KnownSensor, ...]) -> FloatArray:
    return np.concatenate([sensor_points(poses, sensor) for sensor in sensors])


def array() -> tuple[KnownSensor, ...]:
    return random_array(OPTIONS.array, np.random.default_rng(3))


def test_attitude_and_heave_stay_slight(motion: VehicleMotion) -> None:
    poses = poses_at(motion, 20.0)
    _, pitch, roll = Rotation.from_matrix(poses.R).as_euler("ZYX", degrees=True).T
    # Bounded at the splines' knots; between them a cubic overshoots by far less than 1 %.
    swings: list[tuple[FloatArray, float]] = [
        (np.asarray(roll), 1.5),
        (np.asarray(pitch), 1.5),
        (poses.p[:, 2] - 0.8, 0.015),
    ]
    for swing, bound in swings:
        assert np.abs(swing).max() <= 1.01 * bound
        assert swing.std() > 0.1 * bound


@pytest.mark.parametrize(("name", "limit"), [("mapping", 1.5), ("calibration", 1.0)])
def test_vehicle_heads_where_it_drives_at_its_speed(
    name: str, limit: float, request: pytest.FixtureRequest
) -> None:
    poses = poses_at(request.getfixturevalue(name), 20.0)
    velocity = np.gradient(poses.p[:, :2], 0.05, axis=0)[1:-1]
    speed = np.linalg.norm(velocity, axis=1)
    forward = poses.R[1:-1, :2, 0]
    along = np.sum(forward * velocity, axis=1)
    # Yaw changes within 0.1 s of a turn and pitch shortens: 1 - cos(0.05) + 1 - cos(1.5 deg).
    np.testing.assert_allclose(along, speed, rtol=2e-3, atol=1e-6)
    assert 0.9 * limit < speed.max() < 1.01 * limit


@pytest.mark.parametrize(("name", "limit"), [("mapping", 1.5), ("calibration", 1.0)])
def test_turns_keep_the_yaw_rate(name: str, limit: float, request: pytest.FixtureRequest) -> None:
    poses = poses_at(request.getfixturevalue(name), 20.0)
    yaw = np.unwrap(np.arctan2(poses.R[:, 1, 0], poses.R[:, 0, 0]))
    # Splines through knots 0.05 s apart overshoot the path's own rate by less than 2 %.
    assert 0.9 * limit < np.abs(np.diff(yaw) / 0.05).max() < 1.02 * limit


def test_mapping_drive_covers_the_free_floor(plan: FloorPlan, mapping: VehicleMotion) -> None:
    suite = mapping_suite(OPTIONS.suite)
    seen = all_points(poses_at(mapping, 8.0), suite)[:, :2]
    x, y = np.meshgrid(np.arange(1.0, plan.length - 1, 0.1), np.arange(1.0, plan.width - 1, 0.1))
    # Aisles but for the clearance that the outermost lane and the suite's width leave.
    aisle = np.abs(y[..., None] - plan.aisle_y).min(axis=-1) < 1.0
    cross = np.abs(x[..., None] - plan.cross_x).min(axis=-1) < 1.6
    floor = np.column_stack([x[aisle | cross], y[aisle | cross]])
    away = np.asarray(cKDTree(seen).query(floor)[0])
    # Tracks lie 0.4 m apart and readings 0.19 m; where lanes turn the corner is cut.
    assert np.percentile(away, 99) < 0.25
    assert away.max() < 0.6


def test_calibration_drive_stays_where_the_map_was_seen(
    mapping: VehicleMotion, calibration: VehicleMotion
) -> None:
    seen = all_points(poses_at(mapping, 8.0), mapping_suite(OPTIONS.suite))
    asked = all_points(poses_at(calibration, 10.0), array())
    away = np.asarray(cKDTree(seen).query(asked)[0])
    # Half of 0.4 m across, of 0.3 m upwards and of 0.19 m along, and the vehicles' sway.
    assert away.max() < np.sqrt(0.2**2 + 0.15**2 + 0.1**2) + 0.05
    assert asked[:, 2].min() > seen[:, 2].min()
    assert asked[:, 2].max() < seen[:, 2].max()


def test_calibration_drive_turns_through_all_headings_both_ways(calibration: VehicleMotion) -> None:
    poses = poses_at(calibration, 20.0)
    yaw = np.arctan2(poses.R[:, 1, 0], poses.R[:, 0, 0])
    counts, _ = np.histogram(yaw, bins=12, range=(-np.pi, np.pi))
    # Three circles each way at some 0.8 rad/s: six times 0.65 s of 20 Hz are 78 in each twelfth.
    assert counts.min() > 60
    turned = np.diff(np.unwrap(yaw))
    # Three circles each way; the left-hand loop itself adds three quarters of a turn.
    assert turned[turned > 0].sum() == pytest.approx(7.5 * np.pi, rel=0.01)
    assert turned[turned < 0].sum() == pytest.approx(-6 * np.pi, rel=0.01)


def test_no_sensor_passes_through_steel(
    plan: FloorPlan, mapping: VehicleMotion, calibration: VehicleMotion
) -> None:
    rng = np.random.default_rng(4)
    world = build_warehouse(OPTIONS.warehouse, plan, np.zeros(3), rng)
    for motion, sensors in ((mapping, mapping_suite(OPTIONS.suite)), (calibration, array())):
        poses = poses_at(motion, 4.0)
        assert not world.inside(poses.p).any()
        assert not world.inside(all_points(poses, sensors)).any()


def test_motion_is_smooth_between_its_knots(motion: VehicleMotion) -> None:
    fine = poses_at(motion, 100.0)
    # 1.5 m/s in turns of at most 1.5 rad/s accelerate by 2.3 m/s^2, braking comes beside it.
    acceleration = np.diff(fine.p[1_000:6_000], n=2, axis=0) / 0.01**2
    assert np.abs(acceleration).max() < 3.0
