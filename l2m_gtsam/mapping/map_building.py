"""Recordings of a mapping suite -> map. Pure: no files, no terminal."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, KnownSensor, Recording
from l2m_gtsam.errors import MapError
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.mapping.shifts import suite_errors, survey_poses
from l2m_gtsam.mapping.steady_survey import SteadySurvey, steady_survey
from l2m_gtsam.mapping.suite_calibration import suite_doubts
from l2m_gtsam.mapping.suite_drive import parameters_of, refuse_stuck
from l2m_gtsam.mapping.suite_likelihood import undistorted
from l2m_gtsam.maps.build import KINDS, build_map
from l2m_gtsam.maps.compare import MapComparison, compare_maps
from l2m_gtsam.maps.field_map import FieldMap, check_frame, framed
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.suite_errors import SuiteErrors
from l2m_gtsam.maps.survey_poses import SurveyPoses
from l2m_gtsam.maps.training import checked_readings, errors_together
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import Progress
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.recording.saturation import saturation_doubts
from l2m_gtsam.recording.sync import SyncOptions, synchronise, with_offsets


@dataclass(frozen=True)
class SurveyReadings:
    """What sensors of a suite read, in the map frame.

    Attributes
    ----------
    points, field
        Where, in metres, and what, in uT, shapes (N, 3).
    stamp_ns
        When, in nanoseconds, shape (N,).
    suite
        What errors of the sensors do to that.
    poses
        What errors of the poses do to that; absent where they count as exact.
    doubts
        What speaks against the readings, a sentence each.
    """

    points: FloatArray
    field: FloatArray
    stamp_ns: IntArray
    suite: SuiteErrors
    poses: SurveyPoses | None = None
    doubts: tuple[str, ...] = ()

    def followed_by(self, other: "SurveyReadings") -> "SurveyReadings":
        """Return these readings and others."""
        return SurveyReadings(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.field, other.field]),
            np.concatenate([self.stamp_ns, other.stamp_ns]),
            self.suite.followed_by(other.suite, len(self.points)),
            errors_together(self.poses, other.poses, len(self.points)),
            self.doubts + other.doubts,
        )


@one_blas_thread()
def map_recordings(
    recordings: Sequence[Recording],
    suite: Mapping[str, KnownSensor] | None,
    options: MappingOptions,
    cloud: FloatArray | None = None,
) -> FieldMap:
    """Build a map from one or several drives of a suite whose calibration is known.

    Parameters
    ----------
    recordings
        Drives with poses in one map frame.
    suite
        Position and distortion of every sensor by name; None means that all are ideal and sit at
        the lidar's origin.
    options
        Which readings enter, and the kind of map.
    cloud
        Structure that a LiDAR saw: points of the map frame in metres, shape (M, 3).

    Raises
    ------
    MapError
        Recordings in different frames, a sensor that the suite does not list, no map from
        these readings, or a kind that has no use for a structure cloud.
    SyncError
        Readings and poses of a recording do not overlap.
    """
    steady = steady_survey(recordings, suite, options.suite)
    return map_of(steady, suite, options, cloud)


@one_blas_thread()
def map_of(
    steady: SteadySurvey,
    suite: Mapping[str, KnownSensor] | None,
    options: MappingOptions,
    cloud: FloatArray | None = None,
) -> FieldMap:
    """Build a map from drives that are corrected already; otherwise as ``map_recordings``."""
    recordings = steady.recordings
    read = suite_readings(recordings, suite, options.sync, options.pose_noise)
    field_map = build_map(read.points, read.field, options.model, cloud, read.suite, read.poses)
    field_map = framed(field_map, recordings[0].trajectory.frame)
    if isinstance(field_map, HarmonicMap):
        field_map = field_map.doubted((*steady.doubts, *read.doubts))
    # Errors that are stated or found are counted; sensors that count as exact have to look like it,
    # and so do those of which nothing is known: what is found of them may be the least part.
    unknown = suite is None or all(each.is_ideal for each in suite.values())
    if isinstance(field_map, HarmonicMap) and (unknown or field_map.learnt.suite is None):
        return field_map.doubted(suite_doubts(recordings, suite, options.suite))
    return field_map


@one_blas_thread()
def update_map(
    field_map: FieldMap,
    recordings: Sequence[Recording],
    suite: Mapping[str, KnownSensor] | None,
    options: MappingOptions,
) -> FieldMap:
    """Return a map with the readings of more drives; its kind and its prior stay as they are.

    Parameters
    ----------
    field_map
        In the frame of the recordings' poses.
    recordings, suite
        As in ``map_recordings``.
    options
        Which readings enter.

    Raises
    ------
    MapError, SyncError
        As in ``map_recordings``.
    """
    for each in recordings:
        check_frame(field_map, each)
    steady = steady_survey(recordings, suite, options.suite)
    read = suite_readings(steady.recordings, suite, options.sync, options.pose_noise)
    if isinstance(field_map, HarmonicMap):
        updated = field_map.updated(read.points, read.field, read.suite, read.poses)
        return updated.doubted((*steady.doubts, *read.doubts))
    return field_map.updated(read.points, read.field)


@one_blas_thread()
def compare_recordings(
    recordings: Sequence[Recording],
    suite: Mapping[str, KnownSensor] | None,
    options: MappingOptions,
    cloud: FloatArray | None,
    progress: Progress,
) -> MapComparison:
    """Compare the kinds of maps that drives of a suite could become, each with its options.

    Parameters
    ----------
    recordings, suite
        As in ``map_recordings``.
    options
        Which readings enter, the options of each kind, and how readings are held out.
    cloud
        Structure in the map frame in metres, shape (M, 3), for the kind that can use it.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    MapError, SyncError
        As in ``map_recordings``, or the readings fill too few patches.
    """
    steady = steady_survey(recordings, suite, options.suite)
    read = suite_readings(steady.recordings, suite, options.sync, options.pose_noise)
    built = dict.fromkeys(options.compare.kinds, 0)

    def build(points: FloatArray, field: FloatArray, kind: str) -> FieldMap:
        stage = f"building {kind} maps"
        progress(stage, built[kind] / options.compare.folds)
        model = options.model.model_copy(update={"kind": kind})
        field_map = build_map(points, field, model, cloud if KINDS[kind].uses_structure else None)
        built[kind] += 1
        progress(stage, built[kind] / options.compare.folds)
        return field_map

    return compare_maps(read.points, read.field, options.compare, build)


@one_blas_thread()
def suite_readings(
    recordings: Sequence[Recording],
    suite: Mapping[str, KnownSensor] | None,
    sync: SyncOptions,
    pose_noise: PoseNoiseOptions | None = None,
) -> SurveyReadings:
    """Return what a suite read, in the map frame; see ``map_recordings``."""
    frames = sorted({recording.trajectory.frame for recording in recordings})
    if len(frames) > 1:
        named = ", ".join(f"{r.source.path} in {r.trajectory.frame!r}" for r in recordings)
        msg = f"the recordings' poses are in different frames: {named}; one map frame is needed"
        raise MapError(msg)
    drives = [survey_readings(each, suite, sync, pose_noise) for each in recordings]
    read = reduce(SurveyReadings.followed_by, drives)
    checked_readings(read.points, read.field)
    return read


def survey_readings(
    recording: Recording,
    suite: Mapping[str, KnownSensor] | None,
    sync: SyncOptions,
    pose_noise: PoseNoiseOptions | None = None,
) -> SurveyReadings:
    """Return what a suite read in one drive, however little, in the order of its readings."""
    known = [listed_sensor(series.sensor, suite, recording) for series in recording.series]
    offset = np.array([each.time_offset for each in known])
    synchronised = synchronise(recording, sync, float(np.abs(offset).max(initial=0.0)))
    readings = synchronised.readings
    refuse_stuck(readings, recording)
    readings = with_offsets(readings, recording.trajectory, offset)
    undone = undistorted(readings, np.stack([parameters_of(each) for each in known]))
    points, field = undone.points, undone.field
    poses = survey_poses(recording.trajectory, readings, points, field, pose_noise)
    doubts = saturation_doubts(readings.sensors, [each.limits for each in synchronised.counts])
    errors = suite_errors(readings, known, undone)
    return SurveyReadings(points, field, readings.stamp_ns, errors, poses, doubts)


def listed_sensor(
    name: str, suite: Mapping[str, KnownSensor] | None, recording: Recording
) -> KnownSensor:
    """Return a sensor of a recording as its suite has it; a MapError if that does not list it."""
    if suite is None:
        return KnownSensor.ideal(name)
    if name not in suite:
        msg = (
            f"{recording.source.path}: the suite does not list the sensor {name!r}; it lists "
            f"{', '.join(sorted(suite))} (choose sensors with `bag.fields`)"
        )
        raise MapError(msg)
    return suite[name]
