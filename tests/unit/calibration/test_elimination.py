"""Sensors and map weights together: LAPACK and the block elimination against dense algebra."""

from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
import pytest

from l2m_factors import D, M, S, T
from l2m_gtsam.calibration import joint_information as joint_rows
from l2m_gtsam.calibration.joint_information import (
    JointInformation,
    joint_information,
    rows_of_factors,
)
from l2m_gtsam.calibration.sensor_columns import columns_of, keys_of
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.errors import CalibrationError
from tests.reference.elimination import Eliminated, Rows, eliminate

JACOBIAN: Any = gtsam.JacobianFactor  # its stub lists one to three variables, each by itself

SENSORS, SIZES = [0, 2], {M(4): 3, M(7): 5}
ROWS = 40
ORDER = [T(0), D(0), S(0), T(2), D(2), S(2), M(4), M(7)]
WIDTH = {T(0): 3, D(0): 12, S(0): 1, T(2): 3, D(2): 12, S(2): 1, M(4): 3, M(7): 5}
START = dict(zip(ORDER, np.cumsum([0, *WIDTH.values()]), strict=False))


def dense(terms: dict[int, FloatArray]) -> FloatArray:
    """Return a factor's rows over all 40 numbers."""
    rows = np.zeros((len(next(iter(terms.values()))), sum(WIDTH.values())))
    for key, A in terms.items():
        rows[:, START[key] : START[key] + WIDTH[key]] = A
    return rows


class Problem:
    """Random readings of two sensors in two tiles, and a prior of unit variance on the weights.

    With a baseline there are rows on both positions, too.
    """

    def __init__(self, baseline: bool) -> None:
        rng = np.random.default_rng(0)
        self.graph = gtsam.GaussianFactorGraph()
        self.owner: list[IntArray] = []
        blocks: list[FloatArray] = []
        values: list[FloatArray] = []
        for sensor in SENSORS:
            for tile in SIZES:
                terms = {
                    key: rng.normal(size=(ROWS, WIDTH[key])) for key in (T(sensor), D(sensor), tile)
                }
                self._add(terms, rng.normal(size=ROWS), blocks, values, sensor)
            late = {key: rng.normal(size=(ROWS, WIDTH[key])) for key in (T(sensor), S(sensor))}
            self._add(late, rng.normal(size=ROWS), blocks, values, sensor)
        for tile, size in SIZES.items():
            self._add({tile: np.eye(size)}, np.zeros(size), blocks, values, -1)
        if baseline:
            terms = {T(0): -30 * np.eye(3), T(2): 30 * np.eye(3)}
            self._add(terms, rng.normal(size=3), blocks, values, -1)
        self.A, self.b = np.concatenate(blocks), np.concatenate(values)
        self.row_owner = np.concatenate(self.owner)

    def _add(
        self,
        terms: dict[int, FloatArray],
        b: FloatArray,
        blocks: list[FloatArray],
        values: list[FloatArray],
        sensor: int,
    ) -> None:
        unit = gtsam.noiseModel.Unit.Create(len(b))
        self.graph.push_back(JACOBIAN(*(x for term in terms.items() for x in term), b, unit))
        blocks.append(dense(terms))
        values.append(b)
        self.owner.append(np.full(len(b), sensor))


@pytest.fixture(scope="module", params=[False, True], ids=["apart", "with a baseline"])
def problem(request: pytest.FixtureRequest) -> Problem:
    return Problem(request.param)


@pytest.fixture(scope="module")
def solved(problem: Problem) -> Eliminated:
    return eliminate(problem.graph, SENSORS, SIZES)


@pytest.fixture(scope="module")
def joint(problem: Problem) -> JointInformation:
    """The prior of the weights apart, all else as rows; weights are where they are."""
    widths = np.cumsum([0, *SIZES.values()]).tolist()
    weights = {key: slice(*at) for key, at in zip(SIZES, pairwise(widths), strict=True)}
    first, own = widths[-1], columns_of(tuple(SENSORS))
    columns = weights | {k: slice(first + at.start, first + at.stop) for k, at in own.items()}
    owner = {key: sensor for sensor in SENSORS for key in keys_of(sensor)}
    rows = rows_of_factors(problem.graph, columns, owner)
    readings = [each for each in rows if set(each.columns.tolist()) - set(range(first))]
    return joint_information(columns, readings, np.eye(first), np.zeros(first))


@pytest.mark.parametrize("sensor", SENSORS)
def test_all_variables_together_give_what_elimination_does(
    joint: JointInformation, solved: Eliminated, sensor: int
) -> None:
    """Covariance, remaining step and degrees of freedom; random rows are well conditioned."""
    covariance = solved.covariance(sensor)
    np.testing.assert_allclose(joint.among((sensor,)), covariance, atol=1e-12)
    assert joint.sigmas(sensor) == pytest.approx(solved.sigmas(sensor), rel=1e-10)
    assert joint.taken(sensor) == pytest.approx(solved.taken(sensor), rel=1e-10)
    assert joint.among(tuple(SENSORS))[:16, :16] == pytest.approx(joint.among((SENSORS[0],)))


NONE = joint_rows.NO_READINGS


def test_what_cholesky_cannot_factor_qr_does() -> None:
    """Rows known to 1e-9 and to 1: squared, nothing is left of the second; exact by hand."""
    rows = [
        joint_rows.Rows(
            0, np.array([1, 2]), np.array([[1e9, 1e9], [0.0, 1.0]]), np.array([0, 2]), NONE
        ),
        joint_rows.Rows(0, np.array([1]), np.array([[1e-3]]), np.zeros(1), NONE),
    ]
    columns = {M(0): slice(0, 1), T(0): slice(1, 2), S(0): slice(2, 3)}
    joint = joint_information(columns, rows, np.eye(1), np.zeros(1))
    covariance = joint.covariance([T(0), S(0)])
    np.testing.assert_allclose(covariance, [[1.0, -1.0], [-1.0, 1.0]], rtol=1e-5)


def test_a_singular_system_is_one_clear_error() -> None:
    """Two columns that are the same, known to no end."""
    rows = [joint_rows.Rows(0, np.array([1, 2]), np.array([[1e9, 1e9]]), np.zeros(1), NONE)]
    columns = {M(0): slice(0, 1), T(0): slice(1, 2), S(0): slice(2, 3)}
    with pytest.raises(CalibrationError, match="orders of magnitude apart"):
        joint_information(columns, rows, np.eye(1), np.zeros(1))


@pytest.mark.parametrize("sensor", SENSORS)
def test_steps_and_covariances_are_those_of_dense_algebra(
    problem: Problem, solved: Eliminated, sensor: int
) -> None:
    """Random rows are well conditioned: to 1e-10."""
    covariance = np.linalg.inv(problem.A.T @ problem.A)
    step = covariance @ problem.A.T @ problem.b
    own = slice(START[T(sensor)], START[T(sensor)] + 16)
    np.testing.assert_allclose(solved.step(sensor), step[own], atol=1e-10)
    np.testing.assert_allclose(solved.covariance(sensor), covariance[own, own], atol=1e-10)
    length = np.sqrt(step[own] @ np.linalg.solve(covariance[own, own], step[own]))
    assert solved.sigmas(sensor) == pytest.approx(length, rel=1e-9)


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_fit_takes_the_trace_of_the_hat_matrix(
    problem: Problem, solved: Eliminated, sensor: int
) -> None:
    """Sixteen of a sensor's readings for itself, the rest for the weights."""
    rows = problem.A[problem.row_owner == sensor]
    hat = rows @ np.linalg.solve(problem.A.T @ problem.A, rows.T)
    assert 16 + solved.taken(sensor) == pytest.approx(np.trace(hat), rel=1e-10)


def test_all_readings_and_the_prior_take_as_much_as_there_are_numbers(
    problem: Problem, solved: Eliminated
) -> None:
    prior = problem.A[problem.row_owner == -1]
    hat = prior @ np.linalg.solve(problem.A.T @ problem.A, prior.T)
    taken = sum(16 + solved.taken(sensor) for sensor in SENSORS)
    assert taken + np.trace(hat) == pytest.approx(sum(WIDTH.values()))


def test_a_baseline_correlates_sensors() -> None:
    """The covariance of both, beside dense algebra; without a baseline they are no cluster."""
    problem = Problem(baseline=True)
    solved = eliminate(problem.graph, SENSORS, SIZES)
    assert [each.sensors for each in solved.clusters] == [(0, 2)]
    covariance = np.linalg.inv(problem.A.T @ problem.A)[:32, :32]
    np.testing.assert_allclose(solved.among((0, 2)), covariance, atol=1e-10)
    turned = np.roll(np.roll(covariance, 16, axis=0), 16, axis=1)
    np.testing.assert_allclose(solved.among((2, 0)), turned, atol=1e-10)
    apart = eliminate(Problem(baseline=False).graph, SENSORS, SIZES)
    assert [each.sensors for each in apart.clusters] == [(0,), (2,)]


def test_many_rows_become_few_without_loss() -> None:
    """|X x + E beta - b|^2 at random points, to rounding; QR of two blocks of columns and b."""
    rng = np.random.default_rng(3)
    X, E, b = rng.normal(size=(90, 16)), rng.normal(size=(90, 5)), rng.normal(size=90)
    rows = Rows(X, E, b, np.arange(5))
    few = rows.fewer()
    assert few.X.shape == (22, 16)
    for x, beta in zip(rng.normal(size=(10, 16)), rng.normal(size=(10, 5)), strict=True):
        before = np.sum((rows.X @ x + rows.E @ beta - rows.b) ** 2)
        after = np.sum((few.X @ x + few.E @ beta - few.b) ** 2)
        assert after == pytest.approx(before, rel=1e-11)
    assert few.fewer() is few
