"""By how much poses differ from what odometry says of the steps between them."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from l2m_gtsam.data import FieldSeries, FloatArray, Recording, SourceFile
from l2m_gtsam.slam.disturbances import slips
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import DriftOptions, SlamOptions
from l2m_gtsam.slam.pose_graph import pose_values, step_errors, step_factor
from l2m_gtsam.studies.slam.methods import as_recorded
from tests.drives.slam import rounds


@pytest.fixture(scope="module", params=["fixed", "vehicle"])
def drive(request: pytest.FixtureRequest) -> Drive:
    """Rounds whose odometry knows its steps along axes of a kind."""
    made = rounds(20)
    field = np.random.default_rng(0).normal([20.0, 0.0, -40.0], 1.0, (len(made), 3))
    series = FieldSeries("mag", "/mag", "lidar", made.stamp_ns, field)
    options = SlamOptions(drift=DriftOptions.model_validate({"axes": request.param}))
    recording = Recording(made, (series,), SourceFile("rounds", ""))
    found, _ = prepared(recording, as_recorded(1.0), options)
    return found


def disturbed(drive: Drive, sigma: FloatArray) -> list[gtsam.Pose3]:
    rng = np.random.default_rng(5)
    return [pose.retract(sigma * rng.normal(size=6)) for pose in drive.dead_reckoning()]


def test_they_are_the_residuals_of_the_factors(drive: Drive) -> None:
    poses = disturbed(drive, np.repeat([0.02, 0.05], 3))
    errors, covariance = step_errors(drive, poses), drive.steps.covariance
    whole = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[..., None])[..., 0])
    values = pose_values(poses)
    factors = [step_factor(drive, k).error(values) for k in range(len(drive.steps))]
    np.testing.assert_allclose(0.5 * whole, factors, rtol=1e-9)


def test_where_all_headings_are_off_steps_along_fixed_axes_are_right(drive: Drive) -> None:
    """By 40 degrees, at the positions of odometry: no slip, unless steps are the vehicle's."""
    turned = gtsam.Pose3(gtsam.Rot3.Yaw(np.deg2rad(40)), np.zeros(3))
    poses = [pose.compose(turned) for pose in drive.dead_reckoning()]
    is_fixed = drive.steps.fixed_axes is not None
    assert (len(list(slips(drive, poses))) == 0) == is_fixed
    if is_fixed:
        np.testing.assert_allclose(step_errors(drive, poses), 0, atol=1e-9)


def test_a_slip_is_found_along_either_axes(drive: Drive) -> None:
    """Half a metre between two key poses, ahead of which poses are as before."""
    poses = drive.dead_reckoning()
    away = gtsam.Pose3(gtsam.Rot3(), np.array([0.5, 0.0, 0.0]))
    half = len(poses) // 2
    slipped = [*poses[:half], *(away.compose(pose) for pose in poses[half:])]
    tight = replace(drive.steps, covariance=1e-2 * drive.steps.covariance)
    (found,) = slips(replace(drive, steps=tight), slipped)
    assert found.distance_m == pytest.approx(0.5, rel=1e-3)
