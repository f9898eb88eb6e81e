"""Steel that a drive shows beside a map: whether the map's survey shows it as well."""

import numpy as np

from l2m_gtsam.calibration.drive_sources import missed_by_map
from l2m_gtsam.data import FieldSample, FloatArray
from l2m_gtsam.maps.sources.source import SourceShape
from l2m_gtsam.maps.training import TrainingSet

NOISE_UT = 0.2
BOX = SourceShape.dipole(np.array([1.0, 1.0, 0.6]), np.array([-0.6, -1.7, -0.2]))
FAR = SourceShape.dipole(np.array([9.0, 9.0, 0.6]), np.array([1.0, 2.0, 0.0]))


class Surveyed:
    """A map of one field, of a survey that read that of some sources beside it."""

    def __init__(self, *stood: SourceShape) -> None:
        x, y, z = np.meshgrid(np.arange(0, 2.1, 0.4), np.arange(0, 2.1, 0.4), [0.3, 1.0])
        points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
        field = NOISE_UT * np.random.default_rng(3).normal(size=points.shape)
        for each in stood:
            field += each.field_and_gradient(points)[0]
        self.readings = TrainingSet(points, field, np.ones(len(points)))

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        return np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))

    def query(self, points: FloatArray, /) -> FieldSample:
        inside = np.ones(len(points), dtype=np.bool_)
        return FieldSample(*self.field_and_gradient(points), np.ones((len(points), 3)), inside)


class Forgetful(Surveyed):
    """The same without its readings."""

    def __init__(self) -> None:
        pass


def test_steel_that_the_survey_read_is_no_change() -> None:
    assert missed_by_map([BOX, FAR], Surveyed(BOX)).tolist() == [True, False]


def test_steel_that_it_did_not_read_is_one() -> None:
    """Also what went, which is read with the opposite sign, and what a survey does not reach."""
    gone = SourceShape.dipole(BOX.position, -BOX.moment)
    assert not missed_by_map([BOX, FAR], Surveyed()).any()
    assert not missed_by_map([gone], Surveyed(BOX)).any()
    assert not missed_by_map([FAR], Surveyed()).any()


def test_a_map_without_readings_says_nothing() -> None:
    assert missed_by_map([BOX], Forgetful()).tolist() == [False]
    assert missed_by_map([], Surveyed()).tolist() == []
