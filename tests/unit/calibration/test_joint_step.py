"""The last round of the joint graph, from where a descent has nearly ended and from elsewhere."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from l2m_gtsam.calibration import joint
from l2m_gtsam.calibration.alternation import OneKeyOptions, start_estimate
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.joint import JointProblem, joint_problem, joint_step
from l2m_gtsam.calibration.optimise import Ending, Optimised
from l2m_gtsam.calibration.view import observe
from l2m_gtsam.data import FloatArray
from tests.worlds.exact import dipole_world, drive, random_sensors

NOISE = 0.1  # uT
OPTIONS = OneKeyOptions(sensor_noise_ut=NOISE)


def problem_from(off: float) -> tuple[JointProblem, Estimate, FloatArray]:
    """Return the graph of one sensor, an estimate so many metres off, and where the sensor is."""
    world, sensors = dipole_world(4), random_sensors(4, 1)
    readings = drive(4, sensors, world, count=300, noise=NOISE)
    true = sensors[0].t_lidar_mag[None]
    estimate = start_estimate(true + off, OPTIONS)
    estimate = replace(estimate, distortion=sensors[0].distortion.vector()[None])
    view = observe(readings, world, estimate, OPTIONS.min_readings)
    return joint_problem(view, world, estimate, OPTIONS), estimate, true


def test_where_steps_go_uphill_the_graph_descends_to_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """To where Gauss-Newton arrives that is not refused."""
    problem, estimate, _ = problem_from(0.01)
    arrived = joint_step(problem, estimate, OPTIONS, exact=True)

    def refused(_: gtsam.NonlinearFactorGraph, values: gtsam.Values, __: int) -> Optimised:
        return Optimised(values, Ending.UPHILL)

    monkeypatch.setattr(joint, "polish", refused)
    descended = joint_step(problem, estimate, OPTIONS, exact=True)
    assert descended.ending is Ending.TOLERANCE
    assert np.abs(descended.estimate.t - estimate.t).max() > 5e-3
    # A hundredth of a sigma of 2 mm; a descent that has only nearly ended is 0.26 mm off.
    np.testing.assert_allclose(descended.estimate.t, arrived.estimate.t, rtol=0, atol=2e-5)


def test_an_intermediate_round_comes_near() -> None:
    problem, estimate, true = problem_from(0.01)
    near = joint_step(problem, estimate, OPTIONS, exact=False).estimate.t
    arrived = joint_step(problem, estimate, OPTIONS, exact=True).estimate.t
    assert np.abs(near - arrived).max() < 0.1 * np.abs(estimate.t - true).max()
