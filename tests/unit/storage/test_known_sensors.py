"""How well a sensor in a file is known, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.storage.known_sensors import read_known_sensors
from l2m_gtsam.storage.yaml_file import write_yaml

PLACE = {"t_lidar_mag": [0.1, 0.2, 0.3]}


def read(folder: Path, **entry: Any) -> np.ndarray[Any, Any] | None:
    path = folder / "suite.yaml"
    write_yaml(path, {"sensors": {"mag": {**PLACE, **entry}}}, "a suite")
    return read_known_sensors(path)["mag"].covariance


def test_a_sensor_without_sigmas_is_exact(tmp_path: Path) -> None:
    assert read(tmp_path) is None


def test_sigmas_stand_for_a_covariance(tmp_path: Path) -> None:
    found = read(tmp_path, t_sigma=0.003, H_sigma=[0.1, 0.2, 0.3], time_offset={"sigma": 0.01})
    assert found is not None
    expected = np.concatenate([[0.003] * 3, [0.0] * 9, [0.1, 0.2, 0.3], [0.01]])
    np.testing.assert_allclose(np.sqrt(np.diag(found)), expected)
    assert np.count_nonzero(found) == 7


def test_a_covariance_goes_before_sigmas(tmp_path: Path) -> None:
    root = np.tril(np.random.default_rng(0).normal(size=(15, 15)))
    covariance, cross = root @ root.T, 0.001 * root[:, 0]
    clock = {"seconds": 0.02, "sigma": 0.1, "cross_covariance": cross.tolist()}
    found = read(tmp_path, covariance=covariance.tolist(), t_sigma=[0.0] * 3, time_offset=clock)
    assert found is not None
    np.testing.assert_allclose(found[:15, :15], covariance)
    np.testing.assert_allclose(found[15, :15], cross)
    assert found[15, 15] == pytest.approx(0.01)


def test_what_a_calibration_left_open_is_open(tmp_path: Path) -> None:
    covariance = np.diag([1e-6] * 2 + [np.inf] + [1e-4] * 9 + [0.01] * 3)
    found = read(tmp_path, covariance=covariance.tolist())
    assert found is not None
    assert found[2, 2] == 1.0
    assert found[0, 0] == 1e-6


@pytest.mark.parametrize(
    ("entry", "named"),
    [
        ({"t_sigma": 0}, "t_sigma"),
        ({"t_sigma": [0.1, -0.1, 0.1]}, "t_sigma"),
        ({"H_sigma": float("nan")}, "H_sigma"),
        ({"C_sigma": "much"}, "C_sigma"),
        ({"C_sigma": [0.1, 0.1]}, "C_sigma"),
        ({"time_offset": {"sigma": -1}}, "time_offset.sigma"),
        ({"time_offset": 0.1}, "time_offset: names with values are expected"),
        ({"covariance": [[1.0]]}, "covariance"),
        ({"covariance": (-np.eye(15)).tolist()}, "covariance"),
        ({"covariance": (np.eye(15) + np.eye(15, k=1)).tolist()}, "covariance"),
        ({"covariance": (np.eye(15) - 0.9 * np.ones((15, 15))).tolist()}, "covariance"),
        ({"covariance": np.full((15, 15), np.nan).tolist()}, "covariance"),
        ({"t_sgima": 0.003}, "unknown key t_sgima; is t_sigma meant"),
        ({"h": [1.0, 2.0, 3.0]}, "unknown key h; is H meant"),
        ({"t_lidar_mag": [0.0, -300.0, 500.0]}, "583.095 m from the LiDAR; .* in metres"),
        ({"common": np.ones((16, 2)).tolist()}, "common"),
        ({"covariance": np.eye(15).tolist(), "common": [[1.0]]}, "common"),
        ({"covariance": np.eye(15).tolist(), "common": np.ones((16, 1)).tolist()}, "common"),
    ],
)
def test_impossible_errors_are_refused_in_one_line(
    tmp_path: Path, entry: dict[str, Any], named: str
) -> None:
    with pytest.raises(CalibrationError, match=named) as refused:
        read(tmp_path, **entry)
    assert "\n" not in str(refused.value)
    assert "mag" in str(refused.value)


def test_what_is_noted_beside_is_no_misspelt_key(tmp_path: Path) -> None:
    notes = {"serial": "A7", "comment": "left", "model": "RM3100", "sensor_id": 3, "noise_ut": 0.1}
    frames = {"R_lidar_mag": np.eye(3).tolist(), "T_lidar_mag": [1.0], "t_lidar_imu": [0, 0, 1]}
    assert read(tmp_path, **notes, **frames) is None


def test_a_suite_of_which_nothing_is_solved_says_so(tmp_path: Path) -> None:
    path = tmp_path / "suite.yaml"
    path.write_text(
        "sensors: {mag: {status: not_converged, message: still moving, t_lidar_mag: [0, 0, 0]}}"
    )
    with pytest.raises(CalibrationError, match=r"sensors: none of them is solved; the `message`"):
        read_known_sensors(path)
