"""The cost of a place with the distortion eliminated: fast against slow, slopes, common poses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.data import BoolArray, FloatArray, Readings
from l2m_gtsam.solve.profile import (
    CONCENTRATIONS,
    MOST_STEP,
    TIE,
    Linearisation,
    Snapshots,
    linearised,
    misfits,
    snapshots_of,
)
from tests.worlds.exact import DipoleWorld, dipole_world, drive, random_sensors

WORLD = dipole_world(3)
EDGE = 2.0  # metres: where the map of these tests ends


def predict(points: FloatArray) -> tuple[FloatArray, BoolArray]:
    inside = points[:, 0] < EDGE
    return np.where(inside[:, None], WORLD.field_and_gradient(points)[0], 0.0), inside


def snapshots(seed: int, count: int = 60) -> Snapshots:
    """Return what three sensors read at common poses; the last one is silent at times."""
    one = drive(seed, random_sensors(seed, 1), WORLD, count)
    rng = np.random.default_rng(seed)
    field = np.stack(
        [one.field, one.field[::-1], one.field @ rng.normal(size=(3, 3)) + 5.0], axis=1
    )
    field[rng.random(count) < 0.3, 2] = np.nan
    return Snapshots(one.R_map_lidar, one.p_map_lidar, field)


def left_by_regression(seen: Snapshots, sensor: int, t: FloatArray, good: float) -> float:
    """Return the rms that fits leave of the share of readings that each explains best.

    The tie stands as further rows of the regression.
    """
    b_map, inside = predict(seen.R_map_lidar @ t + seen.p_map_lidar)
    b = np.einsum("kji,kj->ki", seen.R_map_lidar, b_map)
    has = np.isfinite(seen.field[:, sensor]).all(axis=1)
    z = seen.field[:, sensor] - np.sort(seen.field[has, sensor], axis=0)[(has.sum() - 1) // 2]
    regressors = np.column_stack([np.ones(len(b)), b - b[inside].mean(axis=0)])
    kept, chosen = int(np.ceil(good * has.sum())), has
    for _ in range(CONCENTRATIONS if good < 1 else 1):
        used = chosen & inside
        tie = np.sqrt(TIE) * np.diag(np.linalg.norm(regressors[used], axis=0))
        A, y = np.vstack([regressors[used], tie]), np.vstack([z[used], np.zeros((4, 3))])
        X = np.linalg.lstsq(A, y, rcond=None)[0]
        left = np.sum((z - np.where(inside[:, None], regressors @ X, 0.0)) ** 2, axis=1)
        left[~has] = np.inf
        chosen = left <= np.sort(left)[kept - 1]
    return float(np.sqrt(np.sort(left)[:kept].sum() / (3 * kept)))


@given(seed=st.integers(0, 10_000), good=st.sampled_from([1.0, 0.8]))
def test_misfits_are_those_of_a_regression(seed: int, good: float) -> None:
    seen = snapshots(seed)
    t = np.random.default_rng(seed).uniform(-1, 1, (4, 3))
    ours = misfits(seen, predict, t, good)
    slow = [[left_by_regression(seen, s, place, good) for s in range(3)] for place in t]
    spread = np.sqrt(np.nanmean((seen.field - np.nanmean(seen.field, axis=0)) ** 2, axis=(0, 2)))
    # Rounding times the condition that the tie leaves to the normal equations, 2e-16 / 1e-10.
    np.testing.assert_allclose(ours.rms, slow, atol=1e-5 * spread.max())
    inside = predict(seen.places(t).reshape(-1, 3))[1].reshape(4, -1)
    np.testing.assert_allclose(ours.known[:, 0], inside.mean(axis=1))


def test_nothing_is_left_at_the_true_place() -> None:
    """The first sensor of the snapshots is real, the second reads something else."""
    seed = 5
    (sensor,) = random_sensors(seed, 1)
    ours = misfits(snapshots(seed), everywhere, sensor.t_lidar_mag[None]).rms[0]
    assert ours[0] < 1e-4 * ours[1]
    assert ours[1] > 1


def test_wrong_readings_do_not_count() -> None:
    """With a fifth of them far off the true place still leaves nothing of the others."""
    seed = 5
    (sensor,) = random_sensors(seed, 1)
    seen, places = snapshots(seed), np.stack([sensor.t_lidar_mag, sensor.t_lidar_mag + 0.5])
    field = seen.field.copy()
    field[::5, 0] += 60.0 * np.random.default_rng(seed).normal(size=(len(field[::5]), 3))
    wrong = Snapshots(seen.R_map_lidar, seen.p_map_lidar, field)
    assert misfits(wrong, everywhere, places, 0.75).rms[0, 0] < 1e-3
    assert misfits(wrong, everywhere, places).rms[0, 0] > 10
    assert misfits(wrong, everywhere, places, 0.75).rms[1, 0] > 0.5


def everywhere(points: FloatArray) -> tuple[FloatArray, BoolArray]:
    return WORLD.field_and_gradient(points)[0], np.ones(len(points), dtype=np.bool_)


@given(seed=st.integers(0, 10_000))
def test_the_slope_of_the_cost_is_exact(seed: int) -> None:
    """Kaufman's Jacobian leaves a part out that is at right angles to the residual."""
    seen = snapshots(seed)
    t = np.random.default_rng(seed).uniform(-0.5, 0.5, 3)

    def cost(t: FloatArray) -> float:
        return 0.5 * float(np.sum(at(seen, t, WORLD).residual ** 2))

    line = at(seen, t, WORLD)
    step = 1e-5
    numeric = [(cost(t + step * e) - cost(t - step * e)) / (2 * step) for e in np.eye(3)]
    scale = np.linalg.norm(line.by_t, axis=0) * np.linalg.norm(line.residual)
    # Central differences with this step hold about seven digits of the product's scale.
    np.testing.assert_allclose((line.by_t.T @ line.residual) / scale, numeric / scale, atol=1e-6)


def at(seen: Snapshots, t: FloatArray, world: DipoleWorld) -> Linearisation:
    field, gradient = world.field_and_gradient(seen.R_map_lidar @ t + seen.p_map_lidar)
    return linearised(field, gradient, seen.R_map_lidar, seen.field[:, 0])


def straight(stamps: FloatArray, sensor: int, speed: float = 0.5) -> Readings:
    """Return readings of a sensor on a straight line whose field grows evenly."""
    n = len(stamps)
    place = np.column_stack([speed * stamps, np.zeros((n, 2))])
    return Readings(
        ("a", "b"),
        np.full(n, sensor),
        np.round(stamps * 1e9).astype(np.int64),
        np.tile(np.eye(3), (n, 1, 1)),
        place,
        np.column_stack([10 * stamps, 5 - stamps, np.full(n, float(sensor))]),
    )


def both(a: Readings, b: Readings) -> Readings:
    return Readings(
        a.sensors,
        np.concatenate([a.sensor, b.sensor]),
        np.concatenate([a.stamp_ns, b.stamp_ns]),
        np.concatenate([a.R_map_lidar, b.R_map_lidar]),
        np.concatenate([a.p_map_lidar, b.p_map_lidar]),
        np.concatenate([a.field, b.field]),
    )


def test_readings_at_other_times_are_interpolated() -> None:
    a, b = straight(np.arange(0, 10, 0.1), 0), straight(np.arange(0.03, 10, 0.17), 1)
    seen = snapshots_of(both(a, b), 50)
    assert len(seen) == 50
    assert seen.shared().all()
    when = seen.p_map_lidar[:, 0] / 0.5
    for sensor in (0, 1):
        has = np.isfinite(seen.field[:, sensor, 0])
        assert has.sum() >= 48  # the first and the last pose lie outside of one of them
        expected = np.column_stack([10 * when, 5 - when, np.full(50, float(sensor))])
        np.testing.assert_allclose(seen.field[has, sensor], expected[has], atol=1e-9)


def test_across_a_gap_nothing_is_interpolated() -> None:
    a = straight(np.arange(0, 10, 0.1), 0)
    times = np.concatenate([np.arange(0, 3, 0.17), np.arange(7, 10, 0.17)])
    seen = snapshots_of(both(a, straight(times, 1)), 100)
    x = seen.p_map_lidar[:, 0]
    in_gap = (x > 1.5 + MOST_STEP) & (x < 3.5 - MOST_STEP)
    assert in_gap.any()
    assert np.isnan(seen.field[in_gap, 1]).all()
    assert np.isfinite(seen.field[in_gap, 0]).all()


def test_sensors_on_drives_of_their_own_share_no_pose() -> None:
    """Test worlds place every reading anywhere: equal stamps do not mean equal poses."""
    readings = drive(1, random_sensors(1, 3), WORLD, 80)
    shared = snapshots_of(readings, 80).shared()
    np.testing.assert_array_equal(shared, [True, False, False])


@pytest.mark.parametrize("most", [1, 7, 80, 500])
def test_there_are_as_many_poses_as_asked_for(most: int) -> None:
    readings = drive(1, random_sensors(1, 1), WORLD, 80)
    assert len(snapshots_of(readings, most)) == min(most, 80)
