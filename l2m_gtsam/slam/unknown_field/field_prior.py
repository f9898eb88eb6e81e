"""What is known of the field of an unknown place before it is mapped: how strong, how rough."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters
from l2m_gtsam.maps.harmonic.learning import LearningOptions, learn
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.structure import NO_SOURCES
from l2m_gtsam.maps.harmonic.tiling import Resolution, resolution_of, surveyed_area
from l2m_gtsam.maps.training import merged, training_set
from l2m_gtsam.options import Options


class TileOptions(Options):
    """The tiles that an unknown field is described by; lengths in metres."""

    core: float = Field(default=3.0, gt=0.5, le=20)
    """A place belongs to a tile if it is within half of this of the pose the tile is fixed to,
    along both axes of that pose."""
    margin: float = Field(default=0.75, gt=0, le=5)
    """The box of a tile's waves reaches so far beyond its core."""
    modes: int = Field(default=200, ge=30, le=1000)
    """The most waves of a tile. What shorter ones would hold counts as noise."""
    learn_over_m: float = Field(default=20.0, gt=0)
    """The way from the start whose readings teach strength and depth of the sources: over it
    odometry has to be better than the field's detail."""
    hyperparameters: Hyperparameters | None = None
    """Strength and depth, where they are known; not learnt then."""

    @property
    def edge(self) -> float:
        """Edge of a tile's box in metres."""
        return self.core + 2 * self.margin


@dataclass(frozen=True)
class FieldPrior:
    """The prior of every tile of an unknown field.

    Attributes
    ----------
    hyperparameters
        Strength and depth of the sources.
    resolution
        Shortest waves that are kept.
    options
        Core, margin.
    """

    hyperparameters: Hyperparameters
    resolution: Resolution
    options: TileOptions


def field_prior(points: FloatArray, field: FloatArray, options: TileOptions) -> FieldPrior:
    """Learn the prior from readings at places that are known well enough.

    Parameters
    ----------
    points, field
        Places in metres and the field there in uT, in one frame, shapes (N, 3).
    options
        Of the tiles.

    Raises
    ------
    MapError
        There are too few readings.
    """
    defaults = HarmonicOptions()
    readings = merged(training_set(points, field), defaults.merge, defaults.independent)
    hyperparameters = options.hyperparameters
    if hyperparameters is None:
        learning = LearningOptions(modes=options.modes)
        tiling, share = defaults.tiling, defaults.mode_share
        hyperparameters = learn(readings, NO_SOURCES, tiling, share, learning).hyperparameters
    density = float(readings.weight.sum()) / surveyed_area(readings.points)
    wanted = resolution_of(hyperparameters, density, defaults.mode_share)
    return FieldPrior(hyperparameters, within_budget(wanted, options), options)


def within_budget(resolution: Resolution, options: TileOptions) -> Resolution:
    """Return the resolution, coarser where a tile would have more waves than allowed."""
    over = float(np.sqrt(max(resolution.modes(options.edge) / options.modes, 1.0)))
    return Resolution(resolution.floor / over, resolution.ceiling / over)
