"""The 3-D view: what is put in, read back from the file by Rerun's own reader."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.calibrate import Calibrated, calibrated
from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import OutputError
from l2m_gtsam.qa.scene import drive_views, scene_of
from l2m_gtsam.records.scene import Scene
from l2m_gtsam.storage import rerun_file
from l2m_gtsam.storage.rerun_file import arrow_scale, ellipsoid, write_scene
from tests.drives.verdict import NOISE, SENSORS, Drive, loose


@pytest.fixture(scope="module")
def drive() -> Drive:
    return loose()


@pytest.fixture(scope="module")
def found(drive: Drive) -> Calibrated:
    return calibrated(drive.recording, drive.field_map, drive.options)


@pytest.fixture(scope="module")
def scene(drive: Drive, found: Calibrated) -> Scene:
    return scene_of(drive.recording, found)


def column(path: Path, entity: str, name: str) -> FloatArray:
    """Return one component of one entity as Rerun reads it."""
    from rerun.chunk import RrdReader

    for chunk in RrdReader(str(path)).stream().to_chunks():
        batch: Any = chunk.to_record_batch()
        if chunk.entity_path == entity and name in batch.schema.names:
            return np.array([row for cell in batch[name].to_pylist() for row in cell], dtype=float)
    raise AssertionError(f"{entity} {name} is not in the file")


def test_misfits_show_which_sensor_came_loose(scene: Scene) -> None:
    spread = {each.sensor: each.misfit[~each.rejected].std() for each in scene.sensors}
    moved = spread.pop("mag_1")
    # The map is exact: sound sensors fit to their noise, up to scales within a fifth of one.
    assert all(0.8 * NOISE < each < 1.25 * NOISE for each in spread.values())
    assert moved > 2 * NOISE


def test_sensors_stand_along_the_drive(scene: Scene, drive: Drive) -> None:
    path, known = drive.recording.trajectory, {each.sensor: each for each in SENSORS}
    for each in scene.sensors:
        reach = float(np.linalg.norm(known[each.sensor].t_lidar_mag)) + 0.1
        apart = np.linalg.norm(each.place[:, None] - path.p, axis=2).min(axis=1)
        assert apart.max() < reach


def test_rerun_reads_back_what_was_written(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "view.rrd"
    write_scene(path, scene)
    sensor = scene.sensors[0]
    arrows = column(path, f"/misfit/{sensor.sensor}", "Arrows3D:vectors")
    expected = arrow_scale(scene.sensors) * sensor.misfit[~sensor.rejected]
    np.testing.assert_allclose(arrows, expected, atol=1e-6)  # stored in single precision
    poses = column(path, "/lidar", "Transform3D:translation")
    np.testing.assert_allclose(poses, scene.drives[0].p, atol=1e-5)
    turns = Rotation.from_quat(column(path, "/lidar", "Transform3D:quaternion"))
    assert (turns.inv() * Rotation.from_matrix(scene.drives[0].R)).magnitude().max() < 1e-5
    at = column(path, f"/lidar/{sensor.sensor}", "Points3D:positions")
    np.testing.assert_allclose(at[0], sensor.t_lidar_mag, atol=1e-6)
    assert [each.name for each in tmp_path.iterdir()] == ["view.rrd"]


def test_no_path_is_drawn_between_drives(drive: Drive) -> None:
    one = drive.recording.trajectory
    first, second = drive_views([one, one])
    np.testing.assert_array_equal(first.p, second.p)
    assert second.seconds[0] > first.seconds[-1]


@given(st.integers(0, 10_000))
def test_the_ellipsoid_has_the_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(3, 3))
    half, quaternion = ellipsoid(A @ A.T)
    R = Rotation.from_quat(quaternion).as_matrix()
    np.testing.assert_allclose(R @ np.diag((half / rerun_file.WITHIN) ** 2) @ R.T, A @ A.T)


def test_without_rerun_the_extra_is_named(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rerun_file, "find_spec", lambda name: None)
    with pytest.raises(OutputError, match=r"l2m-gtsam\[viewer\]"):
        write_scene(tmp_path / "view.rrd", scene)
    assert not list(tmp_path.iterdir())
