"""Drives through unknown fields, localised message by message."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.replay import give, messages
from l2m_gtsam.slam.online.saved import resumed_slam, saved_state
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.explorer import Explorer
from tests.drives.online import driven
from tests.drives.slam import COARSE, calibrated, laps, slam_drive
from tests.worlds.exact import dipole_world, random_sensors


def test_without_a_map_it_is_the_explorer_and_it_resumes() -> None:
    """Two laps of 10 m: what comes out is what the same key poses give at once, resumed or not."""
    options = SlamOptions.model_validate(
        {
            "key_poses": {"distance_m": 0.3, "readings": 2},
            "tiles": {"modes": 60, "learn_over_m": 9.0},
        }
    )
    sensors = random_sensors(3, 6)
    recorded = slam_drive(dipole_world(3), sensors, laps(36, (1.9, 1.4)), np.random.default_rng(3))
    given = list(messages(recorded.recording))
    plain = OnlineSlam(calibrated(sensors), options)
    whole = driven(plain, given)
    assert whole.kinds == [EventKind.FIELD_LEARNT]
    odometry = recorded.recording.trajectory
    rows = np.searchsorted(odometry.stamp_ns, whole.trajectory().stamp_ns)
    drift = np.linalg.norm(odometry.p[rows] - recorded.truth.p[rows], axis=1)
    last = len(rows) // 3
    off = whole.off(recorded.truth)
    assert np.sqrt(np.mean(off[-last:] ** 2)) < 0.5 * np.sqrt(np.mean(drift[-last:] ** 2))
    assert whole.nees(recorded.truth)[1:].mean() < 12
    points, field = explored_field(plain)
    truth = dipole_world(3).field_and_gradient(points)[0]
    assert np.sqrt(np.mean((field - truth) ** 2)) < 1.0
    for at in (len(given) // 5, 2 * len(given) // 3):  # before the field is learnt, and after
        slam = OnlineSlam(calibrated(sensors), options)
        for message in given[:at]:
            give(slam, message)
        slam = resumed_slam(saved_state(slam), calibrated(sensors), options)
        run = driven(slam, given[at:])
        rows = np.searchsorted(whole.trajectory().stamp_ns, run.trajectory().stamp_ns)
        if EventKind.FIELD_LEARNT in run.kinds:
            np.testing.assert_allclose(run.trajectory().p, whole.trajectory().p[rows], atol=1e-9)
        # Sections begin elsewhere: poses stay linearised where these closed.
        errors = (np.sqrt(np.mean(each**2)) for each in (run.off(recorded.truth), off[rows]))
        assert next(errors) < 1.5 * next(errors)
        assert run.nees(recorded.truth).mean() < 12


def test_one_sensor_in_an_unknown_field_is_reported_at_once() -> None:
    """On a recorded ship such poses end further off than odometry's: docs/studies/slam."""
    sensors = random_sensors(2, 1)
    recorded = slam_drive(dipole_world(2), sensors, laps(3, (1.9, 1.4)), np.random.default_rng(2))
    slam = OnlineSlam(calibrated(sensors), SlamOptions.model_validate({"key_poses": COARSE}))
    for message in messages(recorded.recording):
        give(slam, message)
    (event,) = slam.events()
    assert event.kind is EventKind.ONE_SENSOR
    assert "localise the recorded drive off line" in event.text


def explored_field(slam: OnlineSlam) -> tuple[FloatArray, FloatArray]:
    assert isinstance(slam.estimator, Explorer)
    return slam.estimator.field_along_path()
