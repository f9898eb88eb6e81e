"""Twelve drives: each gets the verdict and the reason that a specialist would give."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.calibration.calibrate import calibrated
from l2m_gtsam.errors import UnitsError
from l2m_gtsam.qa.evaluate import evaluate
from l2m_gtsam.qa.options import Nominal, QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.qa.verdict.repeatability import repeat
from l2m_gtsam.qa.verdict.sensor import Case
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.records.verdict import Level, Verdict
from l2m_gtsam.storage.bag import read_recording
from l2m_gtsam.storage.bag_options import BagOptions
from tests.drives.bags import Entry, ros, write
from tests.drives.verdict import (
    EIGHT,
    NOMINAL,
    SENSORS,
    Drive,
    changed_place,
    dead_axis,
    drive,
    good,
    late,
    loose,
    magnet,
    map_elsewhere,
    short,
    straight_line,
    swapped_axes,
    swapped_sensors,
    turned_axes,
)

ALL = ("mag_0", "mag_1", "mag_2")
PASS, WARN, FAIL = Level.PASS, Level.WARN, Level.FAIL


@dataclass(frozen=True)
class Expected:
    """What a specialist would say.

    Attributes
    ----------
    make
        The drive.
    level
        Of the whole.
    sensors
        Levels of the three sensors.
    whole
        Words of the first reason that concerns all.
    own
        Words of the first reason of the sensors named.
    """

    make: Callable[[], Drive]
    level: Level
    sensors: tuple[Level, Level, Level]
    whole: tuple[str, ...] = ()
    own: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = ()


CASES = {
    "good": Expected(good, PASS, (PASS, PASS, PASS)),
    "dead axis": Expected(
        dead_axis, FAIL, (PASS, FAIL, PASS), own=((("mag_1",), ("dead", "z axis", "wiring")),)
    ),
    "changed environment": Expected(
        changed_place,
        WARN,
        (WARN, WARN, WARN),
        whole=("environment has changed", "from (", "3 sensors differ", "do not count"),
    ),
    "short drive": Expected(short, FAIL, (FAIL, FAIL, FAIL), whole=("drive is short", "in 3 s")),
    "straight line": Expected(
        straight_line,
        FAIL,
        (FAIL, FAIL, FAIL),
        whole=("straight line", "headings", "loops"),
        own=((ALL, ("height (t_z)", "third column of C against H")),),
    ),
    "time offset": Expected(
        late, WARN, (WARN, WARN, WARN), own=((ALL, ("clock is off by", "taken into account")),)
    ),
    "loose sensor": Expected(
        loose,
        FAIL,
        (PASS, FAIL, PASS),
        own=((("mag_1",), ("does not hold still", "mm in place", "other sensors repeat")),),
    ),
    "swapped axes": Expected(
        swapped_axes,
        FAIL,
        (PASS, FAIL, PASS),
        own=((("mag_1",), ("Axes x and y are swapped", "in the driver", "{mag_1: [y, x, z]}")),),
    ),
    "turned axes": Expected(
        turned_axes,
        WARN,
        (PASS, WARN, PASS),
        own=(
            (("mag_1",), ("axes are exchanged", "+y, -x, +z", "{mag_1: [-y, x, z]}", "qa.nominal")),
        ),
    ),
    "magnet on the vehicle": Expected(
        magnet,
        PASS,
        (PASS, PASS, PASS),
        own=((("mag_1",), ("Strong hard iron", "(60.", "magnet")),),
    ),
    "map elsewhere": Expected(
        map_elsewhere, FAIL, (FAIL, FAIL, FAIL), whole=("map does not fit", "map of this place")
    ),
    "two sensors swapped": Expected(
        swapped_sensors,
        FAIL,
        (FAIL, FAIL, PASS),
        own=(
            (("mag_0",), ("where mag_1 should be", "topics")),
            (("mag_1",), ("where mag_0 should be", "topics")),
        ),
    ),
}


@cache
def verdict_on(make: Callable[[], Drive]) -> Verdict:
    return judged(make, QaOptions())


def judged(make: Callable[[], Drive], options: QaOptions) -> Verdict:
    whole = make()
    found = calibrated(whole.recording, whole.field_map, whole.options)
    metrics = evaluate(whole.recording, found, whole.options, options)
    return judge(found.result, metrics, options)


@pytest.mark.parametrize("name", CASES)
def test_the_verdict_is_that_of_a_specialist(name: str) -> None:
    expected = CASES[name]
    verdict = verdict_on(expected.make)
    told = [(each.sensor, each.level, each.reasons) for each in verdict.sensors]
    assert tuple(each.level for each in verdict.sensors) == expected.sensors, told
    assert verdict.level is expected.level
    if expected.whole:
        assert all(words in verdict.reasons[0].text for words in expected.whole), verdict.reasons
    else:
        assert all(each.level is PASS for each in verdict.reasons)
    for sensors, words in expected.own:
        for sensor in sensors:
            first = verdict[sensor].reasons[0].text
            assert all(each in first for each in words), first


def test_what_passes_has_no_reason_to_doubt() -> None:
    assert all(not each.reasons for each in verdict_on(good).sensors)


def test_sigmas_that_are_lower_bounds_are_no_pass() -> None:
    """A map that knows of its errors but not how readings share them, unless it has none."""
    whole = good()
    found = calibrated(whole.recording, whole.field_map, whole.options)
    metrics = evaluate(whole.recording, found, whole.options, QaOptions())
    assert found.result.uncertainty is Uncertainty.INDEPENDENT
    first, *others = metrics.sensors
    noisy = replace(first, fit=replace(first.fit, map_noise=0.02))
    verdict = judge(found.result, replace(metrics, sensors=(noisy, *others)), QaOptions())
    assert [each.level for each in verdict.sensors] == [WARN, *[PASS] * len(others)]
    assert "lower bounds" in verdict.sensors[0].reasons[0].text
    full = replace(found.result, uncertainty=Uncertainty.FULL)
    verdict = judge(full, replace(metrics, sensors=(noisy, *others)), QaOptions())
    assert verdict.level is PASS


def test_a_loose_sensor_is_not_blamed_on_the_map() -> None:
    """Nor where it moved late: two thirds of the first half's readings are then as of the whole."""
    for verdict in (verdict_on(loose), verdict_on(loosened_late)):
        assert verdict["mag_1"].level is FAIL
        assert "hold still" in verdict["mag_1"].reasons[0].text
        assert not any("right map" in each.text for each in verdict["mag_1"].reasons)
        assert all(each.level is PASS for each in verdict.reasons)


def test_one_rejected_reading_excuses_no_sensor() -> None:
    """A FAIL is a WARN only where as many were rejected as are worth a warning by themselves."""
    whole, options = loose(), QaOptions()
    found = calibrated(whole.recording, whole.field_map, whole.options)
    metrics = evaluate(whole.recording, found, whole.options, options)
    alone = replace(metrics, sensors=(metrics.sensors[1],))
    sensor = found.result.sensors[1]
    assert sensor.residuals is not None
    for rejected, level in ((0, FAIL), (1, FAIL), (sensor.residuals.readings // 40, WARN)):
        case = Case(
            replace(sensor, rejected=rejected), alone.sensors[0], found.result, alone, options
        )
        (reason,) = repeat(case)
        assert reason.level is level
        assert "in C (chi-square" in reason.text


def loosened_late() -> Drive:
    return loose(0.7)


def test_where_a_solve_starts_is_no_nominal_place() -> None:
    """It is known roughly: 7 cm from it nothing is wrong, from a nominal place there is."""
    whole = drive()
    roughly = {
        each.sensor: tuple(each.t_lidar_mag + np.array([0.04, -0.04, 0.04])) for each in SENSORS
    }
    options = whole.options.model_copy(update={"start": roughly})
    started = replace(whole, options=options)
    assert all(not each.reasons for each in judged(lambda: started, QaOptions()).sensors)
    meant = QaOptions(nominal={"mag_1": Nominal(t_lidar_mag=roughly["mag_1"])})
    assert "from its nominal place" in judged(lambda: started, meant)["mag_1"].reasons[0].text


def test_a_turned_sensor_passes_once_it_is_meant_so() -> None:
    """The same mounting, stated: R_lidar_mag turns by 90 degrees about z."""
    half = 0.5**0.5
    meant = Nominal(quaternion_xyzw=(0.0, 0.0, half, half))
    other = Nominal(quaternion_xyzw=(1.0, 0.0, 0.0, 0.0))
    right, wrong = (QaOptions(nominal={"mag_1": each}) for each in (meant, other))
    assert judged(turned_axes, right)["mag_1"].level is PASS
    assert judged(turned_axes, wrong)["mag_1"].level is FAIL


def test_wrong_units_are_caught_before(tmp_path: Path) -> None:
    """In gauss under the name of tesla: one line names the sensor and the likely unit."""
    whole, make = drive(), ros("mcap")
    field = whole.recording.series[0].field / 100
    entries = []
    quaternions = [(0.0, 0.0, 0.0, 1.0)] * len(field)
    for stamp, p, q, B in zip(EIGHT.stamp_ns.tolist(), EIGHT.p, quaternions, field, strict=True):
        pose = make.pose_stamped(stamp, p, q)
        entries.append(Entry("/pose", "geometry_msgs/PoseStamped", stamp, pose))
        entries.append(Entry("/mag", "sensor_msgs/MagneticField", stamp, make.magnetic(stamp, B)))
    bag = write(tmp_path, "mcap", entries, "gauss")
    with pytest.raises(UnitsError, match=r"/mag.*units: gauss"):
        read_recording(bag, BagOptions(poses="/pose", fields=("/mag",)))


def test_the_sensors_are_where_the_cases_say() -> None:
    assert {each.sensor: tuple(each.t_lidar_mag) for each in SENSORS} == NOMINAL


def test_what_is_taken_for_exact_says_what_follows() -> None:
    """No sigma knows of a suite that is off as a whole, and no drive shows it."""
    (note,) = [each for each in verdict_on(good).reasons if "Taken as exact" in each.text]
    assert note.level is PASS
    assert "one to one into every t and rotation" in note.text
