"""Recording in, verdict on every sensor out; and the file that carries it."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.start.global_start import StartOptions
from l2m_gtsam.cli.tables.calibration import disagreement_note
from l2m_gtsam.data import Distortion, FieldSample, FloatArray, KnownSensor, Recording, SourceFile
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.records.calibration import CalibrationResult, SensorStatus
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.storage.known_sensors import read_known_sensors, write_known_sensors
from l2m_gtsam.storage.yaml_file import read_yaml
from tests.drives.figure_of_eight import recorded_drive
from tests.support.records import assert_equal
from tests.worlds.exact import DipoleWorld, dipole_world, random_sensors

# The sensors sit within a metre of the lidar; the exact field of many dipoles is slow.
OPTIONS = CalibrationOptions(search=StartOptions(search_radius=1.0))


@pytest.fixture(scope="module")
def world() -> DipoleWorld:
    return dipole_world(11)


@pytest.fixture(scope="module")
def sensors() -> tuple[KnownSensor, ...]:
    return random_sensors(11, 12)


@pytest.fixture(scope="module")
def mixed(world: DipoleWorld, sensors: tuple[KnownSensor, ...]) -> CalibrationResult:
    """Twelve sensors of which one is dead, one stuck, one mirrored."""
    recording = recorded_drive(world, sensors)
    series = list(recording.series)
    series[3] = replace(series[3], field=np.full_like(series[3].field, np.nan))
    series[5] = replace(series[5], field=np.full_like(series[5].field, 12.0))
    series[7] = replace(series[7], field=series[7].field * [1, -1, 1])
    source = SourceFile("map.npz", "cd34")
    return calibrate(replace(recording, series=tuple(series)), world, OPTIONS, source)


def test_a_dead_axis_is_named(world: DipoleWorld, sensors: tuple[KnownSensor, ...]) -> None:
    """One axis without signal has no polar factor worth reporting."""
    recording = recorded_drive(world, sensors[:1])
    field = recording.series[0].field.copy()
    field[:, 1] = 3.0 + 0.05 * np.sin(np.arange(len(field)))
    series = (replace(recording.series[0], field=field),)
    found = calibrate(replace(recording, series=series), world, OPTIONS)["mag_00"]
    assert found.status is SensorStatus.DEAD_AXIS
    assert "y axis does not follow the field" in found.message
    assert np.isnan(found.R_lidar_mag).all()


def test_what_planar_motion_leaves_open_is_named_in_result_and_file(
    world: DipoleWorld, tmp_path: Path
) -> None:
    """A vertical field that never varies: C's third column against H, infinite variance for it."""
    flat = DipoleWorld(world.uniform, world.positions, world.moments * 0)
    sensor = KnownSensor("m", np.zeros(3), Distortion.identity())
    recording = recorded_drive(flat, (sensor,))
    headings = np.outer(0.5 * np.arange(len(recording.trajectory)), [0, 0, 1])
    yaw = Rotation.from_rotvec(headings).as_matrix()
    b = np.einsum("nji,j->ni", yaw, flat.uniform)
    series = (replace(recording.series[0], field=b + 0.0),)
    planar = replace(recording, series=series, trajectory=replace(recording.trajectory, R=yaw))
    result = calibrate(planar, flat, OPTIONS)
    found = result["m"]
    assert found.status is SensorStatus.UNDETERMINED
    for name in ("t_x", "t_y", "t_z", "C_xz with H_x", "C_yz with H_y", "C_zz with H_z"):
        assert name in " ".join(found.undetermined)
    assert np.isinf(found.t_sigma).all()
    assert np.isinf(found.C_sigma[:, 2]).all()
    assert np.isfinite(found.C_sigma[:, :2]).all()
    rotation_sigma = np.sqrt(np.diag(found.rotation_covariance))
    assert np.isinf(rotation_sigma[:2]).all()
    assert np.isfinite(rotation_sigma[2])  # heading follows from the horizontal field alone
    write_calibration(tmp_path / "c.yaml", result)
    assert_equal(read_calibration(tmp_path / "c.yaml"), result)


def test_good_sensors_are_solved_beside_bad_ones(
    mixed: CalibrationResult, sensors: tuple[KnownSensor, ...]
) -> None:
    good = [s for s in mixed.sensors if s.status is SensorStatus.SOLVED]
    assert len(good) == 9
    for found in good:
        truth = next(s for s in sensors if s.sensor == found.sensor)
        # five sigma on 27 numbers: one false alarm in 60,000
        assert np.all(np.abs(found.t_lidar_mag - truth.t_lidar_mag) < 5 * found.t_sigma)
        assert np.linalg.norm(found.t_lidar_mag - truth.t_lidar_mag) < 0.02


def test_bad_sensors_say_what_is_wrong(mixed: CalibrationResult) -> None:
    dead, stuck, flipped = mixed["mag_03"], mixed["mag_05"], mixed["mag_07"]
    assert dead.status is SensorStatus.NO_READINGS
    assert "0 usable readings of 600 received (600 not finite" in dead.message
    assert stuck.status is SensorStatus.NO_READINGS
    assert "stuck" in stuck.message
    assert flipped.status is SensorStatus.FLIPPED_AXIS
    assert "y axis looks flipped" in flipped.message
    assert np.isnan(dead.t_lidar_mag).all()
    assert np.isinf(np.diag(dead.covariance)).all()


def test_rotation_is_the_mounting(world: DipoleWorld) -> None:
    """A sensor turned by 0.5 rad without distortion: R_lidar_mag undoes C."""
    R_mag_lidar = Rotation.from_rotvec([0.3, -0.2, 0.35]).as_matrix()
    sensor = KnownSensor("m", np.array([0.2, 0.1, -0.1]), Distortion(R_mag_lidar, np.zeros(3)))
    found = calibrate(recorded_drive(world, (sensor,)), world, OPTIONS)["m"]
    turn = Rotation.from_matrix(R_mag_lidar @ found.R_lidar_mag).as_rotvec()
    sigma = np.sqrt(np.diag(found.rotation_covariance))
    assert np.all(np.abs(turn) < 5 * sigma)
    assert np.all(sigma < 0.01)


def test_the_file_reads_back_equal(mixed: CalibrationResult, tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    doubted = replace(mixed, doubts=("the map: it does not explain the field", "- and another"))
    write_calibration(path, doubted)
    back = read_calibration(path)
    assert_equal(back, doubted)
    write_calibration(tmp_path / "again.yaml", back)
    assert (tmp_path / "again.yaml").read_bytes() == path.read_bytes()


def test_the_file_explains_itself(mixed: CalibrationResult, tmp_path: Path) -> None:
    """What an independent reader needs: formula, units, both transforms, one point in both."""
    write_calibration(tmp_path / "c.yaml", mixed)
    content = read_yaml(tmp_path / "c.yaml", CalibrationError)
    assert content["model"]["correction"] == "B_lidar = inv(C) @ (B_meas - H)"
    assert content["model"]["units"]["H"] == "uT"
    assert content["bag"] == {"path": "drive.bag", "sha256": "ab12"}
    entry = content["sensors"]["mag_00"]["transforms"]
    p_mag, p_lidar = (np.array(entry["example"][k]) for k in ("p_mag", "p_lidar"))
    forth, back = entry["T_lidar_mag"], entry["T_mag_lidar"]
    turned = Rotation.from_quat(forth["quaternion_xyzw"]).apply(p_mag) + forth["translation"]
    np.testing.assert_allclose(turned, p_lidar, atol=1e-12)
    turned = Rotation.from_quat(back["quaternion_xyzw"]).apply(p_lidar) + back["translation"]
    np.testing.assert_allclose(turned, p_mag, atol=1e-12)


def test_known_sensors_round_trip(sensors: tuple[KnownSensor, ...], tmp_path: Path) -> None:
    path = tmp_path / "truth.yaml"
    write_known_sensors(path, sensors, {"seed": 1}, "truth")
    back = read_known_sensors(path)
    for sensor in sensors:
        assert_equal(back[sensor.sensor], sensor)


def test_a_calibration_serves_as_a_suite(mixed: CalibrationResult, tmp_path: Path) -> None:
    write_calibration(tmp_path / "c.yaml", mixed)
    suite = read_known_sensors(tmp_path / "c.yaml")
    assert len(suite) == 9
    assert "mag_03" not in suite
    known = suite["mag_00"]
    np.testing.assert_array_equal(known.t_lidar_mag, mixed["mag_00"].t_lidar_mag)
    np.testing.assert_array_equal(known.distortion.C, mixed["mag_00"].distortion.C)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("sensors: {}", "sensors"),
        ("hello", "the file"),
        ("sensors: {a: {t_lidar_mag: [1, 2]}}", "sensors.a.t_lidar_mag"),
        ("sensors: {a: {t: [1, 2, 3]}}", "sensors.a.t_lidar_mag: Field required"),
        ("sensors: {a: {t_lidar_mag: [1, 2, .nan]}}", "finite number"),
        (
            "sensors: {a: {t_lidar_mag: [0, 0, 0], C: [[0, 0, 0], [0, 1, 0], [0, 0, 1]]}}",
            "C cannot be inverted",
        ),
        ("a: [1", "not valid YAML"),
        ("!!python/object/apply:os.getcwd []", "not valid YAML"),
    ],
)
def test_foreign_files_are_refused(tmp_path: Path, content: str, reason: str) -> None:
    path = tmp_path / "suite.yaml"
    path.write_text(content)
    with pytest.raises(CalibrationError, match=reason) as error:
        read_known_sensors(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


class ElsewhereWorld(DipoleWorld):
    """A map of another building."""

    def query(self, points: FloatArray) -> FieldSample:
        sample = super().query(points)
        return replace(sample, inside=np.zeros(len(points), dtype=np.bool_))


@dataclass(frozen=True)
class HallWorld(DipoleWorld):
    """A world that is known within 20 m."""

    def query(self, points: FloatArray) -> FieldSample:
        sample = super().query(points)
        return replace(sample, inside=np.linalg.norm(points, axis=1) < 20.0)


def test_a_map_of_another_place_is_named(
    world: DipoleWorld, sensors: tuple[KnownSensor, ...]
) -> None:
    elsewhere = ElsewhereWorld(world.uniform, world.positions, world.moments)
    source = SourceFile("office.npz", "0")
    recording = recorded_drive(world, sensors[:2])
    with pytest.raises(CalibrationError, match=r"office.npz does not cover the drive drive.bag"):
        calibrate(recording, elsewhere, OPTIONS, source)


def test_a_sensor_that_is_put_far_away_is_no_map_of_another_place(
    world: DipoleWorld, sensors: tuple[KnownSensor, ...]
) -> None:
    hall = HallWorld(world.uniform, world.positions, world.moments)
    options = OPTIONS.model_copy(update={"start": {sensors[0].sensor: (50.0, 0.0, 0.0)}})
    recording = recorded_drive(world, sensors[:1])
    with pytest.raises(CalibrationError) as error:
        calibrate(recording, hall, options, SourceFile("hall.npz", "0"))
    told = str(error.value)
    assert "no sensor can be solved, although hall.npz covers the drive: mag_00: " in told
    assert "lie outside the map" in told


def test_readings_that_are_all_wrong_are_no_map_of_another_place(
    world: DipoleWorld, sensors: tuple[KnownSensor, ...]
) -> None:
    recording = recorded_drive(world, sensors[:1])
    noise = np.random.default_rng(3).choice([-4800.0, 4800.0], recording.series[0].field.shape)
    series = (replace(recording.series[0], field=noise),)
    with pytest.raises(CalibrationError) as error:
        calibrate(replace(recording, series=series), world, OPTIONS)
    assert "no sensor can be solved: mag_00: none of its" in str(error.value)


def test_a_given_start_is_not_looked_for(
    world: DipoleWorld, sensors: tuple[KnownSensor, ...]
) -> None:
    a, b = sensors[:2]
    options = OPTIONS.model_copy(update={"start": {a.sensor: (0.0, 0.0, 0.0)}})
    result = calibrate(recorded_drive(world, sensors[:2]), world, options)
    assert result[a.sensor].start is None
    found = result[b.sensor].start
    assert found is not None
    assert np.linalg.norm(found.t_lidar_mag - b.t_lidar_mag) < 0.05
    assert [sensor.status for sensor in result.sensors] == [SensorStatus.SOLVED] * 2


def test_a_second_place_is_named(world: DipoleWorld, sensors: tuple[KnownSensor, ...]) -> None:
    """With a margin that no field has every second place is one too many."""
    search = StartOptions(search_radius=1.8, clear=1e6)
    result = calibrate(recorded_drive(world, sensors[:1]), world, CalibrationOptions(search=search))
    (sensor,) = result.sensors
    assert sensor.status is SensorStatus.AMBIGUOUS
    assert sensor.start is not None
    assert sensor.start.runner_up is not None
    assert f"({sensor.start.runner_up[0]:.2f}, " in sensor.message
    assert sensor.residuals is not None


def test_a_start_for_an_unknown_sensor_is_refused(
    world: DipoleWorld, sensors: tuple[KnownSensor, ...]
) -> None:
    options = CalibrationOptions(start={"mag_99": (0.0, 0.0, 0.0)})
    with pytest.raises(CalibrationError, match=r"no sensor named 'mag_99'; .* mag_00, mag_01"):
        calibrate(recorded_drive(world, sensors[:2]), world, options)


def with_change(recording: Recording, sensor: int, change: FloatArray) -> Recording:
    """Return a recording with something in uT, shape (N, 3), added to what one sensor read."""
    series = list(recording.series)
    series[sensor] = replace(series[sensor], field=series[sensor].field + change)
    return replace(recording, series=tuple(series))


def test_what_passes_by_is_named_with_time_and_place(
    world: DipoleWorld, sensors: tuple[KnownSensor, ...], tmp_path: Path
) -> None:
    """For two seconds both sensors read 25 uT more than there is."""
    recording = recorded_drive(world, sensors[:2])
    change = np.zeros((len(recording.trajectory), 3))
    change[200:240] = [15.0, 0.0, 20.0]
    for index in range(2):
        recording = with_change(recording, index, change)
    result = calibrate(recording, world, OPTIONS)
    (stretch,) = result.disagreements
    stamps, p = recording.trajectory.stamp_ns, recording.trajectory.p
    assert stretch.sensors == tuple(sensor.sensor for sensor in sensors[:2])
    assert stamps[200] <= stretch.start_ns <= stretch.end_ns <= stamps[239]
    assert stretch.size == pytest.approx(25.0, abs=0.5)
    way = float(np.linalg.norm(np.diff(p[200:240], axis=0), axis=1).sum())
    assert stretch.length == pytest.approx(way, rel=0.05)
    assert stretch.readings == sum(sensor.rejected for sensor in result.sensors)
    for sensor, truth in zip(result.sensors, sensors, strict=False):
        assert sensor.status is SensorStatus.SOLVED
        assert np.linalg.norm(sensor.t_lidar_mag - truth.t_lidar_mag) < 0.01
    note = disagreement_note(stretch)
    assert f"{stretch.readings} readings" in note
    assert f"({p[200, 0]:.1f}, {p[200, 1]:.1f})" in note
    write_calibration(tmp_path / "c.yaml", result)
    assert_equal(read_calibration(tmp_path / "c.yaml"), result)


def test_a_sensor_that_contradicts_itself_is_marked(
    world: DipoleWorld, sensors: tuple[KnownSensor, ...]
) -> None:
    recording = recorded_drive(world, sensors[:2])
    wrong = np.random.default_rng(0).random(len(recording.trajectory)) < 0.45
    noise = np.random.default_rng(1).normal(0, 30, (len(wrong), 3))
    near = OPTIONS.model_copy(
        update={"start": {sensors[1].sensor: tuple(sensors[1].t_lidar_mag.tolist())}}
    )
    result = calibrate(with_change(recording, 1, wrong[:, None] * noise), world, near)
    good, bad = result.sensors
    assert good.status is SensorStatus.SOLVED
    assert bad.status is SensorStatus.CONTRADICTED
    assert "fit no distortion" in bad.message
    assert bad.residuals is not None
    assert bad.rejected > 0.4 * (bad.residuals.readings + bad.rejected)
