"""What is known beforehand: it determines what a drive does not, is marked, and can be wrong."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.cli.tables.calibration import status_lines
from l2m_gtsam.config import load_config
from l2m_gtsam.data import Distortion, FieldSeries, FloatArray, KnownSensor, Recording, SourceFile
from l2m_gtsam.errors import CalibrationError, ConfigError
from l2m_gtsam.planning.motion import PlanOptions
from l2m_gtsam.planning.plan import plan
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration, SensorStatus
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from tests.drives.degenerate import NOISE, POSTS, STRONG, UNIFORM, World, eight

PLANAR = eight(0, 0)
T = np.array([0.2, -0.1, 0.15])
HEIGHT_SIGMA, TURN_DEG, STRETCH = 0.005, 2.0, 0.05


def read(sensors: list[KnownSensor], world: World, seed: int = 0, drive: Any = PLANAR) -> Recording:
    """Return what sensors read on a drive, with noise."""
    rng, series = np.random.default_rng(seed), []
    for sensor in sensors:
        x = drive.R @ sensor.t_lidar_mag + drive.p
        b = np.einsum("nji,nj->ni", drive.R, world.field_and_gradient(x)[0])
        field = sensor.distortion.apply(b) + rng.normal(0, NOISE, b.shape)
        series.append(FieldSeries(sensor.sensor, "/m", "m", drive.stamp_ns, field))
    return Recording(drive, tuple(series), SourceFile("drive.bag", "ab12"))


def options(sensors: list[KnownSensor], priors: dict[str, Any]) -> CalibrationOptions:
    """Sensors start where they are: what is asked is what is known, not the search."""
    return CalibrationOptions.model_validate(
        {
            "start": {each.sensor: each.t_lidar_mag.tolist() for each in sensors},
            "solve": {"sensor_noise_ut": NOISE},
            "priors": priors,
        }
    )


def nearly(R_mag_lidar: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return a distortion as the default prior about a rotation expects it, shape (3, 3)."""
    w, E = rng.normal(0, np.deg2rad(TURN_DEG), 3), rng.normal(0, STRETCH, (3, 3))
    return np.asarray((np.eye(3) + E + np.cross(np.eye(3), w)) @ R_mag_lidar)


def rotation(R_mag_lidar: FloatArray) -> dict[str, Any]:
    return {"quaternion_xyzw": Rotation.from_matrix(R_mag_lidar.T).as_quat().tolist()}


def errors(sensor: SensorCalibration, truth: KnownSensor) -> FloatArray:
    return sensor.vector() - truth.vector()


def drawn(seed: int) -> tuple[KnownSensor, dict[str, Any]]:
    """Return a sensor drawn from its priors: a measured height and a nominal rotation."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=rng).as_matrix()
    truth = KnownSensor("mag_0", T, Distortion(nearly(R, rng), rng.normal(0, 10, 3)))
    height = [T[2] + rng.normal(0, HEIGHT_SIGMA), HEIGHT_SIGMA]
    return truth, {"position": {"mag_*": {"z": height}}, "rotation": {"mag_0": rotation(R)}}


@pytest.mark.parametrize("seeds", [4, pytest.param(24, marks=pytest.mark.study)])
def test_a_planar_drive_is_solved_with_a_height_and_a_rotation(seeds: int) -> None:
    """True within its sigmas over seeds, and what came from where is marked, before and after."""
    nees = []
    for seed in range(seeds):
        truth, priors = drawn(seed)
        recording, chosen = read([truth], POSTS, seed), options([truth], priors)
        (found,) = calibrate(recording, POSTS, chosen).sensors
        assert found.status is SensorStatus.SOLVED
        assert found.undetermined == ()
        expected = (
            "t_z (measured height)",
            "C_xz, C_yz, C_zz, H_x, H_y, H_z (nominal rotation)",
        )
        assert set(found.from_priors) == set(expected)
        error = errors(found, truth)
        nees.append(error @ np.linalg.solve(found.covariance, error))
    before = plan(recording, POSTS, chosen, PlanOptions())["mag_0"]
    assert set(before.from_priors) == set(expected)
    assert before.undetermined == ()
    np.testing.assert_allclose(before.sigma[2], HEIGHT_SIGMA, rtol=1e-3)
    # The mean of chi-squared values with 15 degrees of freedom, three of its sigmas either way.
    assert abs(np.mean(nees) - 15) < 3 * np.sqrt(2 * 15 / seeds)


def test_without_priors_the_same_is_open() -> None:
    truth, _ = drawn(0)
    (found,) = calibrate(read([truth], POSTS), POSTS, options([truth], {})).sensors
    assert found.status is SensorStatus.UNDETERMINED
    assert found.from_priors == ()


def test_what_readings_determine_is_not_marked() -> None:
    """A drive that determines all: priors are used, but nothing is theirs alone."""
    truth, priors = drawn(1)
    (found,) = calibrate(
        read([truth], STRONG, drive=eight()), STRONG, options([truth], priors)
    ).sensors
    assert found.status is SensorStatus.SOLVED
    assert found.from_priors == ()
    assert found.t_sigma[2] < HEIGHT_SIGMA


def array(count: int, world_seed: int = 3) -> list[KnownSensor]:
    """Return sensors of an array, each a little distorted."""
    rng = np.random.default_rng(world_seed)
    places = T + np.concatenate([np.zeros((1, 3)), rng.uniform(-0.3, 0.3, (count - 1, 3))])
    return [
        KnownSensor(f"mag_{i}", t, Distortion(nearly(np.eye(3), rng), rng.normal(0, 10, 3)))
        for i, t in enumerate(places)
    ]


def vector(first: KnownSensor, second: KnownSensor, **more: Any) -> dict[str, Any]:
    between = (second.t_lidar_mag - first.t_lidar_mag).tolist()
    return {"from": first.sensor, "to": second.sensor, "vector": between, **more}


def test_a_height_reaches_along_a_chain_of_baselines() -> None:
    """In a field that is the same at all heights one measured height gives those of an array."""
    sensors = array(3)
    chain = [vector(a, b) for a, b in pairwise(sensors)]
    priors = {
        "position": {"mag_0": {"z": [T[2], HEIGHT_SIGMA]}},
        "rotation": {"mag_*": rotation(np.eye(3))},
        "array": {"baselines": chain},
    }
    found = calibrate(read(sensors, POSTS), POSTS, options(sensors, priors))
    for index, (sensor, truth) in enumerate(zip(found.sensors, sensors, strict=True)):
        assert sensor.status is SensorStatus.SOLVED
        # Only heights come that way: sigmas of the height and of every link add up.
        expected = np.hypot(HEIGHT_SIGMA, 0.002 * np.sqrt(index))
        assert sensor.t_sigma[2] == pytest.approx(expected, rel=1e-3)
        assert np.abs(errors(sensor, truth)[:3] / sensor.t_sigma).max() < 5
    assert "t_z (measured height)" in found["mag_0"].from_priors
    assert "t_z (measured height and baseline)" in found["mag_2"].from_priors


def test_a_baseline_alone_gives_no_place() -> None:
    """Two sensors neither of which is told in height, one above the other: still open."""
    sensors = array(2)
    priors = {"array": {"baselines": [vector(*sensors)]}}
    for sensor in calibrate(read(sensors, POSTS), POSTS, options(sensors, priors)).sensors:
        assert sensor.status is SensorStatus.UNDETERMINED
        assert "t_z" in " ".join(sensor.undetermined)


def test_a_planar_mount_hands_a_height_on() -> None:
    sensors = [
        KnownSensor(each.sensor, np.append(each.t_lidar_mag[:2], T[2]), each.distortion)
        for each in array(3)
    ]
    priors = {
        "position": {"mag_1": {"z": [T[2], HEIGHT_SIGMA]}},
        "rotation": {"mag_*": rotation(np.eye(3))},
        "planar": [{"sensors": ["mag_*"], "sigma_m": 0.002}],
    }
    found = calibrate(read(sensors, POSTS), POSTS, options(sensors, priors))
    for name in ("mag_0", "mag_2"):
        assert found[name].status is SensorStatus.SOLVED
        # Each is off the plane by its own 2 mm, so is the one that was measured.
        expected = np.sqrt(HEIGHT_SIGMA**2 + 2 * 0.002**2)
        assert found[name].t_sigma[2] == pytest.approx(expected, rel=1e-3)
        assert "t_z (measured height and planar mount)" in found[name].from_priors


def test_a_distance_sharpens_what_two_places_leave() -> None:
    """Both are told; along the line between them the distance is far better than the readings."""
    sensors = array(2)
    apart = sensors[1].t_lidar_mag - sensors[0].t_lidar_mag
    length = float(np.linalg.norm(apart))
    known = {"from": "mag_0", "to": "mag_1", "distance": length, "sigma_m": 1e-4}
    recording = read(sensors, STRONG, drive=eight())
    alone = calibrate(recording, STRONG, options(sensors, {}))
    found = calibrate(recording, STRONG, options(sensors, {"array": {"baselines": [known]}}))
    missed = [
        np.linalg.norm(each["mag_1"].t_lidar_mag - each["mag_0"].t_lidar_mag) - length
        for each in (alone, found)
    ]
    assert abs(missed[1]) < 5e-4 < abs(missed[0])
    assert (found["mag_0"].t_sigma < alone["mag_0"].t_sigma).any()


@pytest.mark.parametrize("world", [STRONG, UNIFORM])
def test_a_wrong_height_is_named_where_readings_speak_against_it(world: World) -> None:
    """Ten sigmas off: a strong field says so; a uniform one cannot, and the mark stays."""
    truth, priors = drawn(2)
    told = T + np.array([0.0, 0.0, 10 * HEIGHT_SIGMA])
    priors["position"] = {
        "mag_0": {axis: [value, HEIGHT_SIGMA] for axis, value in zip("xyz", told, strict=True)}
    }
    (found,) = calibrate(
        read([truth], world, drive=eight()), world, options([truth], priors)
    ).sensors
    if world is STRONG:
        assert found.status is SensorStatus.CONTRADICTED
        assert "its measured height contradicts the readings by" in found.message
    else:
        assert found.status is SensorStatus.SOLVED
        assert "t_z (measured height)" in found.from_priors


def test_a_wrong_baseline_is_named_at_both_ends() -> None:
    sensors = array(3)
    wrong = vector(*sensors[:2])
    wrong["vector"][0] += 0.05
    found = calibrate(
        read(sensors, STRONG, drive=eight()),
        STRONG,
        options(sensors, {"array": {"baselines": [wrong]}}),
    )
    for name, other in (("mag_0", "mag_1"), ("mag_1", "mag_0")):
        assert found[name].status is SensorStatus.CONTRADICTED
        assert f"its baseline with {other} contradicts the readings" in found[name].message
    assert found["mag_2"].status is SensorStatus.SOLVED


def test_marks_are_in_the_file_and_beneath_the_table(tmp_path: Path) -> None:
    truth, priors = drawn(3)
    found = calibrate(read([truth], POSTS), POSTS, options([truth], priors))
    write_calibration(tmp_path / "calibration.yaml", found)
    again: CalibrationResult = read_calibration(tmp_path / "calibration.yaml")
    assert again["mag_0"].from_priors == found["mag_0"].from_priors != ()
    (line,) = status_lines(found)
    assert "from priors: " in line
    assert "t_z (measured height)" in line


BAD = {
    "position: {mag_9: {z: [0.1, 0.01]}}": "no sensor named 'mag_9'; the recording has mag",
    "array: {baselines: [{from: mag_0, to: mag_7, distance: 1}]}": "no sensor named 'mag_7'",
    "planar: [{sensors: [mag_0]}]": "mag_0 is one sensor; a plane takes two or more",
    "position: {mag_0: {z: [0.1, 0.01]}, 'mag_*': {z: [0.2, 0.01]}}": "both speak of 'mag_0'",
}
MALFORMED = {
    "array: {baselines: [{from: a, to: b}]}": "give either `vector` or `distance`",
    "array: {baselines: [{from: a, to: a, distance: 1}]}": "no baseline to itself",
    "array: {baselines: [{from: a, to: b, length: 1}]}": "unknown key .*accepted here: distance",
    "rotation: {a: {quaternion_xyzw: [0, 0, 0, 2]}}": "must have length 1, this one has 2",
    "rotation: {a: {quaternion: [0, 0, 0, 1]}}": "unknown key|Field required",
    "position: {a: {z: [0.1, 0]}}": "greater than 0",
    "position: {a: {w: [0.1, 1]}}": "'x', 'y' or 'z'",
}


def configured(tmp_path: Path, priors: str) -> CalibrationOptions:
    path = tmp_path / "config.yaml"
    path.write_text(f"calibration:\n  priors: {{{priors}}}\n")
    return load_config(path).calibration


@pytest.mark.parametrize("priors", BAD)
def test_names_are_those_of_the_recording(tmp_path: Path, priors: str) -> None:
    sensors = array(2)
    chosen = configured(tmp_path, priors).model_copy(update={"solve": OneKeyOptions()})
    for use in (
        lambda r: calibrate(r, POSTS, chosen),
        lambda r: plan(r, POSTS, chosen, PlanOptions()),
    ):
        with pytest.raises(CalibrationError, match=BAD[priors].replace("*", r"\*")):
            use(read(sensors, POSTS))


@pytest.mark.parametrize("priors", MALFORMED)
def test_malformed_priors_are_refused_in_one_line(tmp_path: Path, priors: str) -> None:
    with pytest.raises(ConfigError, match=MALFORMED[priors]) as caught:
        configured(tmp_path, priors)
    assert "\n" not in str(caught.value)
