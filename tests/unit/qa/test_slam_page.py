"""Pages of localisations of which there is little to show."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.localisation_page import localisation_page
from l2m_gtsam.qa.report.page import Identity
from l2m_gtsam.records.localisation_file import LocalisationRecord, SensorRecord, Timeline
from tests.drives.localised import record


def dead(sensor: SensorRecord) -> SensorRecord:
    nothing = float("nan")
    use = replace(sensor.use, rejected=sensor.use.readings, rms=nothing, chi2_per_dof=nothing)
    return SensorRecord(use, sensor.timeline, None, None, None)


def parked() -> LocalisationRecord:
    """Two key poses at one place, which is known exactly, and no reading that counts."""
    told = record()
    one = replace(told.poses[0], covariance=tuple((0.0,) * 6 for _ in range(6)))
    sensors = [
        replace(dead(each), timeline=Timeline((0.0, 1.0), (0,), (9,), (0,)))
        for each in told.sensors
    ]
    return replace(
        told,
        poses=(one, replace(one, stamp_ns=one.stamp_ns + 1_000_000_000)),
        odometry=told.odometry[:1] * 2,
        sensors=tuple(sensors),
        refined=(),
        truth=None,
        drift=replace(told.drift, way_m=0.0),
    )


def unmapped() -> LocalisationRecord:
    """The map has no data around the drive, and covariances are unknown."""
    told = record()
    blank = tuple((float("nan"),) * len(row) for row in told.picture.strength)
    poses = tuple(replace(each, covariance=None) for each in told.poses)
    return replace(told, picture=replace(told.picture, strength=blank), poses=poses)


@pytest.mark.parametrize("told", [parked, unmapped])
def test_a_page_is_drawn(told: Callable[[], LocalisationRecord]) -> None:
    page = localisation_page(told(), QaOptions(), Identity("0" * 64))
    assert page.count("<svg") >= 5
    assert ">None<" not in page
    assert ">nan<" not in page


def test_figures_of_a_page_are_those_of_the_record() -> None:
    told = record()
    assert told.truth is not None
    other = replace(
        told,
        drift=replace(told.drift, end_m=777.77, end_deg=666.6, largest_m=888.88),
        truth=replace(told.truth, nees=4.5678e6),
    )
    one, two = (localisation_page(each, QaOptions(), Identity("0" * 64)) for each in (told, other))
    for number in ("777.77", "666.6", "888.88", "4567800"):
        assert number not in one
        assert number in two
    assert f"{told.drift.end_m:.2f} m and {told.drift.end_deg:.1f}°" in one
