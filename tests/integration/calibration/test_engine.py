"""The last graph of a calibration: GTSAM in all its ways, and the old elimination beside it."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from l2m_factors import D, S, T
from l2m_gtsam.calibration import uncertain_graph
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.factor_graph import FactorForm
from l2m_gtsam.calibration.forecast import stated_at
from l2m_gtsam.calibration.one_key import OneKeySolution, solve_one_key
from l2m_gtsam.calibration.optimise import (
    Ending,
    LinearSolver,
    Optimised,
    Optimizer,
    joint_covariance,
    optimise,
)
from l2m_gtsam.calibration.uncertain_graph import (
    IndependentOptimum,
    UncertainDrive,
    UncertainProblem,
    starting_values,
)
from l2m_gtsam.calibration.uncertain_optimum import UncertainOptimum
from l2m_gtsam.calibration.view import View, observe
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.solve.noise import HALF
from tests.drives.uncertain import STARTS, turning_drive
from tests.reference.elimination import eliminate

# What a calibration has by default, but for the forms and methods that are compared.
DEFAULT = OneKeyOptions()
WAYS = [(form, method) for form in FactorForm for method in Optimizer]


@pytest.fixture(scope="module")
def readings() -> Readings:
    """Poses are wrong by 3 mm and 0.1 degrees, for half a second: knots and bridges between."""
    drive = turning_drive()
    root = np.diag(np.repeat([np.deg2rad(0.1), 0.003], 3))
    return replace(drive, pose_root=np.broadcast_to(root, (len(drive), 6, 6)))


@pytest.fixture(scope="module")
def solutions(
    readings: Readings, field_map: HarmonicMap
) -> dict[tuple[FactorForm, Optimizer], OneKeySolution]:
    """The whole calibration, start to end, in every way."""
    return {
        (form, method): solve_one_key(
            readings,
            field_map,
            STARTS,
            DEFAULT.model_copy(update={"factors": form, "optimizer": method}),
        )
        for form, method in WAYS
    }


@pytest.mark.parametrize(("form", "method"), WAYS)
def test_every_way_gives_the_same_calibration(
    solutions: dict[tuple[FactorForm, Optimizer], OneKeySolution],
    form: FactorForm,
    method: Optimizer,
) -> None:
    """t to 1e-7 m; C, H and the covariance to 1e-6, relative to the largest and to the sigmas."""
    one, other = solutions[FactorForm.BLOCK, Optimizer.LM], solutions[form, method]
    assert other.uncertainty is Uncertainty.FULL
    assert not other.unsettled | other.stayed
    np.testing.assert_allclose(other.estimate.t, one.estimate.t, rtol=0, atol=1e-7)
    largest = np.abs(one.estimate.distortion).max()
    off = np.abs(other.estimate.distortion - one.estimate.distortion).max()
    assert off < 1e-6 * largest
    for mine, theirs in zip(one.solved, other.solved, strict=True):
        sigma = np.sqrt(np.diag(mine.joint_covariance)[:15])
        known = np.s_[:15, :15]  # clocks are not determined
        apart = theirs.joint_covariance[known] - mine.joint_covariance[known]
        assert np.abs(apart / np.outer(sigma, sigma)).max() < 1e-6


class LastGraph:
    """The last graph of a calibration at its optimum, as the solve has it."""

    def __init__(self, readings: Readings, field_map: HarmonicMap, found: OneKeySolution) -> None:
        self.estimate = found.estimate
        used = found.readings.select(found.used)
        self.view: View = observe(used, field_map, found.estimate, DEFAULT.min_readings)
        tests = {each.sensor: each.determinacy for each in found.solved}
        near = IndependentOptimum(self.view, field_map, field_map, self.estimate, tests, DEFAULT)
        self.drive = UncertainDrive.of(near)

    def problem(self, form: FactorForm) -> UncertainProblem:
        options = DEFAULT.model_copy(update={"factors": form})
        return UncertainProblem(replace(self.drive, options=options), self.estimate)

    def values(self, shift: FloatArray) -> gtsam.Values:
        """Where sensors are found, but for a shift of all of them in metres, shape (3,)."""
        values = starting_values(self.estimate, self.view.sensors, self.drive.coverage)
        for sensor in self.view.sensors:
            values.update(T(sensor), values.atPoint3(T(sensor)) + shift)
        return values


@pytest.fixture(scope="module")
def last(
    readings: Readings,
    field_map: HarmonicMap,
    solutions: dict[tuple[FactorForm, Optimizer], OneKeySolution],
) -> LastGraph:
    return LastGraph(readings, field_map, solutions[FactorForm.BLOCK, Optimizer.LM])


@pytest.mark.parametrize("form", FactorForm)
def test_the_old_elimination_says_the_same(last: LastGraph, form: FactorForm) -> None:
    """Covariance, degrees of freedom and what is shared, of the same linear graph; rounding."""
    problem = last.problem(form)
    values = problem.polish(last.values(np.zeros(3)), 1, LinearSolver.CHOLESKY).values
    old = eliminate(problem.graph.linearize(values), last.view.sensors, last.drive.coverage.sizes)
    optimum = UncertainOptimum.at(problem, values)
    joint, found = optimum.joint, optimum.solutions()
    for each in found:
        s = each.sensor
        expected = old.covariance(s)[:15, :15]
        sigma = np.sqrt(np.diag(expected))
        apart = (each.joint_covariance[:15, :15] - expected) / np.outer(sigma, sigma)
        assert np.abs(apart).max() < 1e-9
        assert joint.taken(s) == pytest.approx(old.taken(s), rel=1e-8)
        assert each.remaining_sigmas == pytest.approx(old.sigmas(s), rel=1e-5, abs=1e-9)
    one, other = found[0].shared_root, found[1].shared_root
    assert one is not None
    assert other is not None
    common = (old.shared_root(0) @ old.shared_root(1).T)[:15, :15]
    np.testing.assert_allclose(one @ other.T, common, atol=1e-9 * float(np.abs(common).max()))


def test_a_reading_is_a_factor_of_its_own(last: LastGraph) -> None:
    """On its sensor, its tile and the two knots beside it; in blocks there are far fewer.

    One that was taken at a knot hangs on that alone.
    """
    each, blocks = (last.problem(form).graph for form in (FactorForm.READING, FactorForm.BLOCK))
    factors = [each.at(k) for k in range(len(last.view.readings))]
    assert {factor.dim() for factor in factors} == {3}
    knots = []
    for factor in factors:
        keys = list(factor.keys())
        sensor = gtsam.Symbol(keys[0]).index()
        assert keys[:3] == [T(sensor), D(sensor), S(sensor)]
        kinds = [chr(gtsam.Symbol(key).chr()) for key in keys[3:]]
        assert kinds in (["M", "P"], ["M", "P", "P"])
        knots.append(len(kinds) - 1)
    assert np.mean(knots) > 1.9
    assert blocks.size() < each.size()


@pytest.mark.parametrize("form", FactorForm)
def test_from_a_poor_start_lm_arrives_where_gauss_newton_does_not(
    last: LastGraph, form: FactorForm
) -> None:
    """Sensors begin 3 m off, under the floor, where the field is steeper than anywhere else."""
    problem, start = last.problem(form), last.values(np.array([-2.73, 0.49, -1.15]))
    solver, most = LinearSolver.CHOLESKY, DEFAULT.joint_iterations
    least = problem.graph.error(problem.polish(last.values(np.zeros(3)), 1, solver).values)
    ends = {method: optimise(problem.graph, start, method, most, solver) for method in Optimizer}
    errors = {method: problem.graph.error(end.values) for method, end in ends.items()}
    assert errors[Optimizer.LM] == pytest.approx(least, rel=1e-4)
    assert not errors[Optimizer.GN] < 10 * least


def test_a_round_arrives_from_near_and_from_far(last: LastGraph) -> None:
    """A step a round from the optimum of other weights; a descent from 3 m off."""
    problem, at = last.problem(FactorForm.BLOCK), last.values(np.zeros(3))
    exact = problem.polish(at, 4, LinearSolver.CHOLESKY).values
    far = last.values(np.array([-2.73, 0.49, -1.15]))
    for start, near in ((at, True), (at, False), (far, False)):
        end = problem.arrive(start, LinearSolver.CHOLESKY, near=near)
        if near:  # no round from near is the last unless its step was short
            end = problem.arrive(end.values, LinearSolver.CHOLESKY, near=near)
        assert end.ending is Ending.TOLERANCE
        assert end.joint.furthest(last.view.sensors) < uncertain_graph.NEAR_SIGMAS
        for sensor in last.view.sensors:
            off = end.values.atPoint3(T(sensor)) - exact.atPoint3(T(sensor))
            assert np.abs(off).max() < 1e-6


def test_the_limit_of_iterations_reaches_the_last_graph(
    readings: Readings, field_map: HarmonicMap
) -> None:
    found = solve_one_key(
        readings, field_map, STARTS, DEFAULT.model_copy(update={"joint_iterations": 1})
    )
    assert found.ending is Ending.ITERATION_LIMIT


def test_what_cholesky_refuses_qr_solves(
    readings: Readings,
    field_map: HarmonicMap,
    solutions: dict[tuple[FactorForm, Optimizer], OneKeySolution],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """GTSAM's refusal, which the shape of cliques decides, is played; QR is GTSAM's own."""
    asked = []

    def refusing(
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        optimizer: Optimizer,
        most: int,
        solver: LinearSolver,
        tolerance: float,
    ) -> Optimised:
        asked.append(solver)
        if solver is LinearSolver.CHOLESKY:
            return Optimised(values, Ending.SINGULAR)
        return optimise(graph, values, optimizer, most, solver, tolerance)

    monkeypatch.setattr(uncertain_graph, "optimise", refusing)
    found = solve_one_key(readings, field_map, STARTS, DEFAULT)
    assert list(dict.fromkeys(asked)) == [LinearSolver.CHOLESKY, LinearSolver.QR]
    assert asked.count(LinearSolver.CHOLESKY) == 1
    assert found.ending is Ending.TOLERANCE
    usual = solutions[FactorForm.BLOCK, Optimizer.LM]
    np.testing.assert_allclose(found.estimate.t, usual.estimate.t, atol=1e-7)


def test_marginals_that_gtsam_refuses_come_from_elsewhere() -> None:
    """A direction across all axes is known 1e8 times worse than the others."""
    graph, values = gtsam.GaussianFactorGraph(), gtsam.Values()
    values.insert(D(0), np.zeros(12))
    turned = np.linalg.qr(np.random.default_rng(0).normal(size=(12, 12)))[0]
    A = turned / np.append(np.full(11, 1e-6), 1e2)[:, None]
    unit = gtsam.noiseModel.Unit.Create(12)
    graph.push_back(gtsam.JacobianFactor(D(0), A, np.zeros(12), unit))
    asked = []

    def instead(sensors: tuple[int, ...]) -> FloatArray:
        asked.append(sensors)
        return np.eye(16)

    among = joint_covariance(graph, values, instead)
    np.testing.assert_array_equal(among((0,)), np.eye(16))
    assert asked == [(0,)]


def test_a_forecast_stands_on_the_same_graph(last: LastGraph, field_map: HarmonicMap) -> None:
    """At the optimum it states the covariance that the solve does, with the same weights."""
    assert (last.view.trust > HALF).all()
    graph_alone = DEFAULT.model_copy(update={"warp_m": 0.0})  # a bend that is not seen is in none
    stated = stated_at(last.view, field_map, last.estimate, graph_alone)
    problem = last.problem(FactorForm.BLOCK)
    values = last.values(np.zeros(3))
    for each, found in zip(
        stated.solved, UncertainOptimum.at(problem, values).solutions(), strict=True
    ):
        np.testing.assert_allclose(
            each.joint_covariance, found.joint_covariance, rtol=1e-9, atol=1e-18
        )
