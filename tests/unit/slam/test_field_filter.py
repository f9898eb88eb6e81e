"""The filter of pose and field against closed forms, and hypotheses of jumps."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from l2m_factors import KeyPoseReadings, drift_weights
from l2m_gtsam.data import Distortion, FloatArray
from l2m_gtsam.maps.potential import PotentialBasis, PotentialHyperparameters
from l2m_gtsam.slam.drift import DRIFT
from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.key_pose_readings import no_readings
from l2m_gtsam.slam.links import Links
from l2m_gtsam.slam.odometry import FixedStep
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose
from l2m_gtsam.slam.online.step_doubts import CERTAIN, MOST, decided, likely
from l2m_gtsam.slam.unknown_field.field_filter import (
    NO_DRIFT,
    DeadReckoning,
    FieldFilter,
    FilterState,
    FilterStep,
    moved,
)
from l2m_gtsam.slam.unknown_field.odometry_hypotheses import Hypotheses, Hypothesis
from l2m_gtsam.slam.unknown_field.whole_field import WholeField

NOISE_UT, WAVES, STEPS = 0.5, 60, 25
EXACT = 1e-12 * np.eye(6)
LARGEST = float(chi2.ppf(0.9999, 3))


@pytest.fixture(scope="module")
def field() -> WholeField:
    prior = PotentialHyperparameters(sigma=5.0, length=1.0)
    low, high = np.array([-2.0, -2.0, -2.0]), np.array([6.0, 4.0, 2.0])
    return WholeField.of(PotentialBasis.over(low, high, prior, WAVES))


def sensors(sigma: float = 1e-9) -> KnownSensors:
    """Return one sensor off the axis, whose distortion is known to so much."""
    ideal = Distortion.identity().vector()
    covariance = sigma**2 * np.eye(15)[None]
    t, noise = np.array([[0.1, 0.05, 0.0]]), np.array([NOISE_UT])
    return KnownSensors(("mag",), t, ideal[None], np.zeros(1), noise, covariance)


def reading(number: int, value: FloatArray) -> KeyPoseReadings:
    """Return a reading at the end of a step."""
    here = np.array([number]), np.zeros(1, dtype=np.int64)
    return KeyPoseReadings(*here, np.eye(3)[None], np.zeros((1, 3)), np.ones(1), value[None])


def motions() -> list[gtsam.Pose3]:
    return [
        gtsam.Pose3(gtsam.Rot3.RzRyRx(0.01, -0.02, 0.1 * np.sin(k)), np.array([0.15, 0.02, 0.01]))
        for k in range(STEPS)
    ]


def walked() -> list[gtsam.Pose3]:
    poses = [gtsam.Pose3()]
    for motion in motions():
        poses.append(poses[-1].compose(motion))
    return poses


def test_at_known_poses_the_field_is_the_ridge_solution(field: WholeField) -> None:
    rng, known = np.random.default_rng(1), sensors()
    poses = walked()[1:]
    x = np.stack([pose.transformFrom(known.t[0]) for pose in poses])
    R = np.stack([pose.rotation().matrix() for pose in poses])
    F = R.transpose(0, 2, 1) @ field.features(x)
    y = F @ rng.normal(size=len(field)) + NOISE_UT * rng.normal(size=(STEPS, 3))
    follows = FieldFilter(field, known, largest=np.inf)
    state = follows.start()
    for k, motion in enumerate(motions()):
        state = follows.after(state, FilterStep(motion, EXACT, reading(k, y[k]), NO_DRIFT))
    A = F.reshape(-1, len(field)) / NOISE_UT
    information = np.eye(len(field)) + A.T @ A
    expected = np.linalg.solve(information, A.T @ y.ravel() / NOISE_UT)
    # Poses and distortion are known to 1e-6 m and 1e-9: what they leave of 30 uT/m is far less.
    np.testing.assert_allclose(state.weights, expected, rtol=0, atol=1e-3)
    P = state.covariance[6 : 6 + len(field), 6 : 6 + len(field)]
    np.testing.assert_allclose(P, np.linalg.inv(information), rtol=0, atol=1e-3)
    # The density of all readings, given their poses: that of the Gaussian process.
    S = A @ A.T + np.eye(3 * STEPS)
    white = y.ravel() / NOISE_UT
    log_likelihood = -0.5 * (white @ np.linalg.solve(S, white) + np.linalg.slogdet(S)[1])
    log_likelihood -= 3 * STEPS * np.log(NOISE_UT)
    assert state.log_likelihood == pytest.approx(log_likelihood, abs=1e-2)


def drift_of(motion: gtsam.Pose3, share: float, turn: float) -> FloatArray:
    """Return what a unit of a drift with distance adds, along a tilted axis where it turns."""
    length, axis = np.linalg.norm(motion.translation()), np.array([0.6, 0.0, 0.8])
    found = np.zeros((6, DRIFT))
    found[:, :6] = drift_weights(np.array([0.0, share * length]))
    found[:3, 7] = turn * length * axis
    return found


@pytest.mark.parametrize("fixed", [False, True])
@given(seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_derivatives_of_a_step_are_those_of_finite_differences(fixed: bool, seed: int) -> None:
    """By the pose before and by a drift that turns; both of right perturbations."""
    rng = np.random.default_rng(seed)
    pose, motion = (gtsam.Pose3.Expmap(rng.normal(0, 0.7, 6)) for _ in range(2))
    axes = FixedStep(gtsam.Rot3.Expmap(rng.normal(0, 0.7, 3)).matrix(), rng.normal(size=3))
    step = FilterStep(
        motion, np.eye(6), no_readings(), drift_of(motion, 0.3, 0.4), axes if fixed else None
    )
    drift = rng.normal(size=DRIFT)
    _, by_pose, by_drift = moved(step, pose, drift)
    # Central differences of terms of order one: off by 1e-12, and by rounding of 1e-16 / 1e-6.
    h = 1e-6
    for k, change in enumerate(h * np.eye(6)):
        ends = [moved(step, pose.retract(sign * change), drift)[0] for sign in (1, -1)]
        slope = gtsam.Pose3.Logmap(ends[1].between(ends[0])) / (2 * h)
        np.testing.assert_allclose(by_pose[:, k], slope, atol=1e-8)
    for k, change in enumerate(h * np.eye(DRIFT)):
        ends = [moved(step, pose, drift + sign * change)[0] for sign in (1, -1)]
        slope = gtsam.Pose3.Logmap(ends[1].between(ends[0])) / (2 * h)
        np.testing.assert_allclose(by_drift[:, k], slope, atol=1e-8)


def test_a_path_that_a_turning_bends_is_as_far_as_its_drift_is_unlikely() -> None:
    """To first order about a drift near it; about none, 2 rad before, it seems out of reach."""
    rng, Q = np.random.default_rng(4), np.diag([1e-6] * 3 + [1e-6] * 3)
    drift = np.append(np.zeros(7), 2.0)
    plain, true = DeadReckoning.at_start(), DeadReckoning.at_start(drift)
    near = DeadReckoning.at_start(drift + np.append(np.zeros(7), 0.2))
    for motion in 4 * motions():
        step = FilterStep(motion, Q, no_readings(), drift_of(motion, 0.0, 0.07))
        plain, true, near = (each.after(step) for each in (plain, true, near))
    pose = true.pose.retract(np.linalg.cholesky(true.walk) @ rng.normal(size=6))
    # Of the drift two sigmas; the walk adds six in the mean, and at most 25 once in 3,000.
    assert true.squared_distance(pose) < 2.0**2 + 25
    assert near.squared_distance(pose) == pytest.approx(true.squared_distance(pose), rel=0.1)
    assert plain.squared_distance(pose) > 100


@pytest.mark.parametrize(("share", "turn"), [(0.0, 0.0), (0.05, 0.0), (0.05, 0.1)])
@pytest.mark.parametrize("fixed", [False, True])
def test_without_readings_it_is_odometry(
    field: WholeField, fixed: bool, share: float, turn: float
) -> None:
    """Mean and covariance; along fixed axes errors of turns shift nothing."""
    follows, Q = FieldFilter(field, sensors(), LARGEST), np.diag([1, 2, 3, 4, 5, 6]) * 1e-4
    state, reckoned, poses = follows.start(), DeadReckoning.at_start(), walked()
    length = sum(np.linalg.norm(each.translation()) for each in motions())
    for before, after, motion in zip(poses[:-1], poses[1:], motions(), strict=True):
        turned = after.rotation().compose(before.rotation().inverse()).matrix()
        axes = FixedStep(turned, after.translation() - before.translation()) if fixed else None
        step = FilterStep(motion, Q, no_readings(), drift_of(motion, share, turn), axes)
        state, reckoned = follows.after(state, step), reckoned.after(step)
    for found in (state.pose, reckoned.pose):
        np.testing.assert_allclose(found.matrix(), poses[-1].matrix(), atol=1e-12)
    np.testing.assert_allclose(state.pose_covariance, reckoned.covariance, rtol=1e-12)
    if fixed:  # sums of the steps' own, turned to the axes of the last pose
        R = [poses[-1].rotation().matrix().T @ each.rotation().matrix() for each in poses[1:]]
        shifts = sum(each @ Q[3:, 3:] @ each.T for each in R)
        drift = (share * length) ** 2 * np.eye(3)  # along one line all the way
        np.testing.assert_allclose(reckoned.covariance[3:, 3:], shifts + drift, rtol=1e-9)


def test_a_corrected_sensor_sees_the_field_that_the_correction_says() -> None:
    rng = np.random.default_rng(2)
    C, H, A, h = rng.normal(size=(3, 3)), rng.normal(size=3), rng.normal(size=(3, 3)), np.ones(3)
    known = replace(sensors(), distortion=np.append(C.ravel(), H)[None])
    found = known.corrected(np.append(A.ravel(), h)).distortion[0]
    z = rng.normal(size=3)
    b = A @ np.linalg.solve(C, z - H) + h
    np.testing.assert_allclose(found[:9].reshape(3, 3) @ b + found[9:], z, atol=1e-9)


def test_a_reading_far_off_counts_as_little_as_the_least_that_does(field: WholeField) -> None:
    follows = FieldFilter(field, sensors(), LARGEST)
    step = FilterStep(motions()[0], EXACT, reading(0, np.full(3, 1e4)), NO_DRIFT)
    before = follows.after(follows.start(), replace(step, readings=no_readings()))
    after = follows.after(follows.start(), step)
    np.testing.assert_array_equal(after.weights, before.weights)
    assert np.isfinite(after.log_likelihood)


def hypothesis(log_likelihood: float, *recorded: int, at: float = 0.0) -> Hypothesis:
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([at, 0.0, 0.0]))
    P = np.diag([1e-4] * 3 + [1e-2] * 3)
    state = FilterState(pose, np.zeros(0), np.zeros((1, 12)), np.zeros(6), P, log_likelihood)
    return Hypothesis(state, (pose,), frozenset(recorded))


def test_hypotheses_end_where_readings_speak_against_them() -> None:
    near, far = hypothesis(0.0, 5), hypothesis(-CERTAIN - 4.0)
    assert likely([far, near]) == [near]
    many = [hypothesis(-0.1 * k, 5) for k in range(2 * MOST)]
    assert likely(many[::-1]) == many[:MOST]


def test_a_jump_is_decided_where_all_agree_and_doubt_is_in_the_covariance() -> None:
    one, other = hypothesis(0.0, 5, 9), hypothesis(3.0, 5, at=2.0)  # 3 nats speak for each jump
    both = Hypotheses((one, other))
    assert [(each.number, each.was_motion) for each in decided(both.all, [5, 9])] == [(5, True)]
    # Equally likely, 2 m apart: half of 2^2 along x.
    assert both.pose_covariance()[3, 3] == pytest.approx(1e-2 + 0.5 * 4.0)
    assert both.pose_covariance()[4, 4] == pytest.approx(1e-2)


def test_a_jump_is_followed_both_ways_until_it_is_decided(field: WholeField) -> None:
    follows = FieldFilter(field, sensors(), LARGEST)

    def arrived(p: FloatArray) -> ArrivedKeyPose:
        none = np.empty(0, dtype=np.int64)
        return ArrivedKeyPose(
            1, 0, np.eye(3), p, 1e-4 * np.eye(6), no_readings(), none, Links.none()
        )

    key_pose = replace(arrived(np.zeros(3)), recorded=arrived(np.array([1.5, 0.0, 0.0])))
    begun = Hypotheses.begun(follows)
    both = begun.after(key_pose, follows, None)
    assert [each.recorded for each in both.all] == [frozenset({1}), frozenset()]
    assert both.best.state.pose.translation()[0] == pytest.approx(1.5)
    for was_motion, x in ((True, 1.5), (False, 0.0)):
        (only,) = begun.after(key_pose, follows, was_motion).all
        assert only.state.pose.translation()[0] == pytest.approx(x)
