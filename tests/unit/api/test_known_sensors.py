"""A suite made in Python states its errors as a file of one does."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import l2m_gtsam as l2m
from l2m_gtsam.errors import InputError
from l2m_gtsam.storage.yaml_file import write_yaml

T = [0.1, 0.2, 0.3]
ROOT = np.tril(np.random.default_rng(1).normal(size=(15, 15)))
OPEN = np.diag([1e-6] * 2 + [np.inf] + [1e-4] * 9 + [0.01] * 3)


def plain(values: Any) -> Any:
    return values.tolist() if isinstance(values, np.ndarray) else values


@pytest.mark.parametrize(
    "stated",
    [
        {},
        {"t_sigma": 0.003},
        {"t_sigma": 0.003, "C_sigma": 0.005, "H_sigma": 0.3},
        {"t_sigma": np.array([0.001, 0.002, 0.003]), "C_sigma": 0.01 * np.ones((3, 3))},
        {"H_sigma": [0.1, 0.2, 0.3], "time_offset_sigma": 0.01},
        {"time_offset_sigma": 0.01},
        {"covariance": ROOT @ ROOT.T},
        {"covariance": ROOT @ ROOT.T, "t_sigma": 0.1, "time_offset_sigma": 0.02},
        {"covariance": OPEN},
    ],
)
def test_errors_are_those_of_a_file(tmp_path: Path, stated: dict[str, Any]) -> None:
    made = l2m.known_sensor("mag", T, time_offset=0.02, **stated)
    entry = {key: plain(value) for key, value in stated.items() if key != "time_offset_sigma"}
    clock = {"seconds": 0.02, "sigma": stated.get("time_offset_sigma")}
    path = tmp_path / "suite.yaml"
    known = {"t_lidar_mag": T, "time_offset": clock, **entry}
    write_yaml(path, {"sensors": {"mag": known}}, "a suite")
    read = l2m.read_suite(path)["mag"]
    assert (made.covariance is None) == (read.covariance is None) == (not stated)
    if made.covariance is not None:
        np.testing.assert_array_equal(made.covariance, read.covariance)
    assert made.time_offset == read.time_offset
    np.testing.assert_array_equal(made.t_lidar_mag, read.t_lidar_mag)


@pytest.mark.parametrize(
    ("stated", "told"),
    [
        ({"t_sigma": 0}, "mag: t_sigma is 0; give positive numbers, or leave it out for exact"),
        ({"t_sigma": [0.1, -0.1, 0.1]}, "mag: t_sigma is [0.1, -0.1, 0.1]; give positive"),
        ({"C_sigma": np.zeros((3, 3))}, "mag: C_sigma is [[0.0, 0.0, 0.0], ["),
        ({"H_sigma": np.nan}, "mag: H_sigma is nan; give positive numbers"),
        ({"H_sigma": np.inf}, "mag: H_sigma is inf; give positive numbers"),
        ({"C_sigma": [0.1, 0.1]}, "mag: C_sigma is one number or 3 by 3 of them"),
        ({"C_sigma": "much"}, "mag: C_sigma is one number or 3 by 3 of them"),
        ({"time_offset_sigma": -1}, "mag: time_offset_sigma is -1; a sigma is positive"),
        ({"covariance": np.eye(3)}, "mag: covariance has shape (3, 3); (15, 15) is needed"),
        ({"covariance": -np.eye(15)}, "mag: covariance has entries that are no numbers, or neg"),
        ({"covariance": np.full((15, 15), np.nan)}, "mag: covariance has entries that are no"),
        ({"covariance": np.eye(15) + np.eye(15, k=1)}, "mag: covariance is not symmetric"),
        ({"covariance": np.eye(15) - 0.9}, "mag: covariance has"),
        ({"t": [0.0, 300.0, 0.0]}, "mag: the sensor is 300 m from the LiDAR; positions are in"),
        ({"C": np.zeros((3, 3))}, "mag: C cannot be inverted"),
        ({"time_offset": 20.0}, "time_offset: 20 s; at most 10 s are accepted"),
    ],
)
def test_errors_that_cannot_be_are_one_line(stated: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError) as error:
        l2m.known_sensor("mag", **stated)
    assert str(error.value).startswith(told)
    assert "\n" not in str(error.value)
