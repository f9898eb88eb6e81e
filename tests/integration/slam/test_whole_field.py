"""One field for a drive with one sensor: a recorded model ship, drifted as published."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import SourceFile, Trajectory
from l2m_gtsam.progress import silent
from l2m_gtsam.slam.exploration import NOTHING_GAINED, explore, field_samples
from l2m_gtsam.slam.localisation import Localisation
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.studies.slam.methods import as_recorded, odometry_row, our_row, rms, stated_drift
from l2m_gtsam.studies.slam.recordings import SHIP, DriftRecipe, Form, TrueDrive, drifted, ship_run
from tests.worlds.yard import NOISE as YARD_NOISE_UT
from tests.worlds.yard import route, world

NOISE_UT = 1.5
SEED, STATED_UT = 3, 5.0


@pytest.mark.study
@pytest.mark.parametrize("form", list(Form))
@pytest.mark.parametrize("run", [1, 2])
def test_most_of_a_ships_drift_goes_and_sigmas_are_right(
    shared_data: Path, run: int, form: Form
) -> None:
    """At a seed at which nothing was chosen. One drive scatters: NEES is 6 in the mean."""
    drive = ship_run(shared_data / SHIP, run)
    odometry = drifted(drive.truth, DriftRecipe(), form, SEED)
    options = stated_drift(drive.truth, DriftRecipe(), form)
    found, rows = our_row(drive, odometry, options, STATED_UT)
    assert not found.unchanged
    assert found.rms_m <= 0.25 * odometry_row(drive, odometry, rows).rms_m
    assert found.nees is not None
    assert 3 <= found.nees <= 12


def test_without_a_field_the_poses_are_those_of_odometry(shared_data: Path) -> None:
    """Readings of noise alone, the same field everywhere: nothing tells one place from another."""
    drive, rng = ship_run(shared_data / SHIP, 2), np.random.default_rng(1)
    truth = drive.truth[np.arange(round(0.2 * len(drive.truth)))]
    uniform = truth.R.transpose(0, 2, 1) @ np.array([20.0, 0.0, -40.0])
    flat = replace(drive, truth=truth, field=uniform + rng.normal(0, NOISE_UT, uniform.shape))
    odometry = drifted(truth, DriftRecipe(), Form.VEHICLE, 0)
    # What the recipe's errors come to over 10 m, or 75 steps, and few readings.
    drift = {"position_share": 0.0225, "rotation_deg_per_m": 0.16}
    options = SlamOptions.model_validate({"drift": drift, "key_poses": {"readings": 2}})
    result = explore(flat.recording(odometry), as_recorded(NOISE_UT), options, silent).result
    at = truth.p[np.searchsorted(truth.stamp_ns, result.trajectory.stamp_ns)]
    assert rms(result.trajectory.p, at) <= 1.05 * rms(result.odometry.p, at)


def yard_drive(noise_ut: float) -> Localisation:
    """A meander beside a steel post, whose odometry is right and whose noise is stated so."""
    p = route(-2, 0.5)[:160]
    R = Rotation.from_rotvec(np.outer(np.linspace(0, 5, len(p)), [0, 0, 1])).as_matrix()
    stamps = 100_000_000 * np.arange(len(p), dtype=np.int64)
    rng = np.random.default_rng(4)
    field = np.einsum("nji,nj->ni", R, world().field_and_gradient(p)[0])
    field += rng.normal(0, YARD_NOISE_UT, field.shape)
    drive = TrueDrive(Trajectory(stamps, R, p, "map", "lidar"), field, SourceFile("yard", ""))
    options = SlamOptions.model_validate(
        {"key_poses": {"distance_m": 0.5, "angle_deg": 30, "readings": 4}}
    )
    return explore(drive.recording(drive.truth), as_recorded(noise_ut), options, silent)


def test_the_stated_noise_does_not_count_and_the_field_is_the_true_one() -> None:
    """Where odometry is kept, its field is that at odometry's poses, by the given calibration."""
    one, other = yard_drive(0.02), yard_drive(5.0)
    assert any(NOTHING_GAINED in note for note in one.result.notes)
    np.testing.assert_array_equal(one.result.trajectory.p, other.result.trajectory.p)
    points, field = field_samples(one.solution)
    np.testing.assert_array_equal(field, field_samples(other.solution)[1])
    truth = world().field_and_gradient(points)[0]
    # Noise, and positions of readings that are interpolated over half a metre of the meander.
    assert np.sqrt(np.mean((field - truth) ** 2)) < 2 * YARD_NOISE_UT
