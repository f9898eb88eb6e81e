"""Arguments of another kind: one line names the argument, what came, and what is wanted."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import l2m_gtsam as l2m
from l2m_gtsam.errors import ConfigError, InputError, L2MError
from l2m_gtsam.maps.build import MapOptions, build_map
from l2m_gtsam.maps.field_map import FieldMap

COUNT = 40
SECONDS = 1000.0 + 0.1 * np.arange(COUNT)
AT = 0.01 * np.arange(COUNT)
P = np.column_stack([np.cos(3 * AT), np.sin(2 * AT), 0.1 * np.sin(7 * AT)])
Q = np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1))
FIELD = np.array([20.0, 5.0, -40.0]) + np.sin(np.outer(np.arange(COUNT), [1, 2, 3]))
BILINEAR = {"model": {"kind": "bilinear"}}
MAP: Any = build_map(P, FIELD, MapOptions(kind="bilinear"))


def drive(fields: Any = None, **more: Any) -> Any:
    usual = {"mag": (SECONDS, FIELD)}
    return l2m.drive(SECONDS, P, Q, usual if fields is None else fields, **more)


RECORDING: Any = drive()
SENSOR: Any = l2m.known_sensor("mag")
API: Any = l2m


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: API.save_map(MAP, "map.npz"), "path: a map (BilinearMap) was given; needed is"),
        (lambda: API.save_map("map.npz", RECORDING), "field_map: a Recording was given; needed is"),
        (lambda: API.load_map(None), "path: None was given; needed is the path of a file"),
        (lambda: API.read_suite(3), "path: 3 was given; needed is the path of a file"),
        (lambda: API.read_bag(None), "logs: None was given; needed is the path of a file, or a"),
        (lambda: API.read_bag([]), "logs: an empty list was given"),
        (lambda: API.read_bag("a.bag", poses=[1]), "poses[0]: 1 was given; needed is the path"),
        (
            lambda: API.calibrate(MAP, RECORDING),
            "recording: a map (BilinearMap) was given; needed is a drive, made by `l2m_gtsam.read_",
        ),
        (
            lambda: API.calibrate(RECORDING, None),
            "field_map: None was given; needed is a map, made by `l2m_gtsam.build_map` or",
        ),
        (lambda: API.calibrate(RECORDING, {}), "field_map: an empty dict was given"),
        (lambda: API.localise(RECORDING, MAP), "calibration: a map (BilinearMap) was given"),
        (lambda: API.localise(RECORDING, [SENSOR]), "calibration: a list of 1 was given"),
        (lambda: API.build_map([]), "surveys: an empty list was given; needed is a drive"),
        (lambda: API.build_map(None), "surveys: None was given"),
        (lambda: API.build_map(RECORDING.trajectory), "surveys: a Trajectory was given"),
        (lambda: API.build_map([RECORDING, 3]), "surveys[1]: 3 was given; needed is a drive"),
        (lambda: API.build_map(RECORDING, MAP), "suite: a map (BilinearMap) was given; needed is"),
        (
            lambda: API.build_map(RECORDING, {"mag": ([0, 0, 0], np.eye(3))}),
            "suite['mag']: a tuple of 2 was given; needed is a sensor, made by `l2m_gtsam.known_",
        ),
        (lambda: API.build_map(RECORDING, {3: SENSOR}), "suite: a name: 3 was given"),
        (lambda: API.build_map(RECORDING, [SENSOR, SENSOR]), "suite: 'mag' is listed twice"),
        (lambda: API.build_map(RECORDING, structure=MAP), "structure: not an array of numbers"),
        (lambda: API.keep_map_up(MAP, RECORDING, None), "suite: None was given; needed is a suite"),
        (lambda: API.keep_map_up(RECORDING, RECORDING, []), "field_map: a Recording was given"),
        (
            lambda: drive([("mag", SECONDS, FIELD)]),
            "fields: a list of 1 was given; needed",
        ),
        (
            lambda: drive({}),
            "fields: an empty dict was given; needed is {name: (stam",
        ),
        (
            lambda: drive({"a": FIELD}),
            f"fields['a']: an array of shape ({COUNT}, 3) was given; needed is (stamps, readings)",
        ),
        (lambda: drive({"a": (SECONDS, FIELD, 1)}), "fields['a']: a tuple of 3 was given"),
        (lambda: drive({3: (SECONDS, FIELD)}), "fields: a name: 3 was given"),
        (
            lambda: drive({"a": ([[1], [1, 2]], FIELD)}),
            "fields['a']: stamps: a list of 2 was given",
        ),
        (lambda: drive(pose_covariance="small"), "pose_covariance: not an array of numbers"),
        (lambda: API.drive(SECONDS, P, "up", {"a": 1}), "orientations: not an array of numbers"),
        (lambda: API.known_sensor(3), "name: 3 was given; needed is the name of a sensor"),
        (lambda: API.known_sensor("mag", time_offset="late"), "time_offset: not an array"),
        (lambda: API.known_sensor("mag", time_offset=np.nan), "time_offset: a number is not"),
    ],
)
def test_the_line_names_what_came_and_what_is_wanted(call: Callable[[], object], told: str) -> None:
    with pytest.raises(InputError) as error:
        call()
    assert str(error.value).startswith(told)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("call", "key", "accepted"),
    [
        (lambda o: API.calibrate(RECORDING, MAP, options=o), "calibration.sole", "solve"),
        (lambda o: API.calibrate(RECORDING, MAP, qa=o), "qa.sole", "map_days"),
        (lambda o: API.build_map(RECORDING, options=o), "mapping.sole", "model"),
        (lambda o: API.read_bag("drive.bag", options=o), "bag.sole", "units"),
    ],
)
def test_an_option_with_a_typing_error(
    call: Callable[[Any], object], key: str, accepted: str
) -> None:
    with pytest.raises(ConfigError) as error:
        call({"sole": 1})
    assert str(error.value).startswith(f"unknown key '{key}'; accepted here: ")
    assert accepted in str(error.value)


def test_options_that_are_no_options() -> None:
    with pytest.raises(L2MError, match="names with values are expected"):
        API.calibrate(RECORDING, MAP, options=["solve"])


@pytest.mark.parametrize("suite", [SENSOR, [SENSOR], {"mag": SENSOR}, (s for s in [SENSOR])])
def test_a_suite_is_one_sensor_or_several(suite: Any) -> None:
    built: FieldMap = l2m.build_map(RECORDING, suite, options=BILINEAR)
    assert built.summary.readings > 0


def test_readings_come_as_any_pair() -> None:
    assert drive({"mag": [SECONDS, FIELD]}).source == RECORDING.source


def test_a_covariance_of_zeros_is_unknown_as_in_messages() -> None:
    assert drive(pose_covariance=np.zeros((6, 6))).trajectory.covariance is None
    some = np.tile(1e-4 * np.eye(6), (COUNT, 1, 1))
    assert drive(pose_covariance=some).trajectory.covariance is not None
    some[3] = 0.0
    assert drive(pose_covariance=some).trajectory.covariance is None


def test_paths_may_be_text(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    l2m.save_map(str(path), MAP)
    assert l2m.load_map(path).kind == "bilinear"
