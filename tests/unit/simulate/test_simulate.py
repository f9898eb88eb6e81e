"""Scenarios: reproducible, and readings that obey the measurement model."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.simulate.floor_plan import FloorPlanOptions
from l2m_gtsam.simulate.recorder import SimulatedDrive
from l2m_gtsam.simulate.route import CalibrationRouteOptions
from l2m_gtsam.simulate.scenario import Scenario, ScenarioOptions, simulate
from l2m_gtsam.simulate.sensors import (
    MappingSuiteOptions,
    NoiseOptions,
    SamplingOptions,
    SensorArrayOptions,
    lasting,
    measured_poses,
    random_array,
    sample_stamps,
)
from l2m_gtsam.simulate.warehouse import SectionOptions, WarehouseOptions

SMALL: dict[str, Any] = {
    "floor_plan": FloorPlanOptions(length=16.0, width=9.0, rack_rows=1, blocks=1),
    "suite": MappingSuiteOptions(lateral=(-0.3, 0.3), heights=(-0.4, 0.0)),
    "array": SensorArrayOptions(count=3),
    "calibration_route": CalibrationRouteOptions(turns=1),
    "mapping_sampling": SamplingOptions(field_rate=4.0, pose_rate=5.0),
    "calibration_sampling": SamplingOptions(field_rate=10.0, pose_rate=10.0),
}


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return simulate(ScenarioOptions(seed=3, **SMALL))


def arrays(scenario: Scenario) -> Iterator[FloatArray]:
    """All numbers that the seed can change."""
    yield from (scenario.world.centres, scenario.world.polarisations, scenario.world.R_map_body)
    for drive in (scenario.mapping, scenario.calibration):
        yield from (drive.recording.trajectory.R, drive.recording.trajectory.p)
        for series in drive.recording.series:
            yield from (series.stamp_ns.astype(np.float64), series.field)
    for sensor in scenario.truth:
        yield from (sensor.t_lidar_mag, sensor.distortion.C, sensor.distortion.H)


def predicted(scenario: Scenario, drive: SimulatedDrive, index: int) -> FloatArray:
    """The model of one sensor's readings, reading by reading, from the documented equation."""
    sensors = scenario.suite if drive is scenario.mapping else scenario.truth
    series, sensor = drive.recording.series[index], sensors[index]
    poses = drive.motion.at(series.stamp_ns)
    readings = []
    for R, p in zip(poses.R, poses.p, strict=True):
        b_map = scenario.world.field((R @ sensor.t_lidar_mag + p)[None])[0]
        readings.append(sensor.distortion.C @ R.T @ b_map + sensor.distortion.H)
    return np.array(readings)


def test_same_seed_gives_the_same_bits(scenario: Scenario) -> None:
    again = simulate(ScenarioOptions(seed=3, **SMALL))
    assert again.mapping.recording.source == scenario.mapping.recording.source
    for ours, theirs in zip(arrays(scenario), arrays(again), strict=True):
        assert ours.tobytes() == theirs.tobytes()


def test_another_seed_changes_every_array(scenario: Scenario) -> None:
    other = simulate(ScenarioOptions(seed=4, **SMALL))
    assert other.calibration.recording.source != scenario.calibration.recording.source
    steel = scenario.world.polarisations != other.world.polarisations
    assert steel.all()
    for ours, theirs in zip(scenario.truth, other.truth, strict=True):
        assert (ours.t_lidar_mag != theirs.t_lidar_mag).all()
        assert (ours.distortion.C != theirs.distortion.C).all()
        assert (ours.distortion.H != theirs.distortion.H).all()


def test_another_array_leaves_world_and_mapping_drive_alone(scenario: Scenario) -> None:
    options = ScenarioOptions(seed=3, **{**SMALL, "array": SensorArrayOptions(count=2)})
    other = simulate(options)
    np.testing.assert_array_equal(other.world.polarisations, scenario.world.polarisations)
    assert other.mapping.recording.source == scenario.mapping.recording.source


@pytest.mark.parametrize("name", ["mapping", "calibration"])
def test_readings_obey_the_model_up_to_the_stated_noise(scenario: Scenario, name: str) -> None:
    drive: SimulatedDrive = getattr(scenario, name)
    noise = drive.recording.series[0].field - predicted(scenario, drive, 0)
    sigma = scenario.options.noise.field
    # The standard deviation of n samples is known to 1/sqrt(2 n): four of these.
    assert noise.std() == pytest.approx(sigma, rel=4 / np.sqrt(2 * noise.size))
    assert np.abs(noise.mean(axis=0)).max() < 4 * sigma / np.sqrt(len(noise))


def test_without_noise_readings_equal_the_model() -> None:
    silent = NoiseOptions(field=0.0, position=0.0, rotation=0.0)
    scenario = simulate(ScenarioOptions(seed=3, noise=silent, **SMALL))
    drive = scenario.calibration
    for index, series in enumerate(drive.recording.series):
        # One by one against in batches: rounding of some 50 uT.
        expected = predicted(scenario, drive, index)
        np.testing.assert_allclose(series.field, expected, rtol=0, atol=1e-11)
    true = drive.motion.at(drive.recording.trajectory.stamp_ns)
    np.testing.assert_array_equal(drive.recording.trajectory.p, true.p)


def test_pose_noise_is_as_stated(scenario: Scenario) -> None:
    noise, drive = scenario.options.noise, scenario.mapping
    measured = drive.recording.trajectory
    true = drive.motion.at(measured.stamp_ns)
    shift = measured.p - true.p
    turn = np.swapaxes(true.R, 1, 2) @ measured.R
    angles = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)
    # Four standard deviations of a standard deviation of n samples.
    within = 4 / np.sqrt(2 * shift.size)
    assert shift.std() == pytest.approx(noise.position, rel=within)
    assert np.rad2deg(angles.std()) == pytest.approx(noise.rotation, rel=within)


def still(stamp_ns: IntArray) -> Trajectory:
    """Return poses of a vehicle that stands turned by 0.5 rad at (1, 2, 3) m."""
    count = len(stamp_ns)
    R = Rotation.from_rotvec(np.tile([0.0, 0.0, 0.5], (count, 1))).as_matrix()
    return Trajectory(stamp_ns, R, np.tile([1.0, 2.0, 3.0], (count, 1)), "map", "lidar")


def test_without_correlation_a_seed_gives_the_poses_that_it_always_gave() -> None:
    noise, true = NoiseOptions(), still(np.arange(50) * 10_000_000)
    found = measured_poses(true, noise, np.random.default_rng(5))
    again = np.random.default_rng(5)
    turn = again.normal(0.0, np.deg2rad(noise.rotation), (50, 3))
    shift = again.normal(0.0, noise.position, (50, 3))
    R = true.R @ Rotation.from_rotvec(turn).as_matrix()
    assert found.R.tobytes() == R.tobytes()
    assert found.p.tobytes() == (true.p + shift).tobytes()


def test_stated_covariances_are_those_of_the_errors() -> None:
    """Errors as documented, ``T_true = T @ Exp(error)``, whitened by what is stated."""
    true = still(np.arange(4000) * 10_000_000)
    for correlation in (0.0, 0.05):
        noise = NoiseOptions(position=0.02, rotation=0.5, pose_correlation=correlation)
        found = measured_poses(true, noise, np.random.default_rng(6))
        back = found.R.swapaxes(1, 2)
        turn = Rotation.from_matrix(back @ true.R).as_rotvec()
        shift = np.einsum("nij,nj->ni", back, true.p - found.p)
        assert found.covariance is not None
        error = np.hstack([turn, shift])
        spread = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error)
        # A mean of chi-square of 6, whose variance is 12, over 4000 poses; correlated squares
        # count 1 / tanh(0.01 / 0.05) = 5.1 times. Five standard deviations.
        within = 5 * np.sqrt(12 / 4000 * (5.1 if correlation else 1.0))
        assert spread.mean() == pytest.approx(6.0, abs=within)


def test_lasting_noise_is_the_recursion_step_by_step() -> None:
    rng = np.random.default_rng(8)
    stamps = np.cumsum(rng.integers(1_000, 900_000_000, 60))
    white = rng.normal(size=(60, 3))
    slow = [white[0]]
    for k in range(1, 60):
        keep = np.exp(-(stamps[k] - stamps[k - 1]) * 1e-9 / 0.4)
        slow.append(keep * slow[-1] + np.sqrt(1 - keep**2) * white[k])
    # Rounding of values around 1; 1 - keep^2 loses six digits of sixteen in the shortest step.
    np.testing.assert_allclose(lasting(white, stamps, 0.4), slow, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(lasting(white, stamps, 0.0), white)


def test_lasting_noise_is_stationary_with_the_stated_correlation() -> None:
    """All of it is linear in the white noise: its covariance in closed form."""
    stamps = np.cumsum(np.random.default_rng(9).integers(1_000_000, 900_000_000, 40))
    response = lasting(np.eye(40), stamps, 0.3)
    apart = np.abs(stamps[:, None] - stamps) * 1e-9
    # Rounding of sums of forty products.
    np.testing.assert_allclose(response @ response.T, np.exp(-apart / 0.3), rtol=0, atol=1e-13)


def test_a_clock_that_is_behind_stamps_early(scenario: Scenario) -> None:
    sampling = SamplingOptions(field_rate=10.0, pose_rate=10.0, clock_offset=0.025)
    options = ScenarioOptions(seed=3, **{**SMALL, "calibration_sampling": sampling})
    late, plain = simulate(options).calibration, scenario.calibration
    np.testing.assert_array_equal(late.recording.trajectory.p, plain.recording.trajectory.p)
    for ours, theirs in zip(late.recording.series, plain.recording.series, strict=True):
        np.testing.assert_array_equal(ours.stamp_ns + 25_000_000, theirs.stamp_ns)
        np.testing.assert_array_equal(ours.field, theirs.field)


def test_distortion_is_positive_times_the_mounting_rotation() -> None:
    sensors = random_array(SensorArrayOptions(count=100), np.random.default_rng(1))
    for sensor in sensors:
        u, s, vt = np.linalg.svd(sensor.distortion.C)
        turn = np.arccos((np.trace(u @ vt) - 1) / 2)
        assert np.linalg.det(u @ vt) > 0
        # Five standard deviations: three axes of 3 degrees; scale 3 % with soft iron of 2 %.
        assert np.rad2deg(turn) < 5 * 3 * np.sqrt(3)
        assert np.abs(s - 1).max() < 5 * 0.05
        assert np.abs(sensor.distortion.H).max() <= 20.0
        # Rings of 0.30 and 0.45 m at most 0.40 m below the lidar, shifted by 2 cm per axis.
        assert np.linalg.norm(sensor.t_lidar_mag) < np.hypot(0.45, 0.40) + 0.02 * np.sqrt(3)
    assert len({sensor.sensor for sensor in sensors}) == 100


def test_stamps_ascend_near_their_regular_times() -> None:
    options = SamplingOptions(jitter=0.2)
    stamps = sample_stamps(options, 50.0, 20.0, np.random.default_rng(2)) / 1e9
    assert len(stamps) == 1000
    assert np.diff(stamps).min() > 0
    # Two stamps may each deviate by a fifth of the interval; 1 ns of rounding.
    assert np.abs(np.diff(stamps) * 50.0 - 1.0).max() <= 0.4 + 1e-6
    assert stamps.min() >= 0
    assert stamps.max() <= 20.0


def test_sources_keep_their_own_clocks(scenario: Scenario) -> None:
    recording = scenario.calibration.recording
    firsts = [series.stamp_ns[0] for series in recording.series]
    assert len({*firsts, recording.trajectory.stamp_ns[0]}) == len(firsts) + 1
    assert recording.trajectory.frame == "map"
    assert recording.trajectory.child_frame == "lidar"


def test_progress_runs_from_nothing_to_all() -> None:
    seen: dict[str, list[float]] = {}
    simulate(
        ScenarioOptions(seed=3, **SMALL),
        lambda stage, share: seen.setdefault(stage, []).append(share),
    )
    assert len(seen) == 2
    for shares in seen.values():
        assert shares == sorted(shares)
        assert (shares[0], shares[-1]) == (0.0, 1.0)


def test_a_sensor_that_would_hit_steel_is_refused() -> None:
    # Lanes lie 1.05 m from the rack's face, uprights of 0.6 m just behind it.
    wide = {**SMALL, "suite": MappingSuiteOptions(lateral=(0.0, 1.3), heights=(0.0,))}
    thick = WarehouseOptions(upright=SectionOptions(breadth=0.6, height=0.6, fill=0.1))
    with pytest.raises(ConfigError, match="suite_01 would pass through steel"):
        simulate(ScenarioOptions(warehouse=thick, **wide))


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"rack_rows": 12}, "rack_rows: 12 rows of 2.4 m leave aisles of 0.48 m"),
        ({"blocks": 11}, "blocks: 12 cross aisles of 4.2 m leave no room"),
    ],
)
def test_a_hall_without_room_is_refused(options: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        FloorPlanOptions(**options)
