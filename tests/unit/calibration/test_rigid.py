"""Sensors that are looked for together, and where they can be."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.calibration.priors import Coordinate, Difference, Priors
from l2m_gtsam.calibration.start.global_start import StartOptions, find_starts
from l2m_gtsam.calibration.start.rigid_groups import (
    Bounds,
    Rigid,
    bounded,
    moved,
    placed,
    pooled,
    rigid_groups,
)
from l2m_gtsam.data import FloatArray, Readings
from tests.drives.start_search import NEAR, OPTIONS, PERIOD, SENSORS, WORLD, corridor, together

ALONG = st.tuples(*[st.integers(-4, 4)] * 3)


def baseline(first: int, second: int, vector: FloatArray) -> Difference:
    return Difference((first, second), vector, np.full(3, 0.002), "baseline")


@given(ALONG, st.integers(0, 9))
def test_values_move_node_by_node(by: tuple[int, int, int], seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=(3, 4, 2))
    expected = np.full(values.shape, np.inf)
    for node in np.ndindex(values.shape):
        there = np.add(node, by)
        if (there >= 0).all() and (there < values.shape).all():
            expected[node] = values[tuple(there)]
    np.testing.assert_array_equal(moved(values, np.array(by)), expected)


def test_a_group_leaves_the_geometric_mean_at_its_places() -> None:
    """Two sensors a step apart along x, and one that stays as it is."""
    left = np.random.default_rng(0).uniform(1, 9, (4, 3, 3, 3))
    groups = [Rigid((0, 2), np.array([[0.0, 0.0, 0.0], [0.27, 0.0, 0.0]]))]
    found = pooled(left, groups, 0.25)
    np.testing.assert_allclose(found[:-1, ..., 0], np.sqrt(left[:-1, ..., 0] * left[1:, ..., 2]))
    np.testing.assert_array_equal(found[1:, ..., 2], found[:-1, ..., 0])
    assert np.isinf(found[-1, ..., 0]).all()
    assert np.isinf(found[0, ..., 2]).all()
    np.testing.assert_array_equal(found[..., 1], left[..., 1])


def test_a_sensor_that_is_nowhere_has_no_say() -> None:
    left = np.random.default_rng(0).uniform(1, 9, (4, 3, 3, 2))
    left[..., 1] = np.inf
    found = pooled(left, [Rigid((0, 1), np.zeros((2, 3)))], 0.25)
    np.testing.assert_allclose(found[..., 0], left[..., 0])
    np.testing.assert_allclose(found[..., 1], left[..., 0])


def test_bounds_leave_a_step_beyond_three_sigmas() -> None:
    along = np.asarray(0.25 * np.arange(-4, 5), dtype=np.float64)
    bounds = Bounds.of(Priors((Coordinate((1,), 2, 0.1, 0.05),)), 2)
    found = bounded(np.ones((9, 9, 9, 2)), [along] * 3, bounds)
    assert np.isfinite(found[..., 0]).all()
    inside = (along >= 0.1 - 0.15 - 0.25) & (along <= 0.1 + 0.15 + 0.25)
    expected = np.broadcast_to(np.where(inside, 1.0, np.inf), (9, 9, 9))
    np.testing.assert_array_equal(found[..., 1], expected)


def test_groups_are_what_vectors_connect() -> None:
    rng = np.random.default_rng(1)
    t = rng.normal(size=(6, 3))
    links = [baseline(a, b, t[b] - t[a]) for a, b in ((0, 2), (4, 2), (1, 5))]
    level = Difference((0, 1), np.zeros(3), np.array([np.inf, np.inf, 0.002]), "planar mount")
    groups = rigid_groups(Priors((*links, level)), range(6))
    assert [set(each.sensors) for each in groups] == [{0, 2, 4}, {1, 5}]
    for each in groups:
        expected = t[list(each.sensors)] - t[each.sensors[0]]
        np.testing.assert_allclose(each.offset, expected, atol=1e-12)
    # Without the sensor in the middle the others are not connected.
    assert [set(each.sensors) for each in rigid_groups(Priors(tuple(links)), (0, 1, 4, 5))] == [
        {1, 5}
    ]


def test_a_plan_puts_sensors_where_they_are_known_to_be() -> None:
    """The first is given, the second hangs on it; the third is measured, the fourth hangs on it."""
    step, height = np.array([0.1, 0.0, 0.0]), Coordinate((2,), 2, 0.4, 0.01)
    known = Priors((height, baseline(0, 1, step), baseline(3, 2, step)))
    start = np.zeros((5, 3))
    start[0] = [1.0, 2.0, 3.0]
    expected = np.array([[1, 2, 3], [1.1, 2, 3], [0, 0, 0.4], [-0.1, 0, 0.4], [0, 0, 0]])
    np.testing.assert_allclose(placed(start, [0], known), expected, atol=1e-12)


def test_an_array_finds_a_sensor_that_hears_next_to_nothing() -> None:
    """Under 60 uT of noise no place stands out; its neighbours know where it is."""
    readings, rng = together(), np.random.default_rng(2)
    loud = readings.sensor == 0
    readings = replace(
        readings, field=readings.field + loud[:, None] * rng.normal(0, 60, readings.field.shape)
    )
    t = np.array([each.t_lidar_mag for each in SENSORS])
    known = Priors(tuple(baseline(0, other, t[other] - t[0]) for other in (1, 2)))
    alone = find_starts(readings, WORLD, np.zeros(3), OPTIONS)[0]
    assert alone is None or np.linalg.norm(alone.t_lidar_mag - t[0]) > 0.5
    for start, truth in zip(
        find_starts(readings, WORLD, np.zeros(3), OPTIONS, known), t, strict=True
    ):
        assert start is not None
        assert np.linalg.norm(start.t_lidar_mag - truth) < NEAR


def repeated() -> tuple[Readings, FloatArray]:
    """Return two sensors in a field that repeats itself, driven without turning, and where."""
    n, t, world = 300, np.array([[0.3, 0.0, 0.1], [-0.1, 0.2, 0.0]]), corridor()
    rng = np.random.default_rng(0)
    p = np.column_stack([np.linspace(0, 12, n), rng.normal(0, 0.1, n), rng.normal(0.3, 0.1, n)])
    z = [world.field_and_gradient(p + each)[0] + rng.normal(0, 0.1, p.shape) for each in t]
    R, sensor = np.tile(np.eye(3), (2 * n, 1, 1)), np.repeat(np.arange(2), n)
    stamps = 50_000_000 * np.tile(np.arange(n), 2)
    return Readings(("a", "b"), sensor, stamps, R, np.tile(p, (2, 1)), np.concatenate(z)), t


def test_what_was_measured_of_one_sensor_tells_the_period_of_all() -> None:
    """Alone either could be a period off; 0.2 m along the corridor settle it for both."""
    readings, t = repeated()
    near = StartOptions(poses=40, search_radius=2.5)
    link = baseline(0, 1, t[1] - t[0])
    x = Coordinate((0,), 0, t[0, 0] + 0.2, 0.2)
    for start in find_starts(readings, corridor(), np.zeros(3), near, Priors((link,))):
        assert start is not None
        assert start.runner_up is not None
        assert start.margin < near.clear
        away = np.abs(start.runner_up - start.t_lidar_mag)
        np.testing.assert_allclose(away, [PERIOD, 0, 0], atol=0.1)
    for start, truth in zip(
        find_starts(readings, corridor(), np.zeros(3), near, Priors((link, x))), t, strict=True
    ):
        assert start is not None
        assert np.linalg.norm(start.t_lidar_mag - truth) < NEAR
        assert not start.ambiguous(near.clear)
