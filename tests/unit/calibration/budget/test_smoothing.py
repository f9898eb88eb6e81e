"""Smoothed readings: the second derivative of the field on the way, against filters themselves."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.budget.looked_for import Smoothing, processes
from l2m_gtsam.calibration.budget.processes import ReadingPlaces, field_bend
from l2m_gtsam.data import FloatArray, Readings, Trajectory
from l2m_gtsam.recording.sync import with_offsets
from l2m_gtsam.records.error_budget import DisturbanceKind
from tests.support.scenes import scene

T_MAG = np.array([0.3, 0.1, 0.2])
SECONDS = np.linspace(1.0, 19.0, 61)


@dataclass(frozen=True)
class Waves:
    """A field of waves of 3 m, known within a box."""

    reach: float = np.inf

    def field_and_gradient(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        wave = 2 * np.pi / 3.0
        field = np.array([20.0, 5.0, -40.0]) + 8 * np.sin(wave * x)
        gradient = np.einsum("ni,ij->nij", 8 * wave * np.cos(wave * x), np.eye(3))
        outside = np.abs(x).max(axis=1) > self.reach
        field[outside], gradient[outside] = np.nan, np.nan
        return field, gradient


def trajectory() -> Trajectory:
    """Return poses at 100 Hz: a slalom that turns at up to 0.6 rad/s, at 0.5 m/s."""
    seconds = np.linspace(0.0, 20.0, 2001)
    R = Rotation.from_euler("z", 0.6 * np.sin(seconds)[:, None]).as_matrix()
    p = np.column_stack([0.5 * seconds, 0.4 * np.cos(0.7 * seconds), 0 * seconds])
    return Trajectory((1e9 * seconds).astype(np.int64), R, p, "map", "lidar")


def readings() -> Readings:
    count = len(SECONDS)
    stamps = (1e9 * SECONDS).astype(np.int64)
    none = np.empty((count, 3, 3)), np.empty((count, 3)), np.zeros((count, 3))
    bare = Readings(("mag",), np.zeros(count, dtype=np.int64), stamps, *none)
    return with_offsets(bare, trajectory(), np.zeros(1))


def places(field_map: Waves, own: Readings) -> ReadingPlaces:
    x = own.p_map_lidar + own.R_map_lidar @ T_MAG
    t, C = np.tile(T_MAG, (len(x), 1)), np.tile(np.eye(3), (len(x), 1, 1))
    field, gradient = field_map.field_and_gradient(x)
    b_lidar = np.einsum("nji,nj->ni", own.R_map_lidar, field)
    bend = field_bend(own, field_map, t, b_lidar)
    return ReadingPlaces(own, t, C, x, b_lidar, gradient, bend)


def b_lidar(seconds: float) -> FloatArray:
    """Return the field in the lidar frame at the readings, so many seconds later."""
    then = with_offsets(readings(), trajectory(), np.array([seconds]))
    x = then.p_map_lidar + then.R_map_lidar @ T_MAG
    return np.asarray(np.einsum("nji,nj->ni", then.R_map_lidar, Waves().field_and_gradient(x)[0]))


@pytest.mark.parametrize("mean_over_s", [0.1, 0.3])
def test_a_mean_over_a_time_is_its_variance_times_the_feature(mean_over_s: float) -> None:
    steps = np.linspace(-0.5, 0.5, 201) * mean_over_s
    mean = np.mean([b_lidar(step) for step in steps], axis=0)
    variance = float(np.mean(steps**2))
    found = variance * Smoothing(places(Waves(), readings()), 0).features(np.arange(61))[:, :, 0]
    change = mean - b_lidar(0.0)
    # Fourth derivatives: (2 pi 0.7 m/s / 3 m)^2 of the second, times 0.1 s^2 / 12.
    np.testing.assert_allclose(found, change, atol=0.02 * np.abs(change).max())


def test_a_filter_of_first_order_is_a_delay_and_a_variance() -> None:
    constant = 0.05
    past, weight = np.polynomial.laguerre.laggauss(8)
    filtered = sum(w * b_lidar(-constant * s) for s, w in zip(past, weight, strict=True))
    features = Smoothing(places(Waves(), readings()), 0).features(np.arange(61))[:, :, 0]
    left = filtered - b_lidar(-constant)
    # The third moment is left, twice the constant cubed: 0.7 m/s through 3 m make that a tenth.
    assert np.linalg.norm(left - constant**2 * features) < 0.15 * np.linalg.norm(left)


def test_the_size_is_a_time() -> None:
    smoothing = Smoothing(scene(np.linspace(0, 10, 20)), 0)
    assert smoothing.named(0, np.array([0.05**4])) == {"smoothing_s": pytest.approx(0.05)}


def test_a_map_that_ends_near_by_leaves_the_field_straight() -> None:
    features = Smoothing(places(Waves(reach=5.0), readings()), 0).features(np.arange(61))
    assert np.isfinite(features).all()
    far = readings().p_map_lidar[:, 0] > 5.0
    assert not features[far].any()


def test_smoothing_is_looked_for_where_a_sensor_lags_and_no_errors_of_poses_are_stated() -> None:
    still, moving = scene(np.linspace(0, 10, 20)), places(Waves(), readings())
    roots = np.broadcast_to(0.01 * np.eye(6), (len(SECONDS), 6, 6))
    stated = replace(moving, readings=replace(moving.readings, pose_root=roots))
    assert smoothed(still, (0,)) == []
    assert smoothed(moving, (0,)) == [0]
    assert smoothed(moving, ()) == []
    assert smoothed(stated, (0,)) == []


def smoothed(at: ReadingPlaces, lagging: tuple[int, ...]) -> list[int | None]:
    found = processes(at, (0,), lagging)
    return [each.sensor for each in found if each.kind is DisturbanceKind.SMOOTHING]


def test_other_readings_feel_the_same() -> None:
    part, every = np.arange(10, 30), places(Waves(), readings())
    few = places(Waves(), readings()[part])
    one = Smoothing(every, 0)
    np.testing.assert_allclose(one.on(few).features(np.arange(20)), one.features(part), atol=1e-9)
    assert replace(one, sensor=1).on(few).sensor == 1
