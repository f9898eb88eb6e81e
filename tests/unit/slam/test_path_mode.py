"""The likeliest path of a drive in one field."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import WaveBasis
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.slam.drive import EXACT_START, Drive
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.map_prediction import poses_in
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.pose_graph import drive_graph, drive_values
from l2m_gtsam.slam.unknown_field.path_information import PathNeighbourhood
from l2m_gtsam.slam.unknown_field.path_mode import likeliest_errors
from l2m_gtsam.slam.unknown_field.sensor_noise import WhiteInformation
from l2m_gtsam.slam.unknown_field.wave_prior import box_about, learnt_waves
from tests.drives.slam import calibrated, rounds, slam_drive
from tests.worlds.exact import dipole_world, random_sensors


@pytest.fixture(scope="module", params=[{"steady": 0.01}, {"steady": 0.0, "scale": 0.01}, {}])
def near(request: pytest.FixtureRequest) -> tuple[Drive, PathNeighbourhood]:
    """A drive whose odometry has a steady drift, a scale, or neither."""
    sensors = random_sensors(3, 2)
    recorded = slam_drive(dipole_world(1), sensors, rounds(20.0), np.random.default_rng(3))
    options = SlamOptions.model_validate(
        {"key_poses": {"distance_m": 0.4, "readings": 1}, "drift": request.param}
    )
    sigma = np.concatenate([np.full(3, 1e-6), np.full(9, 0.003), np.full(3, 0.1)])
    found, _ = prepared(recorded.recording, calibrated(sensors, sigma=sigma), options)
    drive = replace(found, start=replace(found.start, covariance=EXACT_START))
    poses = drive.dead_reckoning()
    basis = WaveBasis.over(box_about(drive, poses), Resolution(3.0, 2.0))
    prior = learnt_waves(drive, poses, basis)
    noise = WhiteInformation(prior.noise[drive.readings.sensor] ** 2)
    return drive, PathNeighbourhood(drive, poses, drive_values(drive, poses), prior.field, noise)


def total(near: PathNeighbourhood, already: FloatArray, errors: FloatArray) -> float:
    return near.density_at(errors).cost + 0.5 * float(np.sum((already + errors) ** 2))


def test_at_the_mode_readings_and_odometry_pull_alike(
    near: tuple[Drive, PathNeighbourhood],
) -> None:
    drive, density = near
    already = density.errors_from(drive.sensors)
    found = likeliest_errors(density, already, 300)
    begun = np.linalg.norm(density.slopes(np.zeros(density.size)) + already)
    left = np.linalg.norm(density.slopes(found) + already + found)
    assert left < 1e-2 * begun  # the search ends where its cost no longer falls, not its slope
    here = total(density, already, found)
    assert here < total(density, already, np.zeros(density.size)) - 1
    for v in np.random.default_rng(1).normal(size=(5, density.size)):
        assert total(density, already, found + 0.05 * v) > here


def test_errors_are_those_of_the_graph(near: tuple[Drive, PathNeighbourhood]) -> None:
    """Half their square is the graph's error at the poses that they lead to, to second order."""
    drive, density = near
    errors = 0.1 * np.random.default_rng(2).normal(size=density.size)
    errors[-density.sensors.size :] = 0.0
    values = density.moved_values(errors)
    graph, already = drive_graph(drive), density.errors_from(drive.sensors)
    assert graph.error(values) == pytest.approx(0.5 * np.sum((already + errors) ** 2), rel=0.02)
    moved, sensors = density.moved_by(errors[:, None])
    for pose, before, d in zip(
        poses_in(values, len(drive)), drive.dead_reckoning(), moved[:, :, 0], strict=True
    ):
        assert before.retract(d).equals(pose, 1e-9)
    np.testing.assert_array_equal(sensors, 0.0)
