import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_factors.field_map import DifferentiableMap
from l2m_gtsam.data import FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.bilinear.bilinear_map import BilinearMap
from l2m_gtsam.maps.bilinear.lattice import BilinearOptions
from l2m_gtsam.maps.build import MapOptions, build_map, map_from_state
from l2m_gtsam.maps.field_map import FieldMap
from tests.support.central_differences import slopes as numerical_slopes
from tests.worlds.exact import dipole_world

OPTIONS = BilinearOptions()
HEIGHTS = (0.2, 0.5, 0.8)


def readings(count: int = 2000, noise: float = 0.2) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(4)
    points = rng.uniform([-3, -3, 0], [3, 3, 0], (count, 3))
    points[:, 2] = rng.choice(HEIGHTS, count)
    field, _ = dipole_world(1).field_and_gradient(points)
    return points, field + rng.normal(0, noise, field.shape)


def queries(count: int = 500) -> FloatArray:
    return np.random.default_rng(5).uniform([-5, -5, -0.5], [5, 5, 1.5], (count, 3))


@pytest.fixture(scope="module")
def ours() -> BilinearMap:
    return BilinearMap.fit(*readings())


def products(points: FloatArray) -> FloatArray:
    """1, x, y, z, xy, xz, yz, xyz: what a trilinear field is made of, shape (N, 8)."""
    x, y, z = points.T
    return np.column_stack([np.ones(len(x)), x, y, z, x * y, x * z, y * z, x * y * z])


def slopes(points: FloatArray) -> FloatArray:
    """Their derivatives, shape (N, 8, 3)."""
    x, y, z = points.T
    one, nil = np.ones(len(x)), np.zeros(len(x))
    rows = [
        [nil, one, nil, nil, y, z, nil, y * z],
        [nil, nil, one, nil, x, nil, z, x * z],
        [nil, nil, nil, one, nil, x, y, x * y],
    ]
    return np.array(rows).transpose(2, 1, 0)


@settings(max_examples=20)
@given(st.lists(st.floats(-50, 50), min_size=24, max_size=24), st.sampled_from([0.1, 0.25, 0.4]))
def test_a_trilinear_field_read_at_the_nodes_is_reproduced(
    values: list[float], spacing: float
) -> None:
    coefficients = np.array(values).reshape(8, 3)
    steps = spacing * np.arange(-4, 5)
    points = np.stack(np.meshgrid(steps, steps, HEIGHTS, indexing="ij"), axis=-1).reshape(-1, 3)
    exact = BilinearMap.fit(
        points, products(points) @ coefficients, BilinearOptions(spacing=spacing)
    )
    inside = np.random.default_rng(1).uniform(points.min(axis=0), points.max(axis=0), (200, 3))
    field, gradient = exact.field_and_gradient(inside)
    # Values to 1e3 uT in float64, and their differences over a tenth of a metre.
    np.testing.assert_allclose(field, products(inside) @ coefficients, rtol=0, atol=1e-10)
    expected = np.einsum("nkj,ki->nij", slopes(inside), coefficients)
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-9)
    assert exact.spread < 1e-20


def test_a_linear_field_read_anywhere_is_reproduced() -> None:
    """The average of a cell is not taken for the value at its node."""
    points, _ = readings(noise=0)
    coefficients = np.random.default_rng(2).normal(0, 10, (8, 3))
    coefficients[4:] = 0
    exact = BilinearMap.fit(points, products(points) @ coefficients)
    # Half a metre within the readings all nodes lie within triangles.
    within = np.random.default_rng(3).uniform([-2.5, -2.5, 0.2], [2.5, 2.5, 0.8], (200, 3))
    field, _ = exact.field_and_gradient(within)
    np.testing.assert_allclose(field, products(within) @ coefficients, rtol=0, atol=1e-9)


def test_the_gradient_is_the_derivative_of_the_field(ours: BilinearMap) -> None:
    points, step = queries(), 1e-7
    # Away from the faces of the cells, where the derivative jumps.
    clear = [np.abs(axis - points[:, [j]]).min(axis=1) for j, axis in enumerate(ours.lattice.axes)]
    points = points[np.min(clear, axis=0) > 2 * step]
    _, gradient = ours.field_and_gradient(points)
    expected = numerical_slopes(lambda x: ours.field_and_gradient(x)[0], points, step)
    # Rounding of 1e-14 of 50 uT over the step; along one axis the field is exactly linear.
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-5)


def test_the_field_has_no_steps(ours: BilinearMap) -> None:
    x, y, z = ours.lattice.axes
    rng = np.random.default_rng(6)
    for j, axis in enumerate((x, y, z)):
        points = queries()
        points[:, j] = rng.choice(axis, len(points))
        up, _ = ours.field_and_gradient(points + 1e-9 * np.eye(3)[j])
        down, _ = ours.field_and_gradient(points - 1e-9 * np.eye(3)[j])
        # The steepest gradient is below 1e3 uT/m.
        np.testing.assert_allclose(up, down, rtol=0, atol=2e-6)


def test_inside_is_the_distance_to_the_nearest_average(ours: BilinearMap) -> None:
    sample = ours.query(queries())
    away = np.linalg.norm(queries()[:, None] - ours.readings.points, axis=-1).min(axis=1)
    np.testing.assert_array_equal(sample.inside, away <= OPTIONS.reach)
    assert 0 < sample.inside.sum() < len(sample.inside)
    field, gradient = ours.field_and_gradient(queries())
    np.testing.assert_array_equal(sample.field[sample.inside], field[sample.inside])
    np.testing.assert_array_equal(sample.gradient[sample.inside], gradient[sample.inside])
    assert np.isnan(sample.field[~sample.inside]).all()
    assert np.isinf(sample.variance[~sample.inside]).all()


def test_the_averages_are_those_of_a_plain_loop(ours: BilinearMap) -> None:
    points, field = readings()
    rows: dict[tuple[int, ...], list[int]] = {}
    for row, (x, y, z) in enumerate(points):
        key = (HEIGHTS.index(z), round(x / OPTIONS.spacing), round(y / OPTIONS.spacing))
        rows.setdefault(key, []).append(row)
    expected = [np.hstack([points[r], field[r]]).mean(axis=0) for _, r in sorted(rows.items())]
    found = np.hstack([ours.readings.points, ours.readings.field])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)  # rounding of sums
    assert ours.readings.weight.tolist() == [len(r) for _, r in sorted(rows.items())]


def test_the_variance_is_the_mean_square_of_the_readings_about_the_map(ours: BilinearMap) -> None:
    points, field = readings()
    predicted, _ = ours.field_and_gradient(points)
    variance = ours.variance(queries())
    np.testing.assert_allclose(variance, np.mean((field - predicted) ** 2), rtol=1e-12)
    assert variance.shape == (len(queries()), 3)


def test_the_variance_of_noise_about_a_uniform_field_is_that_of_the_noise() -> None:
    rng = np.random.default_rng(7)
    points = rng.uniform([-1, -1, 0.5], [1, 1, 0.5], (20_000, 3))
    noisy = BilinearMap.fit(points, rng.normal(0, 0.3, points.shape))
    # 60,000 values: their standard deviation is known to 0.3 %; 81 nodes fit 0.2 % of it away.
    assert np.sqrt(noisy.spread) == pytest.approx(0.3, rel=0.02)


def test_with_one_layer_the_field_is_the_same_at_all_heights() -> None:
    points, field = readings()
    low = points[:, 2] < 0.3
    flat = BilinearMap.fit(points[low], field[low])
    above = queries() * [1, 1, 0] + [0, 0, 7]
    one, gradient = flat.field_and_gradient(queries())
    # Shares that add up to one to rounding, of 50 uT.
    np.testing.assert_allclose(one, flat.field_and_gradient(above)[0], rtol=0, atol=1e-12)
    assert (gradient[:, :, 2] == 0).all()
    assert flat.summary.facts["layers"] == 1


def test_where_a_layer_has_no_data_the_nearest_layer_answers() -> None:
    points, _ = readings()
    points = points[(points[:, 2] < 0.3) | (points[:, 0] > 1)]
    # The lowest layer reads 10 uT, those above it 20 uT.
    level = np.where(points[:, 2] < 0.3, 10.0, 20.0)
    ours = BilinearMap.fit(points, np.column_stack([level, level, points[:, 0]]))
    field, _ = ours.field_and_gradient(np.array([[-2.0, 0.0, 0.5], [2.0, 0.0, 0.5]]))
    np.testing.assert_allclose(field[:, 0], [10, 20], rtol=0, atol=1e-12)


def test_a_gap_in_the_data_is_outside() -> None:
    points, field = readings()
    around = np.abs(points[:, :2]).max(axis=1) > 1.5
    sample = BilinearMap.fit(points[around], field[around]).query(
        np.array([[0.0, 0.0, 0.5], [2.0, 2.0, 0.5]])
    )
    np.testing.assert_array_equal(sample.inside, [False, True])


def test_a_drive_along_one_line_is_interpolated() -> None:
    """No triangle can be made of it."""
    x = np.linspace(0, 5, 201)
    points = np.column_stack([x, 0 * x + 0.1, 0 * x + 0.3])
    ours = BilinearMap.fit(points, np.column_stack([x, 2 * x, 0 * x + 1]))
    field, _ = ours.field_and_gradient(points)
    # The nearest average of a node is at most a spacing away, where the field differs by 0.5 uT.
    np.testing.assert_allclose(field, np.column_stack([x, 2 * x, 0 * x + 1]), rtol=0, atol=0.5)


@settings(max_examples=30)
@given(
    st.lists(
        st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3), min_size=1, max_size=20
    )
)
def test_a_trial_step_to_anywhere_is_finite(
    ours: BilinearMap, anywhere: list[tuple[float, float, float]]
) -> None:
    points = np.array(anywhere)
    for answer in (*ours.field_and_gradient(points), ours.variance(points)):
        assert np.isfinite(answer).all()
    assert ours.query(points).field.shape == points.shape


def test_far_away_the_nearest_data_answer(ours: BilinearMap) -> None:
    far = np.array([[1e6, 0.3, 0.5]])
    edge = np.array([[ours.lattice.axes[0][-1], 0.3, 0.5]])
    field, gradient = ours.field_and_gradient(far)
    np.testing.assert_array_equal(field, ours.field_and_gradient(edge)[0])
    assert (gradient[0, :, 0] == 0).all()


def test_no_points_give_no_answers(ours: BilinearMap) -> None:
    sample = ours.query(np.empty((0, 3)))
    assert sample.field.shape == (0, 3)
    assert sample.gradient.shape == (0, 3, 3)


def test_maps_satisfy_both_protocols(ours: BilinearMap) -> None:
    application: FieldMap = ours
    plugin: DifferentiableMap = ours
    assert plugin.field_and_gradient(queries(7))[1].shape == (7, 3, 3)
    assert application.kind == "bilinear"


def test_a_summary_tells_what_went_in(ours: BilinearMap) -> None:
    summary = ours.summary
    assert (summary.readings, summary.rows) == (len(readings()[0]), len(ours.readings.points))
    assert summary.facts["heights of the layers (m)"] == "0.20, 0.50, 0.80"
    assert (summary.lower >= readings()[0].min(axis=0) - 1e-12).all()  # rounding of means


def test_a_map_comes_back_from_its_state_to_the_last_bit() -> None:
    ours = build_map(*readings(), MapOptions(kind="bilinear"))
    state = ours.to_state()
    plain = json.loads(json.dumps([state.options, state.provenance]))
    back = map_from_state(MapState(state.kind, state.arrays, *plain))
    for one, other in zip(
        vars(ours.query(queries())).values(), vars(back.query(queries())).values(), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    assert back.summary.facts == ours.summary.facts


def test_a_grid_of_too_many_nodes_is_refused() -> None:
    points, field = readings()
    with pytest.raises(MapError, match=r"at most 5,000,000 are allowed; a larger spacing"):
        BilinearMap.fit(points * [100, 100, 1], field, BilinearOptions(spacing=0.01))


def test_positions_far_from_the_origin_change_nothing() -> None:
    points, field = readings()
    away = np.array([5e5, -4e5, 0])  # as in a national grid; multiples of the spacing
    near, far = BilinearMap.fit(points, field), BilinearMap.fit(points + away, field)
    one, _ = near.field_and_gradient(queries())
    other, _ = far.field_and_gradient(queries() + away)
    # Coordinates lose ten digits of sixteen, times a gradient of at most 1e3 uT/m.
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-6)
