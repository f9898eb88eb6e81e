"""A map is contradicted if what it predicts is not in the readings, and not if these say little."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.contradiction import is_contradicted
from l2m_gtsam.data import FloatArray

COUNT = 600
RNG = np.random.default_rng(4)
EARTH = np.array([19.0, 4.0, -44.0])
R = Rotation.from_euler("ZYX", RNG.normal(size=(COUNT, 3)) * [3.0, 0.1, 0.1]).as_matrix()
NOISE = RNG.normal(size=(COUNT, 3))
IDEAL = np.append(np.eye(3).ravel(), np.zeros(3))
ESTIMATE: Any = SimpleNamespace(distortion=IDEAL[None])


def varying(seed: int) -> FloatArray:
    """Return the field of a place along the drive, in the map's axes."""
    return EARTH + np.random.default_rng(seed).normal(size=(COUNT, 3))


def of_lidar(field: FloatArray) -> FloatArray:
    """Return a field along the axes of the lidar."""
    return np.asarray(np.einsum("nji,nj->ni", R, field))


def is_refused(here: FloatArray, of_map: FloatArray, noise: float, place_open: bool) -> bool:
    """Return whether readings of a field contradict a map of another."""
    readings = SimpleNamespace(
        sensor=np.zeros(COUNT, dtype=int), R_map_lidar=R, field=of_lidar(here) + noise * NOISE
    )
    view: Any = SimpleNamespace(readings=readings, b_lidar=of_lidar(of_map), sensors=[0])
    tests: Any = {0: SimpleNamespace(place_open=place_open)}
    return is_contradicted(view, ESTIMATE, tests)


@pytest.mark.parametrize(
    ("of_map", "noise", "place_open", "refused"),
    [
        (varying(1), 0.3, False, False),
        (varying(2), 0.3, False, True),  # the map of another place
        (varying(2), 0.3, True, False),
        (varying(1), 5.0, False, False),  # noise is most of what is left, the map is right
        (varying(1) + 0.7 * (varying(3) - EARTH), 0.3, False, False),  # moved steel
        (np.tile(EARTH, (COUNT, 1)), 0.3, False, False),  # it predicts nothing
    ],
)
def test_only_a_map_whose_field_is_not_here_is_contradicted(
    of_map: FloatArray, noise: float, place_open: bool, refused: bool
) -> None:
    assert is_refused(varying(1), of_map, noise, place_open) is refused
