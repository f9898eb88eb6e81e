"""A drive with changes and without: what is found, and what it costs."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import FloatArray, KnownSensor, Recording
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.places import ChangedSource
from l2m_gtsam.studies.changes.loads import ChangesStudyOptions, LoadedHall, Loads
from l2m_gtsam.studies.honesty.drives import drive_seed
from l2m_gtsam.studies.validation.drives import NO_STEEL, SECONDS, HallPath, path_of, recorded

NEAR_M = 0.5  # a source so near a change is that change
FAR_M = 1.0  # a source so far from all changes is a false alarm
INSIDE = 7.815  # squared distance within which 95 % of three normal numbers are


@dataclass(frozen=True)
class TrueChange:
    """A source that came or went, and what was found of it.

    Attributes
    ----------
    moment
        Its size in A m^2.
    came
        Whether it came.
    nearest_m, strongest_ut
        Distance of the nearest reading, and its strongest field at one.
    away_m, moment_ratio
        Of the source that was found there: how far off it is, and its moment over the true one
        (along it); None where none was found.
    """

    moment: float
    came: bool
    nearest_m: float
    strongest_ut: float
    away_m: float | None
    moment_ratio: float | None


@dataclass(frozen=True)
class SensorErrors:
    """Errors of a sensor's t in metres, without changes and with, and whether 95 % hold it.

    An error is None where t is not determined.
    """

    clean_m: float | None
    changed_m: float | None
    clean_held: bool
    changed_held: bool


@dataclass(frozen=True)
class ChangesCell:
    """One path through a hall, with five changes and without, or without alone.

    Attributes
    ----------
    hall
        Its seed.
    changes
        The five; none if it was driven without alone.
    false_with, false_without
        Sources that are found far from all changes, and without any.
    hours_with, hours_without
        That it was driven with changes, and without.
    sensors
        Errors of each where it was driven both with changes and without.
    rejected
        Largest share of a sensor's readings that do not count, with changes.
    """

    hall: int
    changes: tuple[TrueChange, ...]
    false_with: int
    false_without: int
    hours_with: float
    hours_without: float
    sensors: tuple[SensorErrors, ...]
    rejected: float


def cell_of(options: ChangesStudyOptions, place: LoadedHall, number: int) -> ChangesCell:
    """Calibrate on one path without changes, and with those that there are on the first paths."""
    path = path_of(options, place.hall, drive_seed(place.seed, number))
    hours, chosen = hours_of(path), CalibrationOptions()
    as_mapped = recorded(options, place.hall, path, place.sensors, NO_STEEL)
    clean = calibrate(as_mapped, place.field_map, chosen)
    unchanged = ChangesCell(place.seed, (), 0, len(clean.sources), 0.0, hours, (), 0.0)
    if number >= len(place.changes):
        return unchanged
    changes = place.changes[number]
    recording = recorded(options, place.hall, path, place.sensors, changes.steel(options))
    changed = calibrate(recording, place.field_map, chosen)
    points = read_at(recording, place.sensors)
    return replace(
        unchanged,
        changes=found_changes(changes, changed.sources, points, options),
        false_with=false_alarms(changed.sources, changes.positions),
        hours_with=hours,
        sensors=tuple(errors_of(each, clean, changed) for each in place.sensors),
        rejected=max(each.rejected for each in changed.sensors) / options.readings,
    )


def hours_of(path: HallPath) -> float:
    """Return how long a path takes."""
    stamps = path.trajectory.stamp_ns
    return float(stamps[-1] - stamps[0]) * SECONDS / 3600


def read_at(recording: Recording, sensors: tuple[KnownSensor, ...]) -> FloatArray:
    """Return where sensors read, map frame, metres, shape (N, 3)."""
    poses, places = recording.trajectory, []
    for sensor, series in zip(sensors, recording.series, strict=True):
        row = np.searchsorted(poses.stamp_ns, series.stamp_ns)
        places.append(poses.R[row] @ sensor.t_lidar_mag + poses.p[row])
    return np.concatenate(places)


def found_changes(
    changes: Loads,
    sources: tuple[ChangedSource, ...],
    points: FloatArray,
    options: ChangesStudyOptions,
) -> tuple[TrueChange, ...]:
    """Return changes with what was found of each: the nearest source."""
    found = []
    for k, (position, moment) in enumerate(zip(changes.positions, changes.moments, strict=True)):
        alone = Loads(changes.positions[k : k + 1], changes.moments[k : k + 1])
        field = np.linalg.norm(alone.steel(options).field(points), axis=1)
        size = float(np.linalg.norm(moment))
        near = [each for each in sources if np.linalg.norm(each.position - position) < NEAR_M]
        near.sort(key=lambda each: float(np.linalg.norm(each.position - position)))
        total = sum((each.moment for each in near), np.zeros(3))
        found.append(
            TrueChange(
                moment=size,
                came=k not in (1, 2),
                nearest_m=float(np.linalg.norm(points - position, axis=1).min()),
                strongest_ut=float(field.max()),
                away_m=float(np.linalg.norm(near[0].position - position)) if near else None,
                moment_ratio=float(total @ moment) / size**2 if near else None,
            )
        )
    return tuple(found)


def false_alarms(sources: tuple[ChangedSource, ...], places: FloatArray) -> int:
    """Return how many sources are far from all changes."""
    return sum(
        bool(np.linalg.norm(places - each.position, axis=1).min() > FAR_M) for each in sources
    )


def errors_of(
    truth: KnownSensor, clean: CalibrationResult, changed: CalibrationResult
) -> SensorErrors:
    """Return the errors of one sensor's t."""
    sizes, held = list[float | None](), list[bool]()
    for result in (clean, changed):
        found = result[truth.sensor]
        e, P = found.t_lidar_mag - truth.t_lidar_mag, found.covariance[:3, :3]
        known = np.isfinite(P).all() and np.isfinite(e).all()
        sizes.append(float(np.linalg.norm(e)) if known else None)
        held.append(bool(known and e @ np.linalg.solve(P, e) < INSIDE))
    return SensorErrors(sizes[0], sizes[1], held[0], held[1])
