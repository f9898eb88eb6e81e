"""The basis and the prior of one tile, as fine and as strong as its own readings ask."""

from dataclasses import dataclass

from l2m_gtsam.data import IntArray
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.evidence import Normal, normal_of
from l2m_gtsam.maps.harmonic.furnish import FINE, with_waves
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.harmonic.local import local_hyperparameters
from l2m_gtsam.maps.harmonic.tiling import Resolution, affordable, finest, resolution_of

ROUNDS = 2  # finer waves may show that still finer ones are needed


@dataclass(frozen=True)
class Suited:
    """A tile before its weights are known.

    Attributes
    ----------
    basis
        Its features.
    normal
        Sums over its readings.
    hyperparameters
        Of its prior.
    resolution
        Of its waves: that of the map, or finer.
    """

    basis: Basis
    normal: Normal
    hyperparameters: Hyperparameters
    resolution: Resolution


def suited(learnt: Learnt, tile: int, rows: IntArray, visible: float = FINE) -> Suited:
    """Return what suits the readings of a tile.

    Steel is not spread evenly under a floor. The map's waves are as fine as most tiles need;
    where a tile's own scales and depths show that its readings tell of finer ones, it gets them.

    Parameters
    ----------
    learnt
        The map.
    tile
        Index of the tile.
    rows
        Of the readings that take part.
    visible
        Of ``dipoles_of``.
    """
    readings, shared = learnt.readings[rows], learnt.hyperparameters
    basis, resolution = learnt.basis(tile, rows, visible), learnt.resolution
    local = learnt.options.effective_local
    normal = normal_of(basis, readings)
    own = local_hyperparameters(basis, normal, shared, local)
    for _ in range(ROUNDS):
        needed = needed_by(learnt, own, resolution)
        if needed == resolution:
            break
        basis, resolution = with_waves(basis, needed), needed
        normal = normal_of(basis, readings)
        own = local_hyperparameters(basis, normal, shared, local)
    return Suited(basis, normal, own, resolution)


def needed_by(learnt: Learnt, own: Hyperparameters, resolution: Resolution) -> Resolution:
    """Return the resolution that a tile needs: the one it has unless much finer is affordable."""
    options = learnt.options
    needed = resolution_of(own, learnt.density, options.mode_share)
    most = max(options.most_modes, options.modes)
    return finest([resolution, affordable(needed, learnt.tiling.edge, most)])
