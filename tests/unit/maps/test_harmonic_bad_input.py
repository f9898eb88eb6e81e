"""Readings, clouds and places that a harmonic map refuses, and few readings that it takes."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.training import additional_set, training_set
from tests.worlds.harmonic import OPTIONS, POST, queries, readings

pytestmark = pytest.mark.usefixtures("affordable")


def test_bad_queries_are_refused(harmonic: HarmonicMap) -> None:
    bad = queries()
    bad[12, 2] = np.nan
    for ask in (harmonic.query, harmonic.field_and_gradient, harmonic.variance):
        with pytest.raises(MapError, match="map point 12 of 300 is not finite"):
            ask(bad)
        with pytest.raises(MapError, match=r"shape \(3,\)"):
            ask(np.zeros(3))
    with pytest.raises(MapError, match="map point 12 of 300 is not finite"):
        harmonic.errors_over(bad)


def spoiled(array: FloatArray) -> FloatArray:
    array = array.copy()
    array[3, 1] = np.nan
    return array


@pytest.mark.parametrize("cloud", [None, POST])
def test_bad_readings_are_refused_in_one_line(cloud: FloatArray | None) -> None:
    points, field = readings()
    bad: list[tuple[FloatArray, FloatArray, str]] = [
        (spoiled(points), field, "map point 3 of 600 is not finite"),
        (points, spoiled(field), "training reading 3 of 600 is not finite"),
        (points[:, :2], field, r"shape \(600, 2\)"),
        (points[:5], field[:5], "at least 10"),
        (points[:0], field[:0], "at least 10"),
    ]
    for p, b, complaint in bad:
        with pytest.raises(MapError, match=complaint) as caught:
            HarmonicMap.fit(p, b, OPTIONS, cloud)
        assert "\n" not in str(caught.value)


def test_few_readings_and_readings_at_rest_can_be_added(harmonic: HarmonicMap) -> None:
    """They make no map, but a map that exists can learn from them."""
    points, field = readings(5, seed=9)
    at_rest = np.tile(points[:1], (50, 1)), np.tile(field[:1], (50, 1))
    for p, b in ((points, field), (points[:1], field[:1]), at_rest):
        with pytest.raises(MapError):
            training_set(p, b)
        new = additional_set(p, b)
        np.testing.assert_array_equal(new.points, p)
        np.testing.assert_array_equal(new.field, b)
        np.testing.assert_array_equal(new.weight, 1.0)
        learnt = harmonic.learnt.extended(new, harmonic.options)
        assert learnt.origin.readings == harmonic.learnt.origin.readings + len(p)
        sample = HarmonicMap.condition(learnt, harmonic.options).query(p)
        assert sample.inside.all()


def test_bad_additional_readings_are_refused_in_one_line() -> None:
    points, field = readings(5)
    bad: list[tuple[FloatArray, FloatArray, str]] = [
        (points[:0], field[:0], "no readings to add to the map"),
        (spoiled(points), field, "map point 3 of 5 is not finite"),
        (points, spoiled(field), "training reading 3 of 5 is not finite"),
        (points[:, :2], field, r"shape \(5, 2\)"),
        (points, field[:4], "5 points need"),
        (points * 1e9, field, "are they in metres"),
        (points, field * 1e9, "are they in microtesla"),
    ]
    for p, b, complaint in bad:
        with pytest.raises(MapError, match=complaint) as caught:
            additional_set(p, b)
        assert "\n" not in str(caught.value)


def test_bad_clouds_are_refused_in_one_line() -> None:
    for cloud in (spoiled(POST), POST[:, :2], POST * 1e30):
        with pytest.raises(MapError) as caught:
            HarmonicMap.fit(*readings(), OPTIONS, cloud)
        assert "\n" not in str(caught.value)
