"""The peers of the studies: right where their assumptions hold, one line where they cannot run."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, KnownSensor, LidarMotion, Readings
from l2m_gtsam.errors import MapError, PeerError
from l2m_gtsam.studies.magyc_peer import magyc_peer, magyc_python
from l2m_gtsam.studies.naive_peer import NaiveOptions, naive_map, naive_peer
from tests.worlds.exact import DipoleWorld, drive, random_sensors

NOISE = 0.05  # uT, of surveys and drives
EARTH = np.array([22.0, 3.0, -38.0])
OPTIONS = NaiveOptions(reach=1.0, spacing=0.01, places=500, learning=200, readings=60)


def smooth_world() -> DipoleWorld:
    """Twelve strong dipoles 3 m off: waves much longer than the survey's spacing."""
    rng = np.random.default_rng(3)
    positions = rng.uniform([-5, -5, 0], [5, 5, 1], (12, 3))
    positions[:, 2] = np.where(np.arange(12) % 2 == 0, -3.0, 4.0)
    return DipoleWorld(EARTH, positions, rng.normal(0, 600, (12, 3)))


def survey(world: DipoleWorld, count: int = 500) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(0)
    points = rng.uniform([-5, -5, -0.4], [5, 5, 1.4], (count, 3))
    field, _ = world.field_and_gradient(points)
    return points, field + rng.normal(0, NOISE, field.shape)


def turning(seed: int, sensor: KnownSensor, rate: float = 20.0) -> tuple[Readings, FloatArray]:
    """A minute of turning through all attitudes at one place, in a uniform field.

    And the rotation from the lidar to the sensor.
    """
    rng = np.random.default_rng(seed)
    seconds = np.arange(int(60 * rate)) / rate
    now, before, after = (attitude_at(seconds + shift) for shift in (0.0, -1e-4, 1e-4))
    turn_rate = (before.inv() * after).as_rotvec() / 2e-4
    R = now.as_matrix()
    field = sensor.distortion.apply(np.einsum("nji,j->ni", R, EARTH))
    count = len(seconds)
    readings = Readings(
        (sensor.sensor,),
        np.zeros(count, np.int64),
        (seconds * 1e9).round().astype(np.int64),
        R,
        np.zeros((count, 3)),
        field + rng.normal(0, NOISE, field.shape),
        LidarMotion.steady(np.column_stack([turn_rate, np.zeros((count, 3))])),
    )
    return readings, polar(sensor.distortion.C)[0]


def attitude_at(seconds: FloatArray) -> Rotation:
    """Three turns at once, with periods that have no common multiple within a minute."""
    angles = np.array([0.61, 0.37, 0.23])[None] * seconds[:, None]
    return Rotation.from_euler("ZYX", angles)


def test_the_naive_peer_finds_a_sensor_on_easy_ground() -> None:
    world, sensors = smooth_world(), random_sensors(2, 1)
    readings = drive(2, sensors, world, noise=NOISE)
    field_map = naive_map(*survey(world), readings.p_map_lidar, OPTIONS)
    truth = sensors[0]
    end = naive_peer(readings, field_map, OPTIONS, truth.t_lidar_mag + 0.15)
    found = Distortion.from_vector(end[3:])
    # 60 readings of noise 0.05 uT in gradients of 1 uT/m tell t to 6 mm, five of which are allowed
    # for; C and H to what that moves the field by, C relative to its 44 uT, H in height alone.
    np.testing.assert_allclose(end[:3], truth.t_lidar_mag, rtol=0, atol=0.03)
    np.testing.assert_allclose(found.C, truth.distortion.C, rtol=0, atol=0.01)
    np.testing.assert_allclose(found.H, truth.distortion.H, rtol=0, atol=0.3)


def test_the_naive_map_takes_survey_near_the_drive_only() -> None:
    points, field = survey(smooth_world())
    path = np.zeros((1, 3))
    near = np.linalg.norm(points, axis=1) <= 2.0
    options = OPTIONS.model_copy(update={"reach": 2.0, "spacing": 0.01})
    assert naive_map(points, field, path, options).places == np.count_nonzero(near) > 20
    cubes = len(np.unique(np.floor(points[near] / 0.8), axis=0))
    coarse = options.model_copy(update={"spacing": 0.8})
    assert naive_map(points, field, path, coarse).places == cubes
    few = options.model_copy(update={"places": 21})
    assert naive_map(points, field, path, few).places == 21


def test_too_little_survey_near_the_drive_is_one_line() -> None:
    points, field = survey(smooth_world())
    with pytest.raises(MapError, match=r"^naive peer: 0 of 500 survey readings .* wider reach$"):
        naive_map(points, field, np.full((1, 3), 50.0), OPTIONS)


def test_a_missing_scikit_learn_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.gaussian_process", None)
    points, field = survey(smooth_world())
    with pytest.raises(PeerError, match=r"^the naive peer needs .*l2m-gtsam\[studies\]'$"):
        naive_map(points, field, points, OPTIONS)


@pytest.fixture(scope="module")
def python_of_magyc(repository: Path) -> Path:
    python = Path(os.environ.get("L2M_MAGYC_PYTHON", repository / ".venv-magyc/bin/python"))
    if not python.is_file():
        reason = f"no magyc at {python}: `make magyc` makes its environment"
        if os.environ.get("L2M_REQUIRE_MAGYC") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return python


def test_magyc_finds_the_offset_in_a_uniform_field(python_of_magyc: Path) -> None:
    sensors = random_sensors(5, 3)
    for seed, sensor in enumerate(sensors):
        found = magyc_peer(*turning(seed, sensor), python_of_magyc)
        # It differences readings backwards, so that its rates are half of 50 ms late: at 0.8 rad/s
        # 2 % of 44 uT, 0.8 uT, in directions that turn. A quarter of it is left for what stays.
        np.testing.assert_allclose(found.H, sensor.distortion.H, rtol=0, atol=0.2)
        assert found.seconds > 0


def test_magyc_without_a_result_says_nan(python_of_magyc: Path) -> None:
    readings, R_mag_lidar = turning(0, random_sensors(5, 1)[0])
    nothing = replace(readings, field=np.full_like(readings.field, np.nan))
    assert np.isnan(magyc_peer(nothing, R_mag_lidar, python_of_magyc).H).all()


def test_readings_without_motion_are_one_line() -> None:
    readings, R_mag_lidar = turning(0, random_sensors(5, 1)[0], rate=1.0)
    with pytest.raises(PeerError, match=r"^magyc needs turn rates: the readings have no motion$"):
        magyc_peer(replace(readings, motion=None), R_mag_lidar, Path(sys.executable))


def test_an_environment_without_magyc_is_one_line() -> None:
    chip = turning(0, random_sensors(5, 1)[0], rate=1.0)
    # The environment of the tests is one: magyc cannot be installed beside what we need.
    with pytest.raises(PeerError, match=r"^magyc does not run .* No module named 'magyc'; .*$"):
        magyc_peer(*chip, Path(sys.executable))


def test_no_environment_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("L2M_MAGYC_PYTHON", str(tmp_path / "python"))
    with pytest.raises(PeerError, match=r"^magyc has no environment at .*python: run `make magyc`"):
        magyc_python()
    (tmp_path / "python").touch()
    assert magyc_python() == tmp_path / "python"
