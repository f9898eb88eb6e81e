"""Recorded drives localised on line: message by message, as on a vehicle."""

import resource
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from l2m_gtsam.batch.files import SavedMap, check_not_replaced, map_notes
from l2m_gtsam.batch.maps import write_map
from l2m_gtsam.batch.scan_poses import bag_scans, read_drive_or_follow
from l2m_gtsam.batch.slam import (
    MAP_FILE,
    REFINED_FILE,
    TRAJECTORY_FILE,
    SlamInput,
    calibration_notes,
    map_provenance,
    opened,
    write_refined,
)
from l2m_gtsam.config import Config
from l2m_gtsam.data import FloatArray, Recording, Trajectory
from l2m_gtsam.errors import LidarError, SyncError
from l2m_gtsam.geometry import compose
from l2m_gtsam.lidar.surface import Surface, library
from l2m_gtsam.maps.build import build_map
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.progress import Progress, reported, silent
from l2m_gtsam.qa.metrics.trajectory import ComparedTrajectories, check_truth, truth_record
from l2m_gtsam.recording.sync import interpolated
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.localisation_file import TruthRecord
from l2m_gtsam.records.scans import Scan
from l2m_gtsam.slam.moving_fields import without_moving_fields
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.online.events import OnlineEvent
from l2m_gtsam.slam.online.online_pose import OnlinePose
from l2m_gtsam.slam.online.replay import give, messages, with_scans
from l2m_gtsam.slam.online.saved import resumed_slam, saved_state
from l2m_gtsam.slam.online.scan_matching import LoopMatcher, ScanMatcher
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import CalibrationUse, Usage
from l2m_gtsam.slam.result import refined
from l2m_gtsam.slam.unknown_field.explorer import Explorer
from l2m_gtsam.slam.unknown_field.one_field_explorer import OneFieldExplorer
from l2m_gtsam.storage.files import ensure_folder, source_file
from l2m_gtsam.storage.listed_sensors import read_sensors
from l2m_gtsam.storage.online_log import (
    LogLine,
    OnlineLog,
    logged_trajectory,
    read_log,
    read_state,
    write_state,
)
from l2m_gtsam.storage.point_cloud2 import has_clouds
from l2m_gtsam.storage.pose_files import read_tum
from l2m_gtsam.storage.trajectory_files import write_tum

STATE_FILE = "state.npz"
LOG_FILE = "online.jsonl"
LEAST_POINTS = 20  # of a field that a map can be made of
NS = 1e-9


@dataclass(frozen=True)
class OnlineOutcome:
    """What came of a drive on line.

    Attributes
    ----------
    trajectory
        Key poses as they were known when they were made.
    events
        In order of time.
    cost_s
        Processor time of each key pose in seconds, shape (K,).
    driven_s
        Duration of the drive in seconds.
    peak_mib
        The most memory of the process, recording and map included, in MiB.
    truth
        Comparison with true poses, if they are known.
    notes
        What to know of the calibration that was used, a sentence each.
    """

    trajectory: Trajectory
    events: tuple[LogLine, ...]
    cost_s: FloatArray
    driven_s: float
    peak_mib: float
    truth: TruthRecord | None
    notes: tuple[str, ...] = ()

    @property
    def times_real(self) -> float:
        """How many times faster than it was driven; without what is read and written."""
        return self.driven_s / max(float(self.cost_s.sum()), 1e-9)


def slam_online(
    given: SlamInput, config: Config, out: Path, progress: Progress, *, resume: bool = False
) -> OnlineOutcome:
    """Localise a recorded drive message by message; write poses and events as they come.

    The state is saved beside them at intervals, from which a run that was stopped goes on.

    Parameters
    ----------
    given
        What is read.
    out
        Folder for the results, made if it is missing.
    progress
        Called with a stage and the fraction of it that is done.
    resume
        Whether a run in this folder goes on.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    saved = None if given.map is None else SavedMap.read(given.map)
    calibration = read_sensors(given.calibration)
    check_not_replaced(out / REFINED_FILE, given.calibration)
    truth = None if given.truth is None else read_tum(given.truth)
    recording = read_drive_or_follow(given.bag, config, progress)
    if len(recording.trajectory) < 2:
        raise SyncError(f"{given.bag}: odometry of one pose; two or more are needed")
    if truth is not None:
        check_truth(truth, recording.trajectory, config.slam.max_pose_gap_s, str(given.truth))
    field_map = None if saved is None else opened(saved, recording, config, progress)
    matcher, ignored = _matcher_or_why_not(given.bag, saved, config)
    still = without_moving_fields(recording, calibration, config.slam.regressors)
    begun = _begun(still.calibration, config, field_map, matcher, out, resume=resume)
    if ignored is not None:
        begun.slam.report_scans_ignored(ignored)
    ensure_folder(out)
    with OnlineLog(out / LOG_FILE, begun.lines) as log:
        run = _Run(begun, log, out / STATE_FILE, config.slam.online.save_every_s)
        scans = () if matcher is None else bag_scans(given.bag, config, silent)
        run.drive(still.recording, scans, progress)
    is_refined = begun.slam.options.calibration is CalibrationUse.REFINED
    refined_by = run.last if is_refined else None
    _write_calibration_so_far(refined_by, calibration, given, recording, config, out)
    trajectory = logged_trajectory(run.lines)
    write_tum(out / TRAJECTORY_FILE, trajectory)
    if saved is None:
        source = source_file(given.calibration)
        of_map = map_provenance(recording, calibration, source, "map", config)
        _write_map_so_far(begun.slam, of_map, config, out, progress)
    stamps = recording.trajectory.stamp_ns
    from_first = saved is None and not config.slam.start.is_given
    return OnlineOutcome(
        trajectory,
        tuple(each for each in run.lines if each.event is not None),
        np.array(run.cost_s),
        NS * float(stamps[-1] - max(int(stamps[0]), begun.after_ns)),
        peak_mib(),
        None
        if truth is None
        else _compared(truth, trajectory, recording, config, from_first=from_first),
        (
            *calibration_notes(given.calibration, calibration),
            *(() if saved is None or field_map is None else map_notes(saved, field_map)),
        ),
    )


def peak_mib() -> float:
    """Return the most memory that the process has had; macOS counts it in bytes, Linux in KiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


@dataclass(frozen=True)
class _Begun:
    """A localisation, its log so far, and the time until which it has had messages."""

    slam: OnlineSlam
    lines: tuple[LogLine, ...]
    after_ns: int


def _begun(
    calibration: CalibrationResult,
    config: Config,
    field_map: FieldMap | None,
    matcher: ScanMatcher | LoopMatcher | None,
    out: Path,
    *,
    resume: bool,
) -> _Begun:
    if not resume:
        return _Begun(OnlineSlam(calibration, config.slam, field_map, matcher), (), -1)
    state = read_state(out / STATE_FILE)
    slam = resumed_slam(state, calibration, config.slam, field_map, matcher)
    after = max((each.stamp_ns for each in slam.intake.state.poses), default=-1)
    lines = tuple(each for each in read_log(out / LOG_FILE) if each.stamp_ns <= slam.stamp_ns)
    return _Begun(slam, lines, after)


def _matcher_or_why_not(
    bag: Path, saved: SavedMap | None, config: Config
) -> tuple[ScanMatcher | LoopMatcher | None, str | None]:
    """Return what registers scans; without a map a drive goes on without them, as off line."""
    try:
        return _matcher(bag, saved, config), None
    except LidarError as error:
        if saved is not None:
            raise
        return None, f"point clouds take no part: {error}"


def _matcher(bag: Path, saved: SavedMap | None, config: Config) -> ScanMatcher | LoopMatcher | None:
    """Return what registers the scans of a bag: on the cloud of the map, without a map on others.

    There is none for a bag without clouds, or a map without one.
    """
    slam = config.slam
    if slam.scans is Usage.IGNORED or not has_clouds(bag):
        return None
    if saved is None:
        library("small_gicp")  # or it is missed where the first scan is registered
        return LoopMatcher(config.lidar.loops, slam.drift, slam.robust.largest_of(POSE))
    mapped = saved.state.lidar
    if mapped is None:
        return None
    return ScanMatcher(Surface(mapped.points), config.lidar.localisation, slam.drift)


class _Run:
    """Gives a recording to a localisation, and writes what comes of it."""

    def __init__(self, begun: _Begun, log: OnlineLog, state: Path, save_every_s: float) -> None:
        self._slam, self._after_ns, self._log = begun.slam, begun.after_ns, log
        self._state, self._every_ns = state, round(save_every_s / NS)
        self.lines, self.cost_s = list(begun.lines), list[float]()
        self.last: OnlinePose | None = None

    def drive(self, recording: Recording, scans: Iterable[Scan], progress: Progress) -> None:
        """Give all messages that are later than those that it has had."""
        first, last = (int(each) for each in recording.trajectory.stamp_ns[[0, -1]])
        due = max(first, self._after_ns) + self._every_ns
        spent = 0.0
        later = (each for each in scans if each.stamp_ns > self._after_ns)
        for message in with_scans(messages(recording, self._after_ns), later):
            begin = process_time()
            poses = give(self._slam, message)
            spent += process_time() - begin
            if not poses:
                continue
            self.cost_s += [spent / len(poses)] * len(poses)
            spent = 0.0
            self._write(poses, self._slam.events())
            progress("driving", (message.stamp_ns - first) / max(last - first, 1))
            if message.stamp_ns >= due:
                write_state(self._state, saved_state(self._slam))
                due = message.stamp_ns + self._every_ns
        self._write(self._slam.finish(), self._slam.events())
        write_state(self._state, saved_state(self._slam))
        progress("driving", 1.0)

    def _write(self, poses: Sequence[OnlinePose], events: Sequence[OnlineEvent]) -> None:
        new = [LogLine(each.stamp_ns, event=(each.kind.value, each.text)) for each in events]
        new += [pose_line(each) for each in poses]
        self.last = poses[-1] if poses else self.last
        self._log.add(new)
        self.lines += new


def pose_line(pose: OnlinePose) -> LogLine:
    """Return a pose as a line of the log."""
    own = {"R": pose.T_map_lidar.R, "p": pose.T_map_lidar.t, "covariance": pose.covariance}
    return LogLine(pose.stamp_ns, pose={name: each.tolist() for name, each in own.items()})


def _write_calibration_so_far(
    last: OnlinePose | None,
    before: CalibrationResult,
    given: SlamInput,
    recording: Recording,
    config: Config,
    out: Path,
) -> None:
    """Write the calibration as the last pose that refined it has it; without one there is none."""
    (out / REFINED_FILE).unlink(missing_ok=True)
    if last is None:
        return
    found = replace(
        refined(before, last.sensors),
        bag=recording.source,
        map=None if given.map is None else source_file(given.map),
        options=config.model_dump(mode="json", include={"bag", "lidar", "slam"}),
    )
    write_refined(out, found)


def _write_map_so_far(
    slam: OnlineSlam, provenance: dict[str, Any], config: Config, out: Path, progress: Progress
) -> None:
    """Write the field that was found as a map, if there is enough of it."""
    if not isinstance(slam.estimator, Explorer | OneFieldExplorer):
        return
    points, field = slam.estimator.field_along_path()
    if len(points) < LEAST_POINTS:
        return
    with reported("building the map", progress):
        field_map = build_map(points, field, config.mapping.model)
    write_map(out / MAP_FILE, field_map, provenance, None)


def in_map(odometry: Trajectory, found: Trajectory) -> Trajectory:
    """Return odometry at the same times as found poses, from the first of these on."""
    T_map_odom = compose(found.pose(0), odometry.pose(0).inverse())
    R, p = T_map_odom.R @ odometry.R, odometry.p @ T_map_odom.R.T + T_map_odom.t
    return replace(odometry, R=R, p=p)


def _compared(
    truth: Trajectory, found: Trajectory, recording: Recording, config: Config, *, from_first: bool
) -> TruthRecord | None:
    if not len(found):
        return None
    odometry = in_map(interpolated(recording.trajectory, found.stamp_ns), found)
    tested = ComparedTrajectories(found, odometry, from_first=from_first)
    return truth_record(truth, tested, config.slam.max_pose_gap_s)
