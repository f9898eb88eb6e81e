"""What speaks against a survey."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.training import TrainingSet, narrow, survey_doubts
from tests.worlds.harmonic import readings


def doubts(points: FloatArray, field: FloatArray) -> str:
    return "; ".join(survey_doubts(TrainingSet(points, field, np.ones(len(points)))))


def test_nothing_speaks_against_a_good_survey() -> None:
    assert doubts(*readings()) == ""


def test_a_straight_line_is_named_and_a_lane_beside_it_is_enough() -> None:
    points, _ = readings(300)
    one_lane = points * np.array([10.0, 0.02, 0.0])
    assert "on one line" in narrow(one_lane)
    two_lanes = np.concatenate([one_lane, one_lane + np.array([0.0, 0.5, 0.0])])
    assert narrow(two_lanes) == ""


@pytest.mark.parametrize("by", [12.0, 100.0])
def test_a_place_with_two_fields_is_named(by: float) -> None:
    """Two readings within a millimetre; no field changes so fast outside of steel."""
    points, field = readings()
    points = np.vstack([points, np.floor(points[:1] / 0.05) * 0.05 + [[0.02, 0.02, 0.02]]])
    points[0] = points[-1] + 1e-3
    field = np.vstack([field, field[:1] + np.array([by, 0.0, 0.0])])
    said = doubts(points, field)
    assert "differ at 1 of" in said
    assert f"by {by:.0f} uT" in said


def pole(points: FloatArray) -> FloatArray:
    """A magnetic pole at the origin: 300 uT/m at 0.2 m."""
    away = np.linalg.norm(points, axis=1, keepdims=True)
    return np.asarray(1.2 * points / away**3)


def test_a_steep_field_is_no_two_fields() -> None:
    """Two sensors along it, 2 cm apart; if one reads 12 uT too much, that is said."""
    x = np.arange(-0.5, 0.5, 0.02)
    lanes = [np.column_stack([x, np.full_like(x, y), np.full_like(x, 0.01)]) for y in (0.2, 0.22)]
    points, field = np.concatenate(lanes), np.concatenate([pole(lane) for lane in lanes])
    span = max(np.ptp(field[(points[:, 0] >= at) & (points[:, 0] < at + 0.05)]) for at in x)
    assert span > 12
    assert doubts(points, field) == ""
    field[len(x) :, 2] += 12
    assert "differ at" in doubts(points, field)


def test_a_metal_cage_is_named() -> None:
    """300 uT, and nothing is said of a few spikes of this strength."""
    points, field = readings()
    caged = field * (300.0 / np.linalg.norm(field, axis=1, keepdims=True))
    assert "100% of the readings exceed 130 uT, the strongest is 300" in doubts(points, caged)
    field[:3] *= 5
    assert "exceed" not in doubts(points, field)
