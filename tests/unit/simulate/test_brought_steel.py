"""Steel that is brought to a hall: its moment, and where it stands."""

import numpy as np
import pytest

from l2m_gtsam.simulate.world import brought_steel, place_beside

MOMENT = np.array([3.0, -2.0, 7.0])


def test_from_afar_it_is_the_dipole_of_its_moment() -> None:
    """To the square of its size over the distance: 0.1 m at 3 to 5 m, and 0.1 uT m^3 / (A m^2)."""
    place = np.array([1.0, 2.0, 0.5])
    steel = brought_steel(place[None], MOMENT[None], np.full(3, 0.1))
    away = np.random.default_rng(0).standard_normal((20, 3))
    r = away / np.linalg.norm(away, axis=1)[:, None] * np.linspace(3, 5, 20)[:, None]
    length = np.linalg.norm(r, axis=1)[:, None]
    dipole = 0.1 * (3 * r * (r @ MOMENT)[:, None] / length**5 - MOMENT / length**3)
    np.testing.assert_allclose(steel.field(place + r), dipole, atol=2e-3 * np.abs(dipole).max())


def test_what_went_is_the_opposite_of_what_came() -> None:
    edges, points = np.array([0.3, 0.3, 0.8]), np.random.default_rng(1).normal(0, 2, (9, 3)) + 4
    came = brought_steel(np.zeros((1, 3)), MOMENT[None], edges).field(points)
    went = brought_steel(np.zeros((1, 3)), -MOMENT[None], edges).field(points)
    np.testing.assert_array_equal(came, -went)


@pytest.mark.parametrize("distance", [0.5, 1.0, 2.0])
def test_a_place_is_as_far_from_the_path_as_asked_for(distance: float) -> None:
    """The path runs along x 0.7 m over the floor; nothing stands below that, or beside another."""
    path = np.column_stack([np.linspace(-4, 4, 300), np.zeros(300), np.full(300, 0.7)])
    rng, places = np.random.default_rng(2), np.zeros((0, 3))
    for _ in range(4):
        place = place_beside(path, places, distance, rng)
        assert np.linalg.norm(path - place, axis=1).min() == pytest.approx(distance, abs=0.03)
        assert place[2] > 0
        assert not len(places) or np.linalg.norm(places - place, axis=1).min() >= 1.0
        places = np.vstack([places, place])
