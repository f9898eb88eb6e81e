"""Which of several sensors is no longer as calibrated."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.slam.drive import KnownSensors, StartPose
from l2m_gtsam.slam.moved_sensors import sensor_to_leave_out
from l2m_gtsam.slam.online.branches import BranchedFollower
from l2m_gtsam.slam.online.calibration_watch import CalibrationWatch

MANY = {"a": 40.0, "b": 3000.0, "c": 900.0}


def answers(
    left: dict[str, dict[str, float]],
) -> tuple[list[str], Callable[[str], dict[str, float]]]:
    """Return what is left without each sensor, and who was asked for."""
    asked = list[str]()

    def without(sensor: str) -> dict[str, float]:
        asked.append(sensor)
        return left[sensor]

    return asked, without


def test_calibrations_that_hold_cost_nothing() -> None:
    asked, without = answers({})
    assert sensor_to_leave_out({"a": 12.0, "b": 70.0}, without) is None
    assert sensor_to_leave_out({"a": 1e6}, without) is None
    assert sensor_to_leave_out({}, without) is None
    assert asked == []


def test_the_plainest_goes_where_the_others_hold_without_it() -> None:
    asked, without = answers({"b": {"a": 14.0, "c": 20.0}})
    found = sensor_to_leave_out(MANY, without)
    assert found is not None
    assert (found.sensor, found.change) == ("b", 3000.0)
    assert asked == ["b"]
    assert "b is left out" in found.note()


def test_the_plainest_is_not_always_the_one() -> None:
    asked, without = answers({"b": {"a": 60.0, "c": 900.0}, "c": {"a": 14.0, "b": 20.0}})
    found = sensor_to_leave_out(MANY, without)
    assert found is not None
    assert found.sensor == "c"
    assert asked == ["b", "c"]


def test_a_wrong_map_is_no_moved_sensor() -> None:
    """All contradict alike, or with any of them out the others still do."""
    asked, without = answers({each: {"x": 2500.0} for each in "abcd"})
    assert sensor_to_leave_out({"a": 2500.0, "b": 3000.0, "c": 2900.0}, without) is None
    assert sensor_to_leave_out(dict.fromkeys("abcd", 3000.0), without) is None
    assert asked == []
    assert sensor_to_leave_out({"a": 400.0, "b": 3000.0, "c": 2900.0}, without) is None
    assert asked == ["b", "c"]


def test_of_two_each_alone_may_hold_and_neither_is_blamed() -> None:
    _, without = answers({"a": {"b": 16.0}, "b": {"a": 14.0}})
    assert sensor_to_leave_out({"a": 800.0, "b": 900.0}, without) is None
    _, without = answers({"a": {"b": 500.0}, "b": {"a": 14.0}})
    found = sensor_to_leave_out({"a": 800.0, "b": 900.0}, without)
    assert found is not None
    assert found.sensor == "b"


def test_where_nothing_is_refined_without_it_nothing_is_left_out() -> None:
    _, without = answers({"b": {}, "c": {}})
    assert sensor_to_leave_out(MANY, without) is None


def no_follower(_: StartPose) -> BranchedFollower:
    raise AssertionError("nothing is followed again where no start is kept")


def test_on_line_each_sensor_is_told_once() -> None:
    given = KnownSensors(
        ("a", "b"),
        np.zeros((2, 3)),
        np.zeros((2, 12)),
        np.zeros(2),
        np.full(2, 0.1),
        np.stack([0.01 * np.eye(15)] * 2),
    )
    watch = CalibrationWatch(given, no_follower)
    assert watch.refuted(given) == []
    # Nine sigmas of 0.1: chi-square 81 of 15, beyond 74.
    moved = replace(given, t=np.array([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0]]))
    (found,) = watch.refuted(moved)
    assert found.sensor == "b"
    assert found.change == pytest.approx(81.0)
    assert "b contradicts its calibration (chi-square 81 of 15)" in found.warning()
    assert watch.refuted(moved) == []
    assert watch.left_out(moved) is None
    both = replace(moved, distortion=np.full((2, 12), 0.3))
    assert [each.sensor for each in watch.refuted(both)] == ["a"]
