"""What a harmonic map was learnt from as plain arrays, and back with checks."""

from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import TypeAdapter, ValidationError

from l2m_gtsam.data import FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.grid import grid_from
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.history import History
from l2m_gtsam.maps.harmonic.learnt import ORIGIN, HarmonicOptions, Learnt, reach_of
from l2m_gtsam.maps.harmonic.structure import MOST_SOURCES, Sources
from l2m_gtsam.maps.harmonic.tiling import LEAST_CORE, Resolution, Tiling, blend_of
from l2m_gtsam.maps.suite_errors import SHIFT, SIZE, FoundErrors, SuiteErrors
from l2m_gtsam.maps.survey_poses import POSE, SurveyPoses
from l2m_gtsam.maps.trained import first_complaint, options_from_state, state_array
from l2m_gtsam.maps.training import FURTHEST, TrainingSet, training_set
from l2m_gtsam.records.map_diary import MapDiary

SAFE = 1.5  # times the modes that a tile of a file may have
LEAST_SIZE = 0.4 * LEAST_CORE  # equal tiles over an extent may be half as large as the least core
# Given hyperparameters may lie outside the bounds of learning; powers and squares of these are
# still far from the ends of float64.
LEAST, MOST = 1e-9, 1e9
MOST_CELL = 2**31  # tiles along an axis
DIARY = TypeAdapter(MapDiary)
SHORTEST, LONGEST = 1e-3, 1e9  # seconds that an error of a pose lasts, and that a drive takes
ROUNDING = 1e-9  # of a covariance's largest entry


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
    if (suite := learnt.suite) is not None:
        # Three digits are enough for an error; names go with the facts.
        arrays |= {
            "suite_covariance": suite.covariance,
            "suite_pairs": np.stack([suite.reading, suite.sensor]),
            "suite_shift": suite.shift.astype(np.float32),
        }
        if suite.found is not None:
            arrays |= {"suite_mean": suite.found.mean, "suite_stated": suite.found.stated}
        origin |= {"suite_sensors": list(suite.sensors)}
    if (history := learnt.history) is not None:
        arrays |= {
            "drive": history.drive,
            "step_cells": history.cells,
            "steps": np.stack([history.shares, history.depths]),
            "freed": history.freed,
        }
        origin |= {"diary": DIARY.dump_python(history.diary, mode="json")}
    if (poses := learnt.poses) is not None:
        arrays |= {
            "pose_pairs": np.stack([poses.reading, poses.drive]),
            "pose_seconds": poses.seconds,
            "pose_shift": poses.shift.astype(np.float32),
            "pose_lasting": np.array([poses.lasting_s]),
            "pose_stated": np.array([int(poses.stated)]),
            "pose_sizes": np.ones(POSE) if poses.sizes is None else poses.sizes,
        }
    return MapState(kind, arrays, options.model_dump(mode="json"), origin)


def learnt_from_state(state: MapState) -> tuple[Learnt, HarmonicOptions]:
    """Return what ``learnt_to_state`` took apart; the state may come from an untrusted file.

    Raises
    ------
    MapError
        If an array or an entry is missing, of the wrong shape, or makes no sense.
    """
    options = options_from_state(state, HarmonicOptions)
    hyperparameters = hyperparameters_from_state(state)
    try:
        origin = ORIGIN.validate_python(state.provenance)
    except ValidationError as error:
        raise damaged("state is", first_complaint(error)) from None
    readings = training_set(*(state_array(state, name) for name in ("points", "field", "weight")))
    sources, strengths = sources_from_state(state)
    resolution = resolution_from_state(state)
    tiling = tiling_from_state(state, readings, resolution, options)
    learnt = Learnt(
        readings,
        hyperparameters,
        sources,
        strengths,
        tiling,
        resolution,
        options.effective_local,
        origin,
        suite_from_state(state, len(readings)),
        history_from_state(state, len(readings), len(strengths)),
        poses_from_state(state, len(readings)),
    )
    return learnt, options


def damaged(what: str, complaint: str) -> MapError:
    """Return the error for a part of a state that makes no sense, such as ``tiling is``."""
    return MapError(f"map {what} damaged: {complaint}; build the map again")


def credible(values: FloatArray) -> bool:
    """Return whether all values are positive numbers that can be computed with."""
    return bool(((values >= LEAST) & (values <= MOST)).all())  # false for NaN


def hyperparameters_from_state(state: MapState) -> Hyperparameters:
    """Return the prior of a state after checks."""
    names, values = sorted(Hyperparameters.model_fields), state_array(state, "hyperparameters")
    if values.shape != (len(names),):
        raise damaged("hyperparameters are", f"shape {values.shape}, ({len(names)},) is needed")
    for name, value in zip(names, values, strict=True):
        if not credible(value):
            complaint = f"{name} is {value:g}, {LEAST:g} to {MOST:g} is accepted"
            raise damaged("hyperparameters are", complaint)
    return Hyperparameters(**dict(zip(names, values.tolist(), strict=True)))


def resolution_from_state(state: MapState) -> Resolution:
    """Return the largest wave numbers of a state after checks."""
    waves = state_array(state, "resolution")
    if waves.shape != (2,) or not credible(waves):
        raise damaged("resolution is", f"two wave numbers of {LEAST:g} to {MOST:g} 1/m are needed")
    return Resolution(*waves.tolist())


def tiling_from_state(
    state: MapState, readings: TrainingSet, resolution: Resolution, options: HarmonicOptions
) -> Tiling:
    """Return how the tiles of a state lie, after checks."""
    place = state_array(state, "tiling")
    if place.shape != (3,) or not np.isfinite(place).all():
        raise damaged("tiling is", "three finite numbers are needed")
    corner, size, surroundings = place[:2], float(place[2]), options.tiling
    if np.abs(corner).max() > FURTHEST:  # the corner was that of readings
        raise damaged("tiling is", f"its origin lies further than {FURTHEST:g} m")
    if not LEAST_SIZE <= size <= FURTHEST:
        complaint = f"a tile is {size:g} m, {LEAST_SIZE:g} to {FURTHEST:g} m is accepted"
        raise damaged("tiling is", complaint)
    edge = size + 2 * (surroundings.overlap + surroundings.margin)
    if resolution.modes(edge) > SAFE * options.modes:
        raise damaged("tiling is", "tiles and waves do not fit the number of modes")
    grid = grid_from(corner, readings.points, size, reach_of(size, options))
    blend = blend_of(size, surroundings)
    return Tiling(grid, surroundings.overlap, surroundings.margin, blend)


def sources_from_state(state: MapState) -> tuple[Sources, FloatArray]:
    """Return the sources of a state and the strengths of their structures, after checks."""
    positions, number, strengths = (
        state_array(state, name) for name in ("sources", "structure", "strengths")
    )
    flat = number.ndim == strengths.ndim == 1 and (np.abs(number) < MOST_SOURCES).all()
    if not flat or positions.shape != (number.size, 3) or number.size > MOST_SOURCES:
        raise damaged("sources are", "their arrays do not have the shapes needed")
    structure = number.astype(np.int64)
    fits = np.isfinite(positions).all() and bool((structure >= 0).all())
    numbered = np.array_equal(np.unique(structure), np.arange(len(strengths)))
    if not (fits and numbered and ((strengths >= 0) & (strengths <= MOST)).all()):
        raise damaged("sources are", "positions, structures and strengths disagree")
    return Sources(positions, structure), strengths


def suite_from_state(state: MapState, count: int) -> SuiteErrors | None:
    """Return what errors of the sensors do to so many readings, after checks; none in most maps."""
    if "suite_covariance" not in state.arrays:
        return None
    names = state.provenance.get("suite_sensors")
    covariance, pairs, shift = (
        state_array(state, f"suite_{name}") for name in ("covariance", "pairs", "shift")
    )
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise damaged("suite is", "its sensors have no names")
    size = SIZE * len(names)
    if (
        covariance.shape != (size, size)
        or pairs.ndim != 2
        or shift.shape != (*pairs.shape[1:], SHIFT, SIZE)
        or len(pairs) != 2
    ):
        raise damaged("suite is", "its arrays do not have the shapes needed")
    numbers = pairs.astype(np.int64)
    most = np.array([[count], [len(names)]])
    if not ((numbers >= 0).all() and (numbers < most).all() and (numbers == pairs).all()):
        raise damaged("suite is", "its readings or sensors do not exist")
    if not np.isfinite(shift).all():
        raise damaged("suite is", "an effect is not finite")
    check_covariance(covariance)
    found = found_from_state(state, size)
    return SuiteErrors(tuple(names), covariance, numbers[0], numbers[1], shift, found)


def found_from_state(state: MapState, size: int) -> FoundErrors | None:
    """Return what so many errors of sensors were found to be, after checks; none in most maps."""
    if "suite_mean" not in state.arrays:
        return None
    mean, stated = state_array(state, "suite_mean"), state_array(state, "suite_stated")
    if mean.shape != (size,) or stated.shape != (size, size) or not np.isfinite(mean).all():
        raise damaged("suite is", "what was found of it does not have the shape needed")
    check_covariance(stated)
    return FoundErrors(mean, stated)


def check_covariance(covariance: FloatArray) -> None:
    """Raise an error unless a square matrix is a covariance."""
    if not (np.isfinite(covariance).all() and np.array_equal(covariance, covariance.T)):
        raise damaged("suite is", "its covariance is none")
    if np.linalg.eigvalsh(covariance).min() < -ROUNDING * np.abs(covariance).max():
        raise damaged("suite is", "its covariance has a negative direction")


def history_from_state(state: MapState, count: int, structures: int) -> History | None:
    """Return what so many readings went through, after checks; none in most maps."""
    if "drive" not in state.arrays:
        if "diary" in state.provenance:
            raise damaged("diary is", "it is of another map, this one knows of no drives")
        return None
    try:
        diary = DIARY.validate_python(state.provenance.get("diary"))
    except ValidationError as error:
        raise damaged("diary is", first_complaint(error)) from None
    drive, cells, steps, freed = (
        state_array(state, name) for name in ("drive", "step_cells", "steps", "freed")
    )
    drives = len(diary.drives)
    if (
        drive.shape != (count,)
        or cells.shape[1:] != (2,)
        or freed.shape[1:] != (2,)
        or steps.shape != (2, len(cells), drives)
    ):
        raise damaged("history is", "its arrays do not have the shapes needed")
    if not ((drive >= 0) & (drive < drives)).all():
        raise damaged("history is", "a reading is of a drive that there was not")
    if not ((freed >= 0) & (freed < [structures, drives])).all():
        raise damaged("history is", "a structure or a drive that changed is none of the map's")
    shares, depths = steps
    if not (
        (np.abs(cells) <= MOST_CELL).all()
        and ((shares >= 0) & (shares <= 1)).all()
        and ((depths >= 0) & (depths <= MOST)).all()
    ):
        raise damaged("history is", "a step is none, or of a tile that is nowhere")
    whole = [each.astype(np.int64) for each in (drive, cells, freed)]
    return History(whole[0], whole[1], shares, depths, whole[2], diary)


def poses_from_state(state: MapState, count: int) -> SurveyPoses | None:
    """Return what errors of poses do to so many readings, after checks; none in older maps."""
    if "pose_pairs" not in state.arrays:
        return None
    pairs, seconds, shift, lasting, stated, sizes = (
        state_array(state, f"pose_{name}")
        for name in ("pairs", "seconds", "shift", "lasting", "stated", "sizes")
    )
    if (
        pairs.ndim != 2
        or len(pairs) != 2
        or seconds.shape != pairs.shape[1:]
        or shift.shape != (*seconds.shape, SHIFT, POSE)
        or lasting.shape != (1,)
        or stated.shape != (1,)
        or sizes.shape != (POSE,)
    ):
        raise damaged("poses are", "their arrays do not have the shapes needed")
    numbers = pairs.astype(np.int64)
    fits = (numbers >= 0).all() and (numbers[0] < count).all() and (numbers == pairs).all()
    if not (fits and (numbers[1] <= len(seconds)).all()):
        raise damaged("poses are", "their readings or drives do not exist")
    if not (np.isfinite(shift).all() and (np.abs(seconds) <= LONGEST).all()):
        raise damaged("poses are", "an effect or a time is not finite")
    if not (SHORTEST <= lasting[0] <= LONGEST and ((sizes >= 0) & (sizes <= MOST)).all()):
        raise damaged("poses are", "their sizes make no sense")
    known = bool(stated[0])
    return SurveyPoses(
        numbers[0], numbers[1], seconds, shift, float(lasting[0]), known, None if known else sizes
    )
