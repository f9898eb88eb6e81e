"""Readings on poses that are variables: derivatives on the manifold, batching, and agreement."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_factors import (
    BatchedReadings,
    D,
    M,
    MagneticReadings,
    MapBatch,
    SharedError,
    StepError,
    T,
    Whitening,
    X,
    assert_jacobians_match,
    key_pose_factor,
)
from tests.support.factor_inputs import (
    MODES,
    SENSORS,
    CountingWorld,
    calibrations,
    on,
    random_carried,
    step_error,
    values_for,
    whitenings,
    with_motion,
)
from tests.worlds.exact import dipole_world


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_jacobians_match_central_differences(seed: int) -> None:
    """By pose, place, distortion, time offset, errors of map and step: 1e-6 of the largest."""
    world, values, readings = dipole_world(seed), values_for(seed, 3), random_carried(seed)
    step = step_error(seed, 4, values)
    timed = with_motion(readings, seed)
    features = np.random.default_rng(seed).normal(size=(4, 3, MODES))
    shared = [SharedError(M(7), features)]
    W = whitenings(seed, 4)
    fixed = calibrations(values)
    for batch, errors, way in (
        (MapBatch(world, readings), [], None),
        (MapBatch(world, timed), shared, step),
        (MapBatch(world, timed, fixed), shared, None),
        (MapBatch(world, readings, fixed), [], step),
    ):
        factor = key_pose_factor(batch, 1, W, errors, way)
        # Steps of 2e-5 leave 1e-8 of third derivatives; rounding of 50 uT is smaller yet.
        assert_jacobians_match(factor, values, rtol=1e-6, step=2e-5)


@given(seed=st.integers(0, 10_000), n=st.integers(1, 6), common=st.integers(0, 20))
def test_whitening_makes_covariances_the_identity(seed: int, n: int, common: int) -> None:
    """Beside the dense covariance, also with more errors than residuals.

    Errors that say less than a thousandth of the noise's variance are left out.
    """
    rng = np.random.default_rng(seed)
    own = rng.normal(size=(n, 3, 3)) + 3 * np.eye(3)
    errors = rng.normal(size=(n, 3, common)) * 10.0 ** rng.uniform(-4, 2, common)
    white = Whitening.with_errors(own, errors)
    S, F = np.zeros((3 * n, 3 * n)), errors.reshape(3 * n, common)
    for k, W in enumerate(own):
        S[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = np.linalg.inv(W.T @ W)
    half = white((S + F @ F.T).reshape(n, 3, 3 * n))
    whole = white(half.T.reshape(n, 3, 3 * n))
    # Beside a thousandth: rounding of covariances a million times as large as the noise.
    np.testing.assert_allclose(whole, np.eye(3 * n), atol=2e-3)
    # Each error that is left out has so little of it.
    volume = np.linalg.slogdet(S + F @ F.T)[1]
    assert -2 * white.log_determinant == pytest.approx(volume, abs=2e-3 * (1 + common))


def test_what_is_known_of_a_step_shifts_the_readings() -> None:
    """A step that is longer by 2 cm: a reading after half of it reads as one 1 cm ahead."""
    world, values, fixed = dipole_world(7), values_for(7, 3), calibrations(values_for(7))
    readings = replace(on(random_carried(7), 1), fraction=np.full(4, 0.5))
    off, step = np.array([0, 0, 0, 0.02, 0, 0]), gtsam.Pose3(gtsam.Rot3(), [0.2, 0, 0])
    ahead = replace(readings, p_key_lidar=readings.p_key_lidar + 0.5 * off[3:])
    residuals = MapBatch(world, readings, fixed).residuals(values, 1)
    values.update(X(2), values.atPose3(X(1)).compose(step).retract(off))
    W = Whitening.independent(np.tile(np.eye(3), (4, 1, 1)))
    slope = 0.5 * residuals.de_dX @ step.AdjointMap()
    batch = MapBatch(world, readings, fixed)
    found = key_pose_factor(batch, 1, W, step=StepError(1, step, slope)).unwhitenedError(values)
    expected = MapBatch(world, ahead, fixed).residuals(values, 1).reading.residual
    # 1 cm in a field that bends over decimetres: the shift is linear to some per cent.
    change = np.linalg.norm(expected - residuals.reading.residual)
    assert np.linalg.norm(found - expected.ravel()) < 0.1 * change


@given(seed=st.integers(0, 10_000))
@settings(max_examples=10)
def test_at_given_poses_it_is_the_factor_of_known_poses(seed: int) -> None:
    """Same residuals and derivatives as readings whose poses are constants: up to rounding."""
    world, values, carried = dipole_world(seed), values_for(seed), random_carried(seed)
    poses = [values.atPose3(X(int(k))) for k in carried.key_pose]
    lidars = [
        pose.compose(gtsam.Pose3(gtsam.Rot3(R), p))
        for pose, R, p in zip(poses, carried.R_key_lidar, carried.p_key_lidar, strict=True)
    ]
    known = MagneticReadings(
        carried.sensor,
        np.stack([each.rotation().matrix() for each in lidars]),
        np.stack([each.translation() for each in lidars]),
        carried.field,
    )
    expected = BatchedReadings(world, known).residuals(values, 0)
    found = MapBatch(world, carried).residuals(values, 0).reading
    np.testing.assert_allclose(found.residual, expected.residual, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.de_dt, expected.de_dt, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.de_dD, expected.de_dD, rtol=0, atol=1e-9)


def graph_of(batch: MapBatch) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for k in batch.key_poses:
        W = np.broadcast_to(np.eye(3), (len(batch.rows_of(k)), 3, 3))
        graph.add(key_pose_factor(batch, k, Whitening.independent(W)))
    return graph


@pytest.mark.parametrize("timed", [False, True])
def test_one_map_query_when_all_poses_move(timed: bool) -> None:
    counting, values = CountingWorld(dipole_world(2)), values_for(2, key_poses=5)
    readings = random_carried(2, key_poses=5)
    graph = graph_of(MapBatch(counting, with_motion(readings, 2) if timed else readings))
    graph.error(values)
    graph.linearize(values)
    assert counting.calls == 1
    tangent = values.zeroVectors()
    for k in range(5):
        tangent.update(step_of(X(k)))
    graph.linearize(values.retract(tangent))
    assert counting.calls == 2


def step_of(key: int) -> gtsam.VectorValues:
    step = gtsam.VectorValues()
    step.insert(key, np.full(6, 0.01))
    return step


def test_a_batch_for_each_key_pose_pays_for_what_moves() -> None:
    """What iSAM2 needs: of five key poses one is asked again, and its batch alone."""
    counting, values = CountingWorld(dipole_world(3)), values_for(3, key_poses=5)
    readings = random_carried(3, key_poses=5)
    alone = [MapBatch(counting, on(readings, k)) for k in range(5)]
    factors = [graph_of(batch).at(0) for batch in alone]
    for factor in factors:
        factor.linearize(values)
    assert counting.calls == 5
    tangent = values.zeroVectors()
    tangent.update(step_of(X(3)))
    later = values.retract(tangent)
    for factor in factors:
        factor.linearize(later)
    assert counting.calls == 6


def test_batches_of_any_size_are_the_same_graph() -> None:
    world, values = dipole_world(4), values_for(4, key_poses=3)
    readings = random_carried(4, key_poses=3)
    whole = graph_of(MapBatch(world, readings)).linearize(values).hessian()
    parts = gtsam.NonlinearFactorGraph()
    for k in range(3):
        parts.push_back(graph_of(MapBatch(world, on(readings, k))))
    other = parts.linearize(values).hessian()
    for one, two in zip(whole, other, strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-12 * np.abs(one).max())


def test_a_factor_alone_needs_only_its_own_variables() -> None:
    readings, everything = random_carried(5), values_for(5)
    mine = on(readings, 1)
    batch = MapBatch(dipole_world(5), readings)
    values = gtsam.Values()
    values.insert(X(1), everything.atPose3(X(1)))
    for i in range(SENSORS):
        values.insert(T(i), everything.atPoint3(T(i)))
        values.insert(D(i), everything.atVector(D(i)))
    W = whitenings(5, len(mine))
    alone = key_pose_factor(MapBatch(dipole_world(5), mine), 1, W)
    assert key_pose_factor(batch, 1, W).error(values) == pytest.approx(alone.error(everything))


def test_arrays_that_are_written_into_later_change_no_batch() -> None:
    values, readings = values_for(8), random_carried(8)
    fixed = calibrations(values)
    batch, world = MapBatch(dipole_world(8), readings, fixed), dipole_world(8)
    expected = MapBatch(world, readings, fixed).residuals(values, 0).reading.residual
    for array in (readings.field, readings.p_key_lidar, readings.sensor, fixed.t, fixed.distortion):
        array[:] = 0
    found = batch.residuals(values, 0).reading.residual
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("name", "of", "line"),
    [
        ("field", lambda field: field[:1], r"field: of shape \(1, 3\); needed is \(8, 3\)"),
        ("field", lambda field: np.nan * field, "field: row 0 is not finite"),
        ("key_pose", lambda key_pose: key_pose[:1], r"key_pose: of shape \(1,\); needed is \(8,\)"),
        ("sensor", lambda sensor: sensor + 1, "sensor: 2; there are calibrations of 2 sensors"),
    ],
)
def test_a_batch_of_wrong_readings_is_refused(
    name: str, of: Callable[[Any], Any], line: str
) -> None:
    readings = random_carried(8)
    change: dict[str, Any] = {name: of(getattr(readings, name))}
    wrong = replace(readings, **change)
    with pytest.raises(ValueError, match=line):
        MapBatch(dipole_world(8), wrong, calibrations(values_for(8)))


def test_arrays_that_are_written_into_later_change_no_factor() -> None:
    values, readings = values_for(8, 3), random_carried(8)
    W, step = whitenings(8, 4), step_error(8, 4, values)
    shared = SharedError(M(7), np.ones((4, 3, MODES)))
    batch = MapBatch(dipole_world(8), readings)
    factor = key_pose_factor(batch, 1, W, [shared], step)
    before = factor.error(values)
    for array in (W.own, W.common, step.slope, shared.features):
        array[:] = 0
        assert factor.error(values) == before


def test_a_factor_of_wrong_arguments_is_refused_in_one_line() -> None:
    values, W = values_for(8, 3), whitenings(8, 4)
    batch = MapBatch(dipole_world(8), random_carried(8))
    flat, off = Whitening(W.own[0], W.common), step_error(8, 1, values)
    for k, white, step, line in (
        (7, W, None, "key_pose: 7 has no readings; see key_poses of the batch"),
        (1, whitenings(8, 3), None, "Whitening.own: of shape (3, 3, 3); needed is (4, 3, 3)"),
        (1, flat, None, "Whitening.own: of shape (3, 3); needed is (4, 3, 3)"),
        (1, W, off, "StepError.slope: of shape (1, 3, 6); needed is (4, 3, 6)"),
    ):
        with pytest.raises(ValueError, match=f"^{re.escape(line)}$"):
            key_pose_factor(batch, k, white, step=step)


class Interrupted(MapBatch):
    """A batch that another thread asks for other values while it keeps what it is evaluated at."""

    between: list[gtsam.Values]

    def _extracted(self, values: gtsam.Values) -> gtsam.Values:
        if self.between:
            self.residuals(self.between.pop(), 0)
        return super()._extracted(values)


def test_two_threads_get_their_own_residuals() -> None:
    one, other = values_for(8), values_for(9)
    world, readings = dipole_world(8), random_carried(8)
    batch = Interrupted(world, readings)
    batch.between = [other]
    for values in (one, other, one):
        alone = MapBatch(world, readings).residuals(values, 0).reading.residual
        np.testing.assert_array_equal(batch.residuals(values, 0).reading.residual, alone)


def test_a_sensor_that_comes_later_is_not_asked_for() -> None:
    """On line, values have all key poses so far, but no calibration of a sensor yet to come."""
    everything, readings = values_for(5), random_carried(5)
    readings = replace(readings, sensor=readings.key_pose)
    values = gtsam.Values()
    for key in (X(0), X(1)):
        values.insert(key, everything.atPose3(key))
    values.insert(T(0), everything.atPoint3(T(0)))
    values.insert(D(0), everything.atVector(D(0)))
    world, W = dipole_world(5), whitenings(5, 4)
    alone = key_pose_factor(MapBatch(world, on(readings, 0)), 0, W)
    factor = key_pose_factor(MapBatch(world, readings), 0, W)
    assert factor.error(values) == pytest.approx(alone.error(values))
    assert_jacobians_match(factor, values)


def test_a_reading_pulls_its_pose_back() -> None:
    """Exact readings of two sensors on one pose, calibration known: the pose comes back."""
    world, values = dipole_world(6), values_for(6, key_poses=1)
    readings, fixed = random_carried(6, key_poses=1, each=12), calibrations(values)
    at = MapBatch(world, readings, fixed).residuals(values, 0).reading.residual
    exact = replace(readings, field=readings.field + at)
    start = gtsam.Values()
    off = gtsam.Pose3.Expmap(np.array([0.02, -0.03, 0.05, 0.05, -0.04, 0.03]))
    start.insert(X(0), values.atPose3(X(0)).compose(off))
    graph = graph_of(MapBatch(world, exact, fixed))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize().atPose3(X(0))
    # The optimiser ends when its error falls by less than 1e-5 uT^2: some micrometres.
    np.testing.assert_allclose(found.matrix(), values.atPose3(X(0)).matrix(), atol=1e-4)
