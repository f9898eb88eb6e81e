"""Odometry's steady drift, found from what a map says of the way."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.drive import as_poses
from l2m_gtsam.slam.links import Links
from l2m_gtsam.slam.localisation import known_sensors
from l2m_gtsam.slam.online.belief import Belief
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose
from l2m_gtsam.slam.online.tracked_drift import TrackedDrift
from tests.drives.slam import calibrated, rounds
from tests.worlds.exact import random_sensors

SHARE, OVER_M = 0.02, 10.0
STEP_M, TOLD_M = 0.002, 0.005  # random errors of a step, and of places that the map tells
SENSORS = known_sensors(calibrated(random_sensors(0, 1)).sensors)


@dataclass(frozen=True)
class Way:
    """Key poses by odometry, their true poses, and the drift in its standard deviations, (3,)."""

    key_poses: list[ArrivedKeyPose]
    truth: list[gtsam.Pose3]
    drift: FloatArray


def way_of(seed: int, of_height: float = 1.0, seconds: float = 30.0) -> Way:
    """Return rounds of half a metre a second, with a key pose each 0.1 s."""
    rng, every = np.random.default_rng(seed), rounds(seconds)
    path = every[np.arange(0, len(every), 2)]
    truth = as_poses(path.R, path.p)
    drift, steady = rng.normal(size=3), SHARE * np.array([1.0, 1.0, of_height])
    first = ArrivedKeyPose.first(int(path.stamp_ns[0]), Links.none())
    covariance = np.diag([1e-10] * 3 + [STEP_M**2] * 3)
    found = [first]
    for number, (a, b) in enumerate(pairwise(truth), start=1):
        step, R = a.between(b), a.rotation().matrix()
        drifted = step.translation() + R.T @ (steady * drift * np.linalg.norm(step.translation()))
        p = drifted + step.rotation().matrix() @ rng.normal(0, STEP_M, 3)
        own = replace(first, number=number, R=step.rotation().matrix(), p=p, steady=steady)
        found.append(replace(own, covariance=covariance))
    return Way(found, truth, drift)


def belief_at(pose: gtsam.Pose3, sigma: float) -> Belief:
    return Belief(pose, SENSORS, np.diag([1e-8] * 3 + [sigma**2] * 3))


def told(way: Way, seed: int) -> Iterator[Belief]:
    """Yield what a map tells of each key pose."""
    rng = np.random.default_rng(1000 + seed)
    for pose in way.truth:
        yield belief_at(pose.retract(np.append(np.zeros(3), rng.normal(0, TOLD_M, 3))), TOLD_M)


def tracked(way: Way, beliefs: list[Belief]) -> TrackedDrift:
    found = TrackedDrift.at_start(OVER_M, beliefs[0])
    for before, now, key_pose in zip(beliefs, beliefs[1:], way.key_poses[1:], strict=False):
        found = found.moved(key_pose, before).seen(now)
    return found


def test_the_drift_is_as_near_as_it_says() -> None:
    """NEES over 200 drives, 3 +- 0.17: five of these sigmas either way, and all is learnt."""
    nees = []
    for seed in range(200):
        way = way_of(seed, seconds=10.0)
        known = tracked(way, list(told(way, seed))).known
        off = known.drift - way.drift
        nees.append(off @ np.linalg.solve(known.covariance, off))
        assert np.sqrt(np.diag(known.covariance)).max() < 0.2
    assert np.mean(nees) == pytest.approx(3.0, abs=5 * np.sqrt(6 / 200))


@given(seed=st.integers(0, 1000))
@settings(deadline=None, max_examples=10)
def test_places_that_follow_odometry_tell_nothing(seed: int) -> None:
    """A vehicle without readings: its place is odometry's, as uncertain as the drift makes it."""
    way, beliefs = way_of(seed), [belief_at(gtsam.Pose3(), TOLD_M)]
    found = TrackedDrift.at_start(OVER_M, beliefs[0])
    for key_pose in way.key_poses[1:]:
        expected = found.without(key_pose, beliefs[-1])
        predicted = beliefs[-1].predicted(expected.step, expected.covariance)
        beliefs.append(predicted.marginalize_previous())
        found = found.moved(key_pose, beliefs[-2]).seen(beliefs[-1])
    # Until errors are a tenth of the drift's the first metres may look like readings.
    np.testing.assert_allclose(np.diag(found.known.covariance), 1.0, rtol=0.05)
    path = sum(each.length_m for each in way.key_poses)
    assert np.trace(beliefs[-1].pose_covariance[3:, 3:]) > 3 * (SHARE * path) ** 2 / 2


def test_a_step_loses_what_is_known_of_the_drift() -> None:
    way = way_of(3)
    found, before = tracked(way, list(told(way, 3))), belief_at(way.truth[-2], TOLD_M)
    last = way.key_poses[-1]
    true = way.truth[-2].between(way.truth[-1]).translation()
    without = found.without(last, before)
    assert not without.steady.any()
    R = way.truth[-2].rotation().matrix()
    removed = last.p - without.p
    np.testing.assert_allclose(R @ removed, SHARE * last.length_m * found.known.drift, atol=1e-12)
    assert np.linalg.norm(without.p - true) < 5 * STEP_M
    # By steps of such errors it is known to these over the root of the way, and counts over 10 m.
    more = np.trace((without.covariance - last.covariance)[3:, 3:])
    left = OVER_M * SHARE / found.way.drift_m[0] * np.trace(last.covariance[3:, 3:])
    assert more == pytest.approx(left, rel=0.2)


def test_steps_without_a_drift_stay_as_they_are() -> None:
    way = way_of(4)
    found = tracked(way, list(told(way, 4)))
    stated = replace(way.key_poses[-1], steady=np.zeros(3))
    assert found.without(stated, belief_at(way.truth[-2], TOLD_M)) is stated


def test_on_an_even_floor_nothing_drifts_upwards() -> None:
    way = way_of(5, of_height=0.0)
    found = tracked(way, list(told(way, 5)))
    assert found.known.drift[2] == 0.0
    expected = found.without(way.key_poses[-1], belief_at(way.truth[-2], TOLD_M))
    R, more = way.truth[-1].rotation().matrix(), expected.covariance - way.key_poses[-1].covariance
    np.testing.assert_allclose((R @ more[3:, 3:] @ R.T)[2], 0.0, atol=1e-16)
    np.testing.assert_allclose(found.known.drift[:2], way.drift[:2], atol=0.3)


def test_after_a_motion_that_odometry_lost_the_drift_is_still_known() -> None:
    """It is counted anew from there on, where the motion would be taken for a drift."""
    way = way_of(6)
    beliefs = list(told(way, 6))
    found = tracked(way, beliefs)
    away = belief_at(way.truth[-1].compose(gtsam.Pose3(gtsam.Rot3(), [5.0, 0.0, 0.0])), TOLD_M)
    anew = found.anchored(away)
    np.testing.assert_array_equal(anew.known.drift, found.known.drift)
    assert not anew.way.drift_m.any()
    on = anew.moved(way.key_poses[-1], away).seen(away)
    sigma = np.sqrt(np.diag(found.known.covariance))
    assert (np.abs(on.known.drift - found.known.drift) < 2 * sigma).all()


def test_a_steady_turning_is_a_walk_of_the_heading() -> None:
    """Of its variance after 10 m, about the map's z axis; the step stays as odometry has it."""
    way = way_of(8)
    found, before = tracked(way, list(told(way, 8))), belief_at(way.truth[-2], TOLD_M)
    plain = replace(way.key_poses[-1], steady=np.zeros(3))
    turning = replace(plain, turning=np.array([0.0, 0.0, 0.01]))
    without = found.without(turning, before)
    assert not without.turning.any()
    np.testing.assert_array_equal(without.p, plain.p)
    R = before.pose.rotation().matrix() @ plain.R
    more = R @ (without.covariance - plain.covariance)[:3, :3] @ R.T
    expected = np.diag([0.0, 0.0, 0.01**2 * OVER_M * plain.length_m])
    np.testing.assert_allclose(more, expected, rtol=0, atol=1e-12)
