"""The terms of a tile, summed one by one: the same as its basis makes of them."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.compiled_tile import TermSum
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.evidence import Weights
from l2m_gtsam.maps.harmonic.family import Family, Hyperparameters, UniformField
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.modes import CEILING, FLOOR, modes_up_to
from l2m_gtsam.maps.harmonic.tiles import Tile
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.maps.harmonic.triangular import TriangularFactor

PRIOR = Hyperparameters(
    floor_scale=3.0,
    floor_depth=0.7,
    ceiling_scale=1.5,
    ceiling_depth=1.2,
    structure_scale=0.1,
    noise=0.2,
)
SIZE, HEIGHT = np.array([5.0, 5.0]), 1.0
RNG = np.random.default_rng(0)
POSTS = RNG.uniform(0, 5, (2, 7, 3))


def dipoles(positions: FloatArray) -> Dipoles:
    """Return sources whose moments are mixed into fewer weights."""
    mixed, _ = np.linalg.qr(RNG.normal(size=(3 * len(positions), len(positions))))
    return Dipoles(positions, mixed)


FAMILIES: dict[str, tuple[Family, ...]] = {
    "uniform": (UniformField(50.0),),
    "floor": (modes_up_to(FLOOR, SIZE, 0.0, 6.0),),
    "ceiling": (modes_up_to(CEILING, SIZE, HEIGHT, 3.0),),
    "sources": (dipoles(POSTS[0]), dipoles(POSTS[1])),
}
FAMILIES["all"] = tuple(family for each in list(FAMILIES.values()) for family in each)


@pytest.mark.parametrize("name", list(FAMILIES))
def test_the_terms_add_up_to_the_basis(name: str) -> None:
    basis = Basis(TileFrame(np.eye(3), np.zeros(3), SIZE, HEIGHT), FAMILIES[name])
    m = len(basis)
    weights = Weights(
        np.random.default_rng(1).normal(size=m), np.ones(m), TriangularFactor.of(np.eye(m))
    )
    tile = Tile(basis, weights, PRIOR, Resolution(6.0, 3.0))
    places = np.random.default_rng(2).uniform([-1, -1, -0.5], [6, 6, 2], (40, 3))
    # At a source and so near to one that its field is that at the distance where it is capped.
    places = np.concatenate([places, POSTS[0, :2], POSTS[1, :2] + 3e-4])
    field, gradient = TermSum.of(tile).field_and_gradient(places)
    expected = basis.field_and_gradient(places, weights.mean)
    # Sums of hundreds of terms in another order; near a source its own dwarfs the others.
    for found, truth in ((field, expected[0]), (gradient, expected[1])):
        scale = np.abs(truth).reshape(len(places), -1).max(axis=1)
        error = np.abs(found - truth).reshape(len(places), -1).max(axis=1)
        assert (error <= 1e-11 * np.maximum(scale, 1.0)).all()
