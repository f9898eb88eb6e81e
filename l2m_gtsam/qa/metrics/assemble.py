"""All metrics of one calibration."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, Recording
from l2m_gtsam.qa.metrics.coverage import directions, drive_metrics
from l2m_gtsam.qa.metrics.evidence import DriveEvidence, Queryable, SensorEvidence, sensor_evidence
from l2m_gtsam.qa.metrics.fit import (
    autocorrelation,
    curve_errors,
    curves,
    fit_figures,
    normalised_figures,
    series,
)
from l2m_gtsam.qa.metrics.mounting import mounting
from l2m_gtsam.qa.metrics.plain import row, rows
from l2m_gtsam.qa.metrics.repeatability import NOT_DONE, SEVERAL, no_halves
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.metrics import Halves, MapPicture, Measures, Repeatability, SensorMetrics

DRAWN = 6000  # readings of all sensors together, so that a report stays small
FEWEST, MOST = 100, 500  # of each
CELLS = 120  # along the longer side of the map's picture
AROUND, MOST_AROUND_M = 0.15, 1.0  # of the drive, on each side: no tile is read for far places


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
        cls, result: CalibrationResult, drive: DriveEvidence, field_map: Queryable
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
    field_map: Queryable, low: FloatArray, high: FloatArray, height: float, cells: int
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


def map_picture(field_map: Queryable, places: FloatArray) -> MapPicture:
    """Return the map around places, shape (N, 3), at their middle height, coarsely."""
    low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
    around = min(AROUND * max(float((high - low).max()), 1.0), MOST_AROUND_M)
    height = float(np.median(places[:, 2]))
    cut = slice_map(field_map, low - around, high + around, height, CELLS)
    return MapPicture(row(cut.extent, 3), height, rows(cut.strength, 2), rows(cut.sigma, 3))
