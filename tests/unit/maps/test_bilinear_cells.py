import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.data import MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.bilinear.lattice import LEAST_STEP, layers_of
from l2m_gtsam.maps.build import map_from_state


@pytest.mark.parametrize(
    ("heights", "expected"),
    [
        ([0.5] * 10, [0] * 10),
        ([0.5, 0.52, 0.45, 0.53], [0, 0, 0, 0]),
        ([0.8, 0.2, 0.5, 0.21, 0.79], [2, 0, 1, 0, 2]),
        # The cut between 0 and 0.3 runs through the readings at 0.15.
        ([0.0] + [0.149] * 50 + [0.151] * 50 + [0.3], [0] * 102),
        ([0.0, 30.0, 0.01, 29.99], [0, 1, 0, 1]),
    ],
)
def test_layers_gather_readings_of_one_height(heights: list[float], expected: list[int]) -> None:
    assert layers_of(np.array(heights), np.ones(len(heights)), 0.25).tolist() == expected


@settings(max_examples=100)
@given(st.lists(st.floats(-5, 5), min_size=1, max_size=40))
def test_layers_count_upward_and_keep_their_distance(heights: list[float]) -> None:
    layer = layers_of(np.array(heights), np.ones(len(heights)), 0.25)
    assert set(layer) == set(range(max(layer) + 1))
    means = [np.mean(np.array(heights)[layer == k]) for k in range(max(layer) + 1)]
    assert np.diff(means).min(initial=np.inf) >= LEAST_STEP * 0.25


DAMAGE: list[tuple[str, npt.NDArray[np.float64], str]] = [
    ("points", np.full((20, 3), np.nan), "is not finite"),
    ("points", np.zeros((20, 2)), r"shape \(20, 2\)"),
    ("field", np.zeros((5, 3)), "do not belong together"),
    ("count", np.zeros(20), "map cell 0 of 20 is damaged"),
    ("points", np.full((20, 3), 1e300), "map cell 0 of 20 is damaged"),
    ("layer", np.arange(20.0) % 2, "does not count its layers upward"),
    ("layer", np.full(20, 3.5), "does not count its layers upward"),
    ("layer", np.full(20, np.nan), "does not count its layers upward"),
    ("spread", np.array([-1.0]), "spread is damaged"),
    ("spread", np.array([np.nan]), "spread is damaged"),
    ("spread", np.zeros(2), "spread is damaged"),
]


@pytest.mark.parametrize(("name", "array", "complaint"), DAMAGE)
def test_a_damaged_state_is_refused(
    name: str, array: npt.NDArray[np.float64], complaint: str
) -> None:
    rng = np.random.default_rng(8)
    arrays = {
        "points": rng.uniform(-1, 1, (20, 3)) * [1, 1, 0],
        "field": rng.normal(size=(20, 3)),
        "count": np.ones(20),
        "layer": np.zeros(20),
        "spread": np.array([0.1]),
    }
    assert map_from_state(MapState("bilinear", arrays, {}, {})).kind == "bilinear"
    with pytest.raises(MapError, match=complaint):
        map_from_state(MapState("bilinear", {**arrays, name: array}, {}, {}))


def test_a_state_without_cells_is_refused() -> None:
    arrays = {name: np.empty(0) for name in ("count", "layer")}
    arrays |= {"points": np.empty((0, 3)), "field": np.empty((0, 3)), "spread": np.zeros(1)}
    with pytest.raises(MapError, match="do not belong together"):
        map_from_state(MapState("bilinear", arrays, {}, {}))
