"""A map kept up by drives of a calibrated vehicle through a place that changes.

Sources that a drive shows are told as what happened: steel came, went or was moved, and when.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive, with_calibration
from l2m_gtsam.calibration.averages import averaged
from l2m_gtsam.calibration.budget.found import NOTHING_FOUND
from l2m_gtsam.calibration.changed_places import ChangesOptions, suspected
from l2m_gtsam.calibration.coverage import errors_over_stated
from l2m_gtsam.calibration.drive_sources import drive_sources, offset_gain
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.sensor_columns import SENSOR
from l2m_gtsam.calibration.view import places_of
from l2m_gtsam.data import FloatArray, KnownSensor, Readings, Recording
from l2m_gtsam.errors import MapError
from l2m_gtsam.mapping.map_building import listed_sensor, suite_readings
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.mapping.steady_survey import steady_survey
from l2m_gtsam.maps.field_map import FieldMap, check_frame
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.renewal import DriveReadings, renewed
from l2m_gtsam.maps.sources.found_sources import price
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.training import additional_set
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.recording.sync import synchronise, with_offsets
from l2m_gtsam.records.map_diary import UNDATED, MapDiary, MapDrive
from l2m_gtsam.records.places import CLEAR, ChangedSource
from l2m_gtsam.records.provenance import dated
from l2m_gtsam.upkeep.dated_changes import dated_changes

# Sensors are not known better than this, whatever is stated: metres, no unit, uT and seconds.
LEAST_SIGMA = np.array([1e-3] * 3 + [5e-4] * 9 + [0.02] * 3 + [1e-4])


@dataclass(frozen=True)
class SeenSources:
    """What a drive shows beside a map.

    Attributes
    ----------
    sources
        That came since, or went: those have the opposite of their moment.
    gain
        What they explain, less what their parameters cost.
    vehicle
        What other offsets of the sensors explain, alike all along the drive; likewise.
    """

    sources: tuple[ChangedSource, ...]
    gain: float
    vehicle: float

    @property
    def of_vehicle(self) -> bool:
        """Whether it was the sensors that changed, rather than the place."""
        return self.vehicle > max(self.gain, 0.0) + CLEAR


def estimate_of(known: Sequence[KnownSensor], noise: float) -> Estimate:
    """Return S known sensors, each with a noise in uT, as a solve has them."""
    return Estimate(
        t=np.stack([each.t_lidar_mag for each in known]),
        distortion=np.stack([each.distortion.vector() for each in known]),
        noise=np.full(len(known), noise),
        ridge=np.zeros(len(known)),
        offset=np.array([each.time_offset for each in known]),
    )


def seen_sources(
    readings: Readings,
    known: Sequence[KnownSensor],
    field_map: HarmonicMap,
    options: ChangesOptions,
) -> SeenSources:
    """Return the sources that explain what readings of known sensors differ from a map by.

    Parameters
    ----------
    readings
        With their poses at the sensors' time offsets.
    known
        The S sensors, in the readings' order.
    options
        How to look.
    """
    estimate = estimate_of(known, field_map.learnt.hyperparameters.noise)
    # Where no reading of the map is near, what it misses is no change.
    readings = readings.select(field_map.query(places_of(readings, estimate.t)).inside)
    if not len(readings):
        return SeenSources((), 0.0, 0.0)
    every = np.ones(len(readings), dtype=np.bool_)
    nearest = options.sources.nearest
    averages = averaged(readings, field_map, estimate, every, options.averaging, nearest)
    drive = AveragedDrive.of(averages, field_map, estimate)
    places = suspected(drive, field_map, options.averaging)
    # What a map misses that does not know its own errors is no change.
    if not len(places) or errors_over_stated(field_map) > 1:
        return SeenSources((), 0.0, 0.0)
    free = drive.marginal(field_map, field_map, NOTHING_FOUND, options.averaging)
    rows = with_calibration(free, covariances(known))
    shown = drive_sources(rows, drive, places, field_map, options.sources)
    along = np.ones(len(rows), dtype=np.bool_)
    vehicle = offset_gain(shown.rows, drive, along)
    vehicle = max(vehicle, calibration_gain(rows, free, len(known)))
    return SeenSources(shown.changed(), shown.gain, vehicle)


def calibration_gain(known: MarginalRows, free: MarginalRows, sensors: int) -> float:
    """Return what other calibrations of so many sensors explain (a BIC).

    The rows are of sensors as they are calibrated, and of any sensors.
    """
    as_calibrated, as_any = (each.pull(each.residual)[1] for each in (known, free))
    return as_calibrated - as_any - price(free, SENSOR * sensors)


def covariances(known: Sequence[KnownSensor]) -> FloatArray:
    """Return how well sensors are known, shape (S, 16, 16)."""
    least = np.diag(LEAST_SIGMA**2)
    return np.stack(
        [least if each.covariance is None else each.covariance + least for each in known]
    )


@one_blas_thread()
def kept_up(
    field_map: FieldMap,
    recordings: Sequence[Recording],
    suite: Mapping[str, KnownSensor],
    options: MappingOptions,
    changes: ChangesOptions,
    survey: MapDrive = UNDATED,
) -> HarmonicMap:
    """Return a map after drives, each of which may have found steel that came or went.

    Parameters
    ----------
    field_map
        In the frame of the recordings' poses.
    recordings
        Drives, later than all that the map has been given.
    suite
        The calibrated sensors by name.
    options
        Which readings enter.
    changes
        How sources are looked for.
    survey
        When the map was surveyed, if it does not know of it.

    Raises
    ------
    MapError
        The kind of map keeps no steel, a drive is in another frame, has no date or is earlier than
        the map, or its sensors are not as they are calibrated.
    SyncError
        Readings and poses of a recording do not overlap.
    """
    if not isinstance(field_map, HarmonicMap):
        raise MapError(
            f"a map of kind {field_map.kind} keeps no readings of its survey; --changes needs one "
            "of kind harmonic"
        )
    for each in recordings:
        check_frame(field_map, each)
    vehicle = MappingVehicle(suite, options, changes)
    drives = [(date_of(each), each) for each in recordings]
    for drive, recording in sorted(drives, key=lambda each: str(each[0].begun)):
        field_map = after_drive(field_map, vehicle, recording, drive, survey)
    return field_map


@dataclass(frozen=True)
class MappingVehicle:
    """A vehicle by whose drives a map is kept up.

    Attributes
    ----------
    suite
        Its calibrated sensors by name.
    options
        Which of their readings enter.
    changes
        How sources are looked for.
    """

    suite: Mapping[str, KnownSensor]
    options: MappingOptions
    changes: ChangesOptions

    def shows(self, recording: Recording, field_map: HarmonicMap) -> SeenSources:
        """Return what a drive shows beside a map."""
        known = [listed_sensor(each.sensor, self.suite, recording) for each in recording.series]
        offset = np.array([each.time_offset for each in known])
        latest = float(np.abs(offset).max())
        readings = synchronise(recording, self.options.sync, latest).readings
        readings = with_offsets(readings, recording.trajectory, offset)
        return seen_sources(readings, known, field_map.compile(), self.changes)

    def kept(
        self,
        field_map: HarmonicMap,
        recording: Recording,
        drive: MapDrive,
        seen: SeenSources,
        survey: MapDrive,
    ) -> HarmonicMap:
        """Return a map after a drive that shows some sources; otherwise as ``after_drive``."""
        read = suite_readings([recording], self.suite, self.options.sync)
        found = dated_changes(field_map, seen.sources, diary_of(field_map, survey))
        stated = read.suite if read.suite.stated else None
        later = DriveReadings(additional_set(read.points, read.field), stated, drive)
        return renewed(field_map, later, found, survey).doubted(read.doubts)


def after_drive(
    field_map: HarmonicMap,
    vehicle: MappingVehicle,
    recording: Recording,
    drive: MapDrive,
    survey: MapDrive,
) -> HarmonicMap:
    """Return a map after one drive; see ``kept_up``."""
    check_order(recording, drive, diary_of(field_map, survey))
    steady = steady_survey([recording], vehicle.suite, vehicle.options.suite)
    (recording,) = steady.recordings
    seen = vehicle.shows(recording, field_map)
    if seen.of_vehicle:
        raise MapError(
            f"{recording.source.path}: its sensors do not read as they are calibrated, wherever "
            "they are; see `l2m validate`, and calibrate them anew"
        )
    return vehicle.kept(field_map, recording, drive, seen, survey).doubted(steady.doubts)


def diary_of(field_map: HarmonicMap, survey: MapDrive) -> MapDiary:
    """Return what a map was given so far; of one that does not know, its survey alone."""
    history = field_map.learnt.history
    return MapDiary((survey,)) if history is None else history.diary


def date_of(recording: Recording) -> MapDrive:
    """Return when a recording was made.

    Raises
    ------
    MapError
        Its stamps are no dates.
    """
    drive = drive_dates(recording)
    if drive == UNDATED:
        begun = int(recording.trajectory.stamp_ns.min()) // 10**9
        raise MapError(
            f"{recording.source.path}: its stamps begin at {begun} s, which is no date of this "
            "century: --changes dates what changed; record with a clock that is set, or leave "
            "--changes out"
        )
    return drive


def check_order(recording: Recording, drive: MapDrive, diary: MapDiary) -> None:
    """Raise a MapError for a drive before one that the map has been given."""
    known = [each.ended for each in diary.drives if each.ended is not None]
    if known and drive.begun is not None and drive.begun < max(known):
        raise MapError(
            f"{recording.source.path} was driven at {drive.begun}, the map is of {max(known)}: "
            "changes are dated drive by drive; give drives in the order of their dates"
        )


def drive_dates(*recordings: Recording) -> MapDrive:
    """Return first and last pose of drives; undated if a stamp is no date of this century."""
    begun = min(int(each.trajectory.stamp_ns.min()) for each in recordings)
    ended = max(int(each.trajectory.stamp_ns.max()) for each in recordings)
    return dated(begun, ended)
