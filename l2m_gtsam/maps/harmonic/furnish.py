"""From a box to its basis: modes as fine as needed, and the sources in it."""

from collections.abc import Sequence

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import Basis, batches
from l2m_gtsam.maps.harmonic.dipoles import Dipoles, moment_features
from l2m_gtsam.maps.harmonic.family import Family, UniformField
from l2m_gtsam.maps.harmonic.frame import TileFrame, tile_frame
from l2m_gtsam.maps.harmonic.modes import CEILING, FLOOR, modes_up_to
from l2m_gtsam.maps.harmonic.structure import Sources
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.solve.linear_algebra import leading_eigenvectors

UNIFORM_SIGMA = 100.0  # microtesla; the Earth's field is at most 65
# A combination of moments whose information is this much below the best of its structure's is
# left out. The strongest structures are seen at some thousand times the noise; to learn how
# strong they are, less will do.
FINE, COARSE = 1e-7, 1e-4


def basis_of(
    readings: TrainingSet,
    centre: FloatArray,
    edge: float,
    resolution: Resolution,
    structures: Sequence[Sources],
    strengths: FloatArray,
    visible: float = FINE,
) -> Basis:
    """Return the basis of a box around a centre (x, y) for the readings in it.

    Parameters
    ----------
    readings
        Readings in the box, map frame, metres and uT.
    centre, edge
        Centre (x, y) of the box in the map frame, shape (2,), and its edge, metres.
    resolution
        Largest wave numbers of floor and ceiling in 1/m.
    structures, strengths
        Structures in or near the box, and the strength of each.
    visible
        Of ``dipoles_of``.
    """
    frame = tile_frame(readings.points, centre, edge)
    dipoles = [
        dipoles_of(sources, readings, frame, strength, visible)
        for sources, strength in zip(structures, strengths, strict=True)
    ]
    return basis_with(frame, resolution, dipoles)


def basis_with(frame: TileFrame, resolution: Resolution, dipoles: Sequence[Dipoles]) -> Basis:
    """Return the basis of a box with these sources."""
    families: list[Family] = [UniformField(UNIFORM_SIGMA)]
    families.append(modes_up_to(FLOOR, frame.size, 0.0, resolution.floor))
    families.append(modes_up_to(CEILING, frame.size, frame.height, resolution.ceiling))
    families += dipoles
    return Basis(frame, tuple(family for family in families if len(family)))


def dipoles_of(
    sources: Sources, readings: TrainingSet, frame: TileFrame, strength: float, visible: float
) -> Dipoles:
    """Return the sources of a structure in the combinations that these readings can see.

    Combinations of moments are kept whose information exceeds that of the best one times
    ``visible``.
    """
    positions = frame.localise(sources.positions)
    points = frame.localise(readings.points)
    information = np.zeros((3 * len(positions),) * 2)
    for at in batches(len(points)):
        F = moment_features(points[at], positions) * np.sqrt(readings.weight[at])[:, None, None]
        F = F.reshape(-1, 3 * len(positions))
        information += F.T @ F
    return Dipoles(positions, leading_eigenvectors(information, visible), strength)
