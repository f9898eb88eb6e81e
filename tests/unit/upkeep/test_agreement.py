"""Whether parts of a survey saw one field."""

import numpy as np
import pytest
from scipy.stats import f_oneway, kstest

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.upkeep.agreement import FEWEST, between_parts


def readings(points: FloatArray, weight: FloatArray | None = None) -> TrainingSet:
    ones = np.ones(len(points))
    return TrainingSet(points, np.zeros_like(points), ones if weight is None else weight)


def test_it_is_the_sum_of_squares_between_groups_of_each_square() -> None:
    """Its mean is that of an analysis of variance, which divides it by the rest within groups."""
    rng, count = np.random.default_rng(3), 400
    points, white = rng.uniform(0, 2, (count, 3)), rng.normal(size=(count, 3))
    part = rng.integers(0, 3, count)
    squares, freedom = between_parts(readings(points), white, part)
    expected, parts = 0.0, 0
    for x in range(2):
        for y in range(2):
            here = (np.floor(points[:, :2]) == [x, y]).all(axis=1)
            for axis in range(3):
                groups = [white[here & (part == k), axis] for k in range(3)]
                within = sum(float(np.sum((each - each.mean()) ** 2)) for each in groups)
                ratio = f_oneway(*groups).statistic
                expected += ratio * 2 * within / (np.count_nonzero(here) - 3)
                parts += 2
    assert freedom == parts
    assert squares == pytest.approx(expected, rel=1e-9)


def test_a_reading_of_weight_two_is_two_readings() -> None:
    rng = np.random.default_rng(4)
    points, white = rng.uniform(0, 1, (40, 3)), rng.normal(size=(40, 3))
    part = np.arange(40) % 2
    twice = np.repeat(np.arange(40), 2)
    once = between_parts(readings(points, np.full(40, 2.0)), white, part)
    assert once == pytest.approx(between_parts(readings(points[twice]), white[twice], part[twice]))


def test_of_one_field_it_is_chi_square() -> None:
    def chance(seed: int) -> float:
        rng = np.random.default_rng(seed)
        points, part = rng.uniform(0, 3, (300, 3)), rng.integers(0, 2, 300)
        squares, freedom = between_parts(readings(points), rng.normal(size=(300, 3)), part)
        assert freedom == 27  # nine squares
        return squares

    drawn = [chance(seed) for seed in range(300)]
    assert kstest(drawn, "chi2", args=(27,)).pvalue > 0.01


def test_parts_that_never_meet_say_nothing() -> None:
    points = np.array([[0.5, 0.5, 0.0]] * FEWEST + [[5.5, 0.5, 0.0]] * FEWEST)
    part: IntArray = np.repeat([0, 1], FEWEST)
    white = np.outer(part, [9.0, 9.0, 9.0])
    assert between_parts(readings(points), white, part)[1] == 0
    few = np.arange(FEWEST - 1)
    assert between_parts(readings(points[few]), white[few], part[few]) == (0.0, 0)
