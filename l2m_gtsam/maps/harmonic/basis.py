"""All families of features of one tile, in the map frame: modes as fine as needed, and sources."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l2m_gtsam.data import FieldAndGradient, FloatArray
from l2m_gtsam.maps.harmonic.dipoles import Dipoles, moment_features
from l2m_gtsam.maps.harmonic.family import Family, Hyperparameters, UniformField, WeightPrior
from l2m_gtsam.maps.harmonic.frame import TileFrame, tile_frame
from l2m_gtsam.maps.harmonic.modes import CEILING, FLOOR, Modes, modes_up_to
from l2m_gtsam.maps.harmonic.structure import Sources
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.solve.linear_algebra import leading_eigenvectors

BATCH = 512  # points whose features are in memory, and about in cache, at once
UNIFORM_SIGMA = 100.0  # microtesla; the Earth's field is at most 65
# A combination of moments whose information is this much below the best of its structure's is
# left out. The strongest structures are seen at some thousand times the noise; to learn how
# strong they are, less will do.
FINE, COARSE = 1e-7, 1e-4


@dataclass(frozen=True)
class Basis:
    """Features of a tile: m weights in the order of the families.

    Attributes
    ----------
    frame
        The tile's box and axes in the map frame, metres.
    families
        Families of features, m weights in total, each with its own prior.
    """

    frame: TileFrame
    families: tuple[Family, ...]

    def __len__(self) -> int:
        return self.columns[-1].stop if self.families else 0

    def prior(self, hyperparameters: Hyperparameters) -> WeightPrior:
        """Return the prior of all weights."""
        priors = [family.prior(hyperparameters) for family in self.families]
        log_variance = np.concatenate([np.empty(0), *(prior.log_variance for prior in priors)])
        slopes: dict[str, FloatArray] = {}
        m = len(self)
        for columns, prior in zip(self.columns, priors, strict=True):
            for name, slope in prior.slopes.items():
                slopes.setdefault(name, np.zeros(m))[columns] = slope
        return WeightPrior(log_variance, slopes)

    def features(self, points: FloatArray) -> FloatArray:
        """Return the field of each weight in the map frame, uT per unit, shape (N, 3, m)."""
        return np.ascontiguousarray(self.rows(points, np.ones(len(self))).transpose(2, 1, 0))

    def rows(self, points: FloatArray, units: FloatArray) -> FloatArray:
        """Return the field in uT that so many units of each weight make, weight by weight.

        Parameters
        ----------
        points
            In the map frame in metres, shape (N, 3).
        units
            Factor of each weight's field, shape (m,).

        Returns
        -------
        FloatArray
            Along the axes of the map frame, shape (m, 3, N): a weight's numbers lie together, as
            solves with the factor of their covariance want them.
        """
        local = self.frame.localise(points)
        rows = np.empty((len(self), 3, len(points)))
        for columns, family in zip(self.columns, self.families, strict=True):
            family.write_rows(local, units[columns], rows[columns])
        R = self.frame.R_map_tile
        return rows if np.array_equal(R, np.eye(3)) else R @ rows

    def field_and_gradient(self, points: FloatArray, weights: FloatArray) -> FieldAndGradient:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m in the map frame."""
        field, gradient = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
        R = self.frame.R_map_tile
        for at in batches(len(points)):
            local = self.frame.localise(points[at])
            parts = [
                family.field_and_gradient(local, weights[columns])
                for family, columns in zip(self.families, self.columns, strict=True)
            ]
            field[at] = sum(part[0] for part in parts) @ R.T
            # A gradient turns with the field's components and with the direction of the derivative.
            gradient[at] = R @ sum(part[1] for part in parts) @ R.T
        return field, gradient

    @cached_property
    def columns(self) -> tuple[slice, ...]:
        """Columns of each family."""
        ends = np.cumsum([len(family) for family in self.families]).tolist()
        return tuple(slice(end - len(f), end) for end, f in zip(ends, self.families, strict=True))


@dataclass(frozen=True)
class WaveBasis(Basis):
    """The uniform field, and floor and ceiling waves of a box."""

    families: tuple[UniformField | Modes, ...]

    @classmethod
    def over(cls, frame: TileFrame, resolution: Resolution) -> "WaveBasis":
        """Return all waves of a box that are so long at least; a weak side has none."""
        floor = modes_up_to(FLOOR, frame.size, 0.0, resolution.floor)
        ceiling = modes_up_to(CEILING, frame.size, frame.height, resolution.ceiling)
        waves = [side for side in (floor, ceiling) if len(side)]
        return cls(frame, (UniformField(UNIFORM_SIGMA), *waves))

    def by_points(self, points: FloatArray, by_features: FloatArray) -> FloatArray:
        """Return the derivative of a scalar by points (N, 3), of one by features (N, 3, m)."""
        local, R = self.frame.localise(points), self.frame.R_map_tile
        own = R.T @ by_features
        found = np.zeros_like(points)
        for columns, family in zip(self.columns, self.families, strict=True):
            found += family.by_points(local, np.ascontiguousarray(own[:, :, columns]))
        return np.asarray(found @ R.T)


def batches(count: int) -> Iterator[slice]:
    """Yield slices that cover so many points."""
    for start in range(0, count, BATCH):
        yield slice(start, min(start + BATCH, count))


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
    floor = modes_up_to(FLOOR, frame.size, 0.0, resolution.floor)
    ceiling = modes_up_to(CEILING, frame.size, frame.height, resolution.ceiling)
    families: tuple[Family, ...] = (UniformField(UNIFORM_SIGMA), floor, ceiling, *dipoles)
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
