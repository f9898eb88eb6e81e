"""What is found is there: one process among many has to show more than several together."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from l2m_gtsam.calibration.budget.processes import ReadingPlaces, TimeModes, Wander
from l2m_gtsam.calibration.budget.search import (
    Searched,
    credible,
    process_information,
    search,
)
from l2m_gtsam.calibration.joint_information import Rows, joint_information
from l2m_gtsam.data import FloatArray
from tests.support.scenes import scene

SENSORS, EACH, MODES = 12, 120, 8
DRAWS = 200


def places() -> ReadingPlaces:
    """Return a lane that many sensors read from end to end."""
    one = scene(np.linspace(0.0, 200.0, EACH))
    many = np.tile(np.arange(EACH), SENSORS)
    readings = replace(
        one.readings[many],
        sensors=tuple(f"mag_{s:02}" for s in range(SENSORS)),
        sensor=np.repeat(np.arange(SENSORS), EACH),
    )
    parts = (getattr(one, name)[many] for name in ("t", "C", "x", "b_lidar", "slope"))
    return ReadingPlaces(readings, *parts)


PLACES = places()
LOOKED_FOR = [Wander(PLACES, s, TimeModes.over(PLACES.readings, MODES)) for s in range(SENSORS)]


def found(error: FloatArray) -> Searched:
    """Return what is found of readings with errors of unit noise, (S, n, 3), each with an H."""
    unit = np.tile(np.eye(3), (EACH, 1))
    rows = [
        Rows(
            sensor=s,
            columns=np.arange(3 * s, 3 * s + 3),
            jacobian=unit,
            residual=error[s].ravel(),
            readings=np.arange(EACH) + EACH * s,
        )
        for s in range(SENSORS)
    ]
    nothing = np.empty(0)
    joint = joint_information({0: slice(0, 3 * SENSORS)}, rows, nothing.reshape(0, 0), nothing)
    white = [np.broadcast_to(np.eye(3), (EACH, 3, 3))] * SENSORS
    settled = [joint.after_step(each) for each in rows]
    return search(process_information(LOOKED_FOR, joint, settled, white, PLACES.C))


def test_sound_drives_show_nothing() -> None:
    rng = np.random.default_rng(3)
    false = sum(bool(found(rng.standard_normal((SENSORS, EACH, 3))).found) for _ in range(DRAWS))
    # 5 % of 200 are 10; 21 and more would be seen once in a thousand times.
    assert false < 21


def test_walks_are_found_and_sized_whoever_has_them() -> None:
    rng, walk, wandering = np.random.default_rng(4), 2.0, [1, 5, 8]
    sizes: list[float] = []
    false = 0
    for _ in range(10):
        error = rng.standard_normal((SENSORS, EACH, 3))
        steps = walk / np.sqrt(EACH) * rng.standard_normal((len(wandering), EACH, 3))
        error[wandering] += np.cumsum(steps, axis=1)
        shown = {each.process.sensor: each for each in found(error).found}
        assert shown.keys() >= set(wandering)
        false += len(shown) - len(wandering)
        for each in map(shown.get, wandering):
            assert each is not None
            named = each.process.named(each.form, each.sizes)
            sizes.append(float(np.linalg.norm(list(named.values()))))
    # Three axes of one walk tell half of its size; the median of thirty tells a tenth.
    assert float(np.median(sizes)) == pytest.approx(walk, rel=0.3)
    assert false < 4  # 0.7 % of the other 90, of which four would be seen in one of 200 times


def test_several_need_less_than_one_among_many() -> None:
    np.testing.assert_array_equal(credible(np.full(1, 7.0), 27), [False])
    np.testing.assert_array_equal(credible(np.full(6, 7.0), 27), [True] * 6)
    np.testing.assert_array_equal(credible(np.full(1, 7.0), 3), [True])
    assert credible(np.empty(0), 27).shape == (0,)


GAINS = arrays(np.float64, st.integers(0, 12), elements=st.floats(-5, 60))


@given(gains=GAINS, more=st.integers(0, 40))
def test_those_kept_are_the_best_and_few_of_them_chance(gains: FloatArray, more: int) -> None:
    kept = credible(gains, len(gains) + more)
    if kept.any() and not kept.all():
        assert gains[kept].min() >= gains[~kept].max()
    # Looking for more never makes one more credible, nor does a gain that is larger unmake it.
    assert not np.any(credible(gains, len(gains) + more + 5) & ~kept)
    np.testing.assert_array_equal(
        credible(np.where(kept, gains + 1, gains), len(gains) + more), kept
    )
