"""What a harmonic map was learnt from as plain arrays, and back with checks."""

from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from l2m_gtsam.data import FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.grid import grid_from
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters
from l2m_gtsam.maps.harmonic.learnt import ORIGIN, HarmonicOptions, Learnt, reach_of
from l2m_gtsam.maps.harmonic.structure import MOST_SOURCES, Sources
from l2m_gtsam.maps.harmonic.tiling import (
    Resolution,
    Tiling,
    blend_of,
)
from l2m_gtsam.maps.trained import first_complaint, options_from_state, state_array
from l2m_gtsam.maps.training import TrainingSet, training_set

SAFE = 1.5  # times the modes that a tile of a file may have


def learnt_to_state(kind: str, learnt: Learnt, options: HarmonicOptions) -> MapState:
    """Return a map as what its tiles follow from: far smaller than their covariances."""
    values = learnt.hyperparameters.model_dump()
    arrays: dict[str, npt.NDArray[Any]] = {
        "points": learnt.readings.points,
        "field": learnt.readings.field,
        "weight": learnt.readings.weight,
        "hyperparameters": np.array([values[name] for name in sorted(values)]),
        "sources": learnt.sources.positions,
        "structure": learnt.sources.structure,
        "strengths": learnt.strengths,
        "tiling": np.array([*learnt.tiling.grid.origin, learnt.tiling.grid.size]),
        "resolution": np.array([learnt.resolution.floor, learnt.resolution.ceiling]),
    }
    origin = ORIGIN.dump_python(learnt.origin, mode="json")
    return MapState(kind, arrays, options.model_dump(mode="json"), origin)


def learnt_from_state(state: MapState) -> tuple[Learnt, HarmonicOptions]:
    """Return what ``learnt_to_state`` took apart; the state may come from an untrusted file.

    Raises
    ------
    MapError
        If an array or an entry is missing, of the wrong shape, or makes no sense.
    """
    options = options_from_state(state, HarmonicOptions)
    try:
        values = dict(
            zip(
                sorted(Hyperparameters.model_fields),
                state_array(state, "hyperparameters").tolist(),
                strict=True,
            )
        )
        hyperparameters = Hyperparameters(**values)
        origin = ORIGIN.validate_python(state.provenance)
    except ValidationError as error:
        raise MapError(f"map state is damaged: {first_complaint(error)}") from None
    except (TypeError, ValueError):
        raise MapError("map array hyperparameters is not of the shape that is needed") from None
    readings = training_set(*(state_array(state, name) for name in ("points", "field", "weight")))
    sources, strengths = sources_from_state(state)
    tiling, resolution = tiles_from_state(state, readings, options)
    local = options.effective_local
    learnt = Learnt(
        readings, hyperparameters, sources, strengths, tiling, resolution, local, origin
    )
    return learnt, options


def tiles_from_state(
    state: MapState, readings: TrainingSet, options: HarmonicOptions
) -> tuple[Tiling, Resolution]:
    """Return how the tiles of a state lie and what they resolve, after checks."""
    place, waves = state_array(state, "tiling"), state_array(state, "resolution")
    if place.shape != (3,) or waves.shape != (2,) or not np.isfinite([*place, *waves]).all():
        raise MapError("map tiling is damaged: three finite numbers and two are needed")
    size, surroundings = float(place[2]), options.tiling
    resolution = Resolution(float(waves[0]), float(waves[1]))
    edge = size + 2 * (surroundings.overlap + surroundings.margin)
    if min(size, *waves) <= 0 or resolution.modes(edge) > SAFE * options.modes:
        raise MapError("map tiling is damaged: tiles and waves do not fit the number of modes")
    grid = grid_from(place[:2], readings.points, size, reach_of(size, options))
    blend = blend_of(size, surroundings)
    return Tiling(grid, surroundings.overlap, surroundings.margin, blend), resolution


def sources_from_state(state: MapState) -> tuple[Sources, FloatArray]:
    """Return the sources of a state and the strengths of their structures, after checks."""
    positions, number, strengths = (
        state_array(state, name) for name in ("sources", "structure", "strengths")
    )
    flat = number.ndim == strengths.ndim == 1 and np.isfinite(number).all()
    if not flat or positions.shape != (number.size, 3) or number.size > MOST_SOURCES:
        raise MapError("map sources are damaged: their arrays do not have the shapes needed")
    structure = number.astype(np.int64)
    fits = np.isfinite(positions).all() and bool((structure >= 0).all())
    numbered = np.array_equal(np.unique(structure), np.arange(len(strengths)))
    if not (fits and numbered and np.isfinite(strengths).all() and (strengths >= 0).all()):
        raise MapError("map sources are damaged: positions, structures and strengths disagree")
    return Sources(positions, structure), strengths
