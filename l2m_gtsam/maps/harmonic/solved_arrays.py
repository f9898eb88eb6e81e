"""A solved tile as plain arrays, and back with checks.

Kept is what took long: the posterior, the tile's own scales, and the combinations of moments that
its readings see. Box, waves and places of sources follow from the map.
"""

import numpy as np
from pydantic import ValidationError

from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.evidence import Weights
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.furnish import basis_with
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters
from l2m_gtsam.maps.harmonic.kept_arrays import finite
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.harmonic.tile import Tile
from l2m_gtsam.maps.harmonic.triangular import TriangularFactor, count
from l2m_gtsam.maps.tile_store import Arrays
from l2m_gtsam.maps.trained import first_complaint

NAMES = tuple(sorted(Hyperparameters.model_fields))


def solved_to_arrays(tile: Tile) -> Arrays:
    """Return a tile as arrays."""
    own = tile.hyperparameters
    dipoles = [family for family in tile.basis.families if isinstance(family, Dipoles)]
    return {
        "hyperparameters": np.array([getattr(own, name) for name in NAMES]),
        "mean": tile.weights.mean,
        "prior_sigma": tile.weights.prior_sigma,
        "factor": tile.weights.factor.values,
        # By columns, as they lie in memory: products with them are then the same to the last bit.
        **{f"combinations{k}": each.combinations.T for k, each in enumerate(dipoles)},
    }


def solved_from_arrays(learnt: Learnt, index: int, arrays: Arrays) -> Tile:
    """Return the tile of a map that ``solved_to_arrays`` took apart.

    Raises
    ------
    MapError
        If an array is missing, of the wrong shape, or makes no sense.
    """
    frame = learnt.frame(index)
    basis = basis_with(frame, learnt.resolution, dipoles_from(learnt, index, frame, arrays))
    m = len(basis)
    factor = TriangularFactor(m, finite(arrays, "factor", (count(m),)))
    weights = Weights(finite(arrays, "mean", (m,)), finite(arrays, "prior_sigma", (m,)), factor)
    if not all((block.inverse.diagonal() > 0).all() for block in factor.blocks):
        raise MapError("factor is not that of a covariance")
    return Tile(basis, weights, hyperparameters_from(arrays), learnt.resolution)


def dipoles_from(
    learnt: Learnt, index: int, frame: TileFrame, arrays: Arrays
) -> tuple[Dipoles, ...]:
    """Return the sources of a tile in the combinations that were kept."""
    return tuple(
        Dipoles(
            frame.localise(each.positions),
            finite(arrays, f"combinations{k}", (None, 3 * len(each))).T,
            strength,
        )
        for k, (each, strength) in enumerate(zip(*learnt.structures(index), strict=True))
    )


def hyperparameters_from(arrays: Arrays) -> Hyperparameters:
    """Return the scales and depths of a tile."""
    values = finite(arrays, "hyperparameters", (len(NAMES),))
    try:
        return Hyperparameters(**dict(zip(NAMES, values.tolist(), strict=True)))
    except ValidationError as error:
        raise MapError(first_complaint(error)) from None
