"""All metrics of one calibration; and what a drive showed: field directions, headings, heights."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, IntArray, Recording, Trajectory
from l2m_gtsam.qa.metrics.evidence import DriveEvidence, SensorEvidence, sensor_evidence
from l2m_gtsam.qa.metrics.fit import (
    autocorrelation,
    curve_errors,
    curves,
    fit_figures,
    normalised_figures,
    series,
)
from l2m_gtsam.qa.metrics.mounting import mounting
from l2m_gtsam.qa.metrics.plain import evenly, row, rows
from l2m_gtsam.qa.metrics.repeatability import NOT_DONE, SEVERAL, no_halves
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.metrics import Directions, DriveMetrics, MapPicture, Measures, SensorMetrics
from l2m_gtsam.records.repeatability import Halves, Repeatability
from l2m_gtsam.solve.explain import movement

DRAWN = 6000  # readings of all sensors together, so that a report stays small
FEWEST, MOST = 100, 500  # of each
CELLS = 120  # along the longer side of the map's picture
AROUND, MOST_AROUND_M = 0.15, 1.0  # of the drive, on each side: no tile is read for far places
SPHERE = 400  # directions, about 10 degrees apart
NEAR_DEG = 15.0
HEADING_DEG = 15.0
PATH = 800


@dataclass(frozen=True)
class Repeats:
    """Comparisons of parts by sensor: halves of one drive, or several drives."""

    halves: Mapping[str, Halves]
    drives: Mapping[str, Repeatability]


@dataclass(frozen=True)
class SeenSensors:
    """What the map and a calibration make of a drive's readings.

    Attributes
    ----------
    drive
        All readings.
    sensors
        Of each sensor that was solved.
    """

    drive: DriveEvidence
    sensors: dict[str, SensorEvidence]

    @classmethod
    def of(
        cls, result: CalibrationResult, drive: DriveEvidence, field_map: QueryableMap
    ) -> "SeenSensors":
        """Return this of the sensors that were solved."""
        solved = solved_sensors(result)
        return cls(drive, {each.sensor: sensor_evidence(drive, each, field_map) for each in solved})

    @property
    def places(self) -> FloatArray:
        """Where all of them were, metres, shape (N, 3)."""
        return np.concatenate([each.place for each in self.sensors.values()])


def solved_sensors(result: CalibrationResult) -> list[SensorCalibration]:
    """Return the sensors of a calibration that were solved."""
    return [each for each in result.sensors if each.residuals is not None]


def measures_of(
    result: CalibrationResult, seen: SeenSensors, recording: Recording, repeats: Repeats
) -> Measures:
    """Return the figures of all sensors that were solved, and of the drive.

    Parameters
    ----------
    seen
        Its readings.
    recording
        What was calibrated.
    repeats
        Comparisons of parts, as far as there are some.
    """
    solved = solved_sensors(result)
    most = int(np.clip(DRAWN // max(len(solved), 1), FEWEST, MOST))
    start_ns = starts_of(seen.drive)
    sensors = tuple(
        _sensor(each, seen.sensors[each.sensor], repeats, start_ns, most) for each in solved
    )
    bags = tuple(each.source.path for each in recording.drives) or None
    return Measures(sensors, drive_metrics(recording), bags=bags)


def starts_of(evidence: DriveEvidence) -> IntArray:
    """Return the time of the first reading of each drive in nanoseconds, by their number."""
    stamps, drive = evidence.readings.stamp_ns, evidence.readings.of_drive
    start = np.full(int(drive.max()) + 1, np.iinfo(np.int64).max)
    np.minimum.at(start, drive, stamps)
    return start


def _sensor(
    sensor: SensorCalibration,
    evidence: SensorEvidence,
    repeats: Repeats,
    start_ns: IntArray,
    most: int,
) -> SensorMetrics:
    found, drives = curves(evidence, sensor), repeats.drives.get(sensor.sensor)
    halves = repeats.halves.get(sensor.sensor, no_halves(SEVERAL if drives else NOT_DONE))
    return SensorMetrics(
        sensor=sensor.sensor,
        mounting=mounting(sensor),
        fit=fit_figures(evidence, sensor.noise),
        normalised=normalised_figures(evidence),
        autocorrelation=autocorrelation(evidence),
        directions=directions(evidence),
        curves=curve_errors(found, evidence),
        halves=halves,
        series=series(found, evidence, start_ns, most),
        drives=drives,
    )


@dataclass(frozen=True)
class MapSlice:
    """A map at one height.

    Attributes
    ----------
    extent
        Left, right, bottom, top in metres.
    strength
        Of the field in uT, NaN where the map has no data, shape (rows, columns).
    sigma
        Standard deviation of the field per axis in uT, NaN where the map has no data.
    """

    extent: tuple[float, float, float, float]
    strength: FloatArray
    sigma: FloatArray


def slice_map(
    field_map: QueryableMap, low: FloatArray, high: FloatArray, height: float, cells: int
) -> MapSlice:
    """Return a map on a horizontal grid.

    Parameters
    ----------
    low, high
        Corners of the grid, x and y in metres, shape (2,).
    height
        In metres.
    cells
        Along the longer side.
    """
    cell = float((high - low).max()) / cells
    # The longer side is a whole number of cells, of which rounding must not make one more.
    counts = np.ceil((high - low) / cell - 1e-6).astype(int) + 1
    x, y = (low[k] + cell * np.arange(counts[k]) for k in (0, 1))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    sample = field_map.query(np.column_stack([grid, np.full(len(grid), height)]))
    sigma = np.sqrt(np.where(sample.inside[:, None], sample.variance, np.nan).mean(axis=1))
    return MapSlice(
        (float(x[0]), float(x[-1]), float(y[0]), float(y[-1])),
        np.linalg.norm(sample.field, axis=1).reshape(len(y), len(x)),
        sigma.reshape(len(y), len(x)),
    )


def map_picture(field_map: QueryableMap, places: FloatArray) -> MapPicture:
    """Return the map around places, shape (N, 3), at their middle height, coarsely."""
    low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
    around = min(AROUND * max(float((high - low).max()), 1.0), MOST_AROUND_M)
    height = float(np.median(places[:, 2]))
    cut = slice_map(field_map, low - around, high + around, height, CELLS)
    return MapPicture(row(cut.extent, 3), height, rows(cut.strength, 2), rows(cut.sigma, 3))


def directions(evidence: SensorEvidence) -> Directions:
    """Return from which directions the field came, as the map has it along the lidar's axes."""
    b = evidence.b_lidar[evidence.used]
    unit = b / np.linalg.norm(b, axis=1, keepdims=True)
    away, _ = cKDTree(unit).query(sphere(SPHERE))
    elevation = np.rad2deg(np.arcsin(np.clip(unit[:, 2], -1, 1)))
    # Singular values of centred rows over sqrt(N): standard deviations along principal axes.
    spread = np.linalg.svd(b - b.mean(axis=0), compute_uv=False) / np.sqrt(len(b))
    return Directions(
        covered=float(np.mean(away < 2 * np.sin(np.deg2rad(NEAR_DEG) / 2))),
        spread=row(spread, 4),
        tilt_deg=float(np.ptp(elevation)),
    )


def sphere(count: int) -> FloatArray:
    """Return directions spread evenly over all of space, shape (count, 3): a golden spiral."""
    # Equal steps of z cut a sphere into zones of equal area (Archimedes); the golden angle keeps
    # neighbours of successive turns apart.
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    r = np.sqrt(1 - z**2)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


def drive_metrics(recording: Recording) -> DriveMetrics:
    """Return how the vehicle moved, in all drives of a recording together."""
    drives = [each.trajectory for each in recording.parts]
    p, R = (np.concatenate(each) for each in ([d.p for d in drives], [d.R for d in drives]))
    moved = movement(R, p)
    heading = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    sector = np.floor(np.rad2deg(heading) % 360 / HEADING_DEG)
    return DriveMetrics(
        path=rows(_path(drives), 3),
        seconds=float(sum(1e-9 * (d.stamp_ns[-1] - d.stamp_ns[0]) for d in drives)),
        length=float(sum(np.linalg.norm(np.diff(d.p, axis=0), axis=1).sum() for d in drives)),
        heave=moved.heights,
        tilt_deg=moved.tilt,
        heading=float(len(np.unique(sector)) / (360 / HEADING_DEG)),
    )


def _path(drives: list[Trajectory]) -> FloatArray:
    """Return places of the lidar, thinned, with a row of NaN between two drives."""
    most, parts = PATH // len(drives), []
    for drive in drives:
        parts += [np.full((1, 3), np.nan), drive.p[evenly(len(drive), most)]]
    return np.concatenate(parts[1:])
