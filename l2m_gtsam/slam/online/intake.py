"""Odometry, readings and scans as they come, made into key poses.

A key pose is made as in a recording (:mod:`l2m_gtsam.slam.odometry`), from the poses and readings
since the one before, after a delay in which late readings may come. What cannot be used is refused
and reported. What waits is bounded: of a parked vehicle every other pose and reading is dropped.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, Readings, RigidTransform, Trajectory
from l2m_gtsam.geometry import between
from l2m_gtsam.recording.sync import at_poses, far_turns, has_pose, interpolated, is_in_turn, twists
from l2m_gtsam.records.scans import Scan, taken_at_once
from l2m_gtsam.slam.drift import steady_share, steady_turn
from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.key_pose_readings import key_pose_readings, thinned_readings
from l2m_gtsam.slam.links import Links
from l2m_gtsam.slam.odometry import FixedStep, odometry_steps
from l2m_gtsam.slam.online.events import EventKind, OnlineEvent
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose, ScanAtKeyPose
from l2m_gtsam.slam.online.odometry_check import SuspectStep, suspect_step, velocity
from l2m_gtsam.slam.online.odometry_pose import OdometryPose, trajectory_of
from l2m_gtsam.slam.online.reading_intake import ReadingIntake
from l2m_gtsam.slam.online.sensor_buffer import SensorBuffer
from l2m_gtsam.slam.online.stamp_order import NS, Held, decided, require_stamp, seconds_ahead
from l2m_gtsam.slam.options import SlamOptions, StepAxes

MOST_SCANS = 8
MOST_POSES = 512  # that wait for a key pose


@dataclass
class IntakeState:
    """All that an intake remembers.

    Attributes
    ----------
    poses
        From the last key pose on.
    sensors
        One for each.
    number
        Of the next key pose.
    suspect
        Steps that are no usual motion, by the time of their end.
    velocity
        Of the last usual step, rad/s and m/s along the axes of the vehicle, (6,); NaN for none.
    last_velocity
        Of the last step, usual or not.
    disordered
        Whether poses out of order were reported and none has come in order since.
    first_R
        Rotation of the first key pose, by odometry, shape (3, 3).
    """

    poses: list[OdometryPose] = field(default_factory=list)
    sensors: list[SensorBuffer] = field(default_factory=list)
    number: int = 0
    suspect: dict[int, SuspectStep] = field(default_factory=dict)
    velocity: FloatArray = field(default_factory=lambda: np.full(6, np.nan))
    last_velocity: FloatArray = field(default_factory=lambda: np.full(6, np.nan))
    disordered: bool = False
    first_R: FloatArray = field(default_factory=lambda: np.eye(3))


class Intake:
    """Makes key poses of what comes.

    Parameters
    ----------
    sensors
        Calibrated sensors.
    options
        Of a localisation.
    drift_axes
        Ratio of a steady drift's standard deviation along each axis to that of `slam.drift`, (3,),
        where the estimator knows one; for others it is part of each step's own error.
    unusable
        Why the calibrations of other sensors cannot be used, clauses by name.
    """

    def __init__(
        self,
        sensors: KnownSensors,
        options: SlamOptions,
        drift_axes: FloatArray | None,
        unusable: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._known, self._options, self._online = sensors, options, options.online
        self._drift_axes = drift_axes
        self._readings = ReadingIntake(sensors.names, unusable)
        self.state = IntakeState(sensors=self._readings.buffers)
        self._looked_at = 1
        self._scans: list[Scan] = []
        self._held: OdometryPose | None = None  # ahead of the last, or older: the next one decides
        self._velocities = self.state.velocity, self.state.last_velocity  # before the last pose
        self._events: list[OnlineEvent] = []

    def events(self) -> list[OnlineEvent]:
        """Return what happened since the last call."""
        found, self._events = [*self._events, *self._readings.events()], []
        return found

    def resume(self, state: IntakeState) -> None:
        """Go on from a state."""
        self.state, self._looked_at = state, 1
        self._readings.buffers = state.sensors
        self._velocities = state.velocity, state.last_velocity

    def add_scan(self, scan: Scan) -> None:
        """Take a scan; the first pose that is no earlier becomes a key pose."""
        poses = self.state.poses
        self._scans.append(scan)
        if poses:
            self._refuse_scans_ahead(poses[-1].stamp_ns)
        late = self.state.number and scan.stamp_ns <= poses[0].stamp_ns
        if late or len(self._scans) > MOST_SCANS:
            del self._scans[-1]
            text = "a scan comes later than its key pose, or too many wait for odometry: left out"
            self._report(scan.stamp_ns, EventKind.SCAN_REFUSED, text)

    def _refuse_scans_ahead(self, last_ns: int) -> None:
        for scan in self._scans:
            if ahead := seconds_ahead(scan.stamp_ns, last_ns):
                text = f"a scan is stamped {ahead:.1f} s ahead of odometry: left out"
                self._report(scan.stamp_ns, EventKind.SCAN_REFUSED, text)
        self._scans = [each for each in self._scans if not seconds_ahead(each.stamp_ns, last_ns)]

    def add_odometry(self, pose: OdometryPose) -> None:
        """Take a pose; one that is no pose, or not later than the last, is refused.

        A pose after a gap, or older than the last, waits for the next one: if that is older than
        the last, too, it is the last whose stamp is wrong.

        Raises
        ------
        InputError
            The stamp is no number of nanoseconds, or an array has another shape.
        """
        require_stamp(pose.stamp_ns)
        pose.require_shapes()
        if not pose.is_rigid:
            text = "a pose of odometry is not finite, or its rotation is none: left out"
            self._report(pose.stamp_ns, EventKind.UNUSABLE, text)
            return
        self._settle(pose.stamp_ns)
        poses = self.state.poses
        if poses and pose.stamp_ns == poses[-1].stamp_ns:
            return  # sent twice
        after_gap_ns = self._options.max_pose_gap_s / NS
        if poses and not 0 < pose.stamp_ns - poses[-1].stamp_ns <= after_gap_ns:
            self._held = pose.proper
            return
        self._append(pose.proper)

    def _settle(self, next_ns: int | None) -> None:
        """Decide by the time of the next pose, if there is one, whether one that is held counts."""
        held, self._held = self._held, None
        if held is None:
            return
        state, last_ns = self.state, self.state.poses[-1].stamp_ns
        match decided(held.stamp_ns, next_ns, last_ns, self._before_ns()):
            case Held.COUNTS:
                self._append(held)
            case Held.IS_AHEAD:
                self._report_ahead(held.stamp_ns)
            case Held.LAST_IS_AHEAD:
                self._take_back()
                self._append(held)
            case Held.IS_LATE:
                if not state.disordered:
                    late = NS * (last_ns - held.stamp_ns)
                    text = f"a pose of odometry is {late:.3f} s older than the one before: left out"
                    self._report(held.stamp_ns, EventKind.OUT_OF_ORDER, text)
                state.disordered = True

    def _before_ns(self) -> float:
        """Return the time of the pose before the last; infinite if the last is a key pose."""
        poses = self.state.poses
        if len(poses) > 1:
            return poses[-2].stamp_ns
        return np.inf if self.state.number else -np.inf

    def _take_back(self) -> None:
        state = self.state
        wrong = state.poses.pop()
        state.suspect.pop(wrong.stamp_ns, None)
        state.velocity, state.last_velocity = self._velocities
        self._looked_at = max(min(self._looked_at, len(state.poses) - 1), 1)
        self._report_ahead(wrong.stamp_ns)

    def _report_ahead(self, stamp_ns: int) -> None:
        text = "a pose of odometry is stamped ahead of those after it: left out"
        self._report(stamp_ns, EventKind.OUT_OF_ORDER, text)

    def _append(self, pose: OdometryPose) -> None:
        state, poses = self.state, self.state.poses
        state.disordered = False
        self._velocities = state.velocity, state.last_velocity
        if poses:
            self._check_step(poses[-1], pose)
        poses.append(pose)
        if len(poses) > MOST_POSES and not state.suspect:
            del poses[1:-1:2]
            self._looked_at = len(poses) - 1

    def add_reading(self, stamp_ns: int, sensor: str, value: FloatArray) -> None:
        """Take a reading in uT, shape (3,); see ``ReadingIntake.add``."""
        poses = self.state.poses
        first_ns = poses[0].stamp_ns if self.state.number else None
        self._readings.add(stamp_ns, sensor, value, first_ns, poses[-1].stamp_ns if poses else None)

    def key_poses(self, *, to_the_end: bool = False) -> Iterator[ArrivedKeyPose]:
        """Yield the key poses that can be made by now; at the end of a drive all of them."""
        if to_the_end:
            self._settle(None)
        while (row := self._next_row(to_the_end)) is not None:
            yield self._made(row)

    def _check_step(self, before: OdometryPose, pose: OdometryPose) -> None:
        """Report a step over a gap, or one that the motion before does not explain."""
        state = self.state
        found = suspect_step(before, pose, state.velocity, self._options)
        if found is not None and found.kind is EventKind.ODOMETRY_JUMP:
            last = state.last_velocity
            if self._options.drift.axes is StepAxes.FIXED:
                found = None  # one that went on with the motion before would shift all that follow
            # A turn that goes on looks like a jump once: its next step is like the one before it.
            elif np.isfinite(last).all() and not suspect_step(before, pose, last, self._options):
                found = None
        step = state.last_velocity = velocity(before, pose)
        if found is None:
            state.velocity = step
            return
        state.suspect[pose.stamp_ns] = found
        if found.kind is EventKind.ODOMETRY_GAP:
            state.velocity = state.last_velocity = np.full(6, np.nan)
        self._report(pose.stamp_ns, found.kind, found.text)

    def _next_row(self, at_end: bool) -> int | None:
        """Return the row among the waiting poses that is the next key pose, if it is time."""
        poses, state = self.state.poses, self.state
        if not poses:
            return None
        if state.number == 0:  # the next pose may say that the stamp of the first is wrong
            return 0 if at_end or len(poses) > 1 else None
        delay = 0 if at_end else round(self._online.delay_s / NS)
        for row in range(self._looked_at, len(poses)):
            if self._is_key_pose(row):
                self._looked_at = row
                return row if poses[row].stamp_ns <= poses[-1].stamp_ns - delay else None
        self._looked_at = max(len(poses) - 1, 1)
        return len(poses) - 1 if at_end and len(poses) > 1 else None

    def _is_key_pose(self, row: int) -> bool:
        poses, options = self.state.poses, self._options.key_poses
        first, T, stamp = poses[0].T, poses[row].T, poses[row].stamp_ns
        turned = (np.sum(T.R * first.R) - 1) / 2 <= np.cos(np.deg2rad(options.angle_deg))
        suspect = stamp in self.state.suspect
        if row + 1 < len(poses):
            suspect = suspect or poses[row + 1].stamp_ns in self.state.suspect
        wanted = any(poses[row - 1].stamp_ns < each.stamp_ns <= stamp for each in self._scans)
        moved = np.linalg.norm(T.t - first.t) >= options.distance_m
        return bool(moved or turned or suspect or wanted)

    def _made(self, row: int) -> ArrivedKeyPose:
        """Make a key pose of a waiting pose, and drop what lies before it."""
        state = self.state
        poses, state.poses = state.poses, state.poses[row:]
        stamp, number, state.number = poses[row].stamp_ns, state.number, state.number + 1
        self._looked_at = 1
        taken = [each for each in self._scans if each.stamp_ns <= stamp]
        self._scans = [each for each in self._scans if each.stamp_ns > stamp]
        suspect = state.suspect.pop(stamp, None)
        if number == 0:
            self._readings.take(stamp)
            state.first_R = poses[row].T.R
            return ArrivedKeyPose.first(stamp, Links.none())
        waiting = self._readings.take(stamp)
        key_pose = recorded = self._between(poses, row, number, waiting)
        if suspect is not None:
            moved = replace(poses[row], T=suspect.end)
            poses = [*poses[:row], moved]
            key_pose = self._between(poses, row, number, waiting)
            covariance = key_pose.covariance + suspect.covariance
            key_pose = replace(key_pose, covariance=covariance, lost=suspect.lost)
            if suspect.doubtful:
                key_pose = replace(key_pose, recorded=recorded)
        if taken:
            key_pose = replace(key_pose, scans=scans_at(taken, trajectory_of(poses), row))
        silent_s = self._online.silent_s + self._online.delay_s
        has_moved = key_pose.length_m >= self._options.key_poses.distance_m
        self._readings.check(stamp, silent_s, moved=has_moved)
        return key_pose

    def _between(
        self, poses: list[OdometryPose], row: int, number: int, waiting: Readings
    ) -> ArrivedKeyPose:
        """Return the key pose at a row of poses that begin at the one before."""
        trajectory, rows = trajectory_of(poses), np.array([0, row])
        options = self._options
        readings = self._placed(waiting, trajectory, rows)
        steps = odometry_steps(trajectory, rows, options.drift)
        if self._drift_axes is None:
            steps = steps.as_walk(options.drift.over_m)
            steady = turning = np.zeros(3)
        else:
            steps = steps.with_scale_as_drift(options.drift.over_m)
            share = steady_share(options.drift, is_stated=steps.stated)[0]
            steady = share * self._drift_axes
            turning = steady_turn(options.drift) * self.state.first_R[2]
        of_key_pose = key_pose_readings(readings, trajectory, rows)
        return ArrivedKeyPose(
            number,
            poses[row].stamp_ns,
            steps.R[0],
            steps.p[0],
            steps.covariance[0],
            replace(of_key_pose, key_pose=np.full(len(readings), number - 1)),
            readings.stamp_ns,
            Links.none(),
            fixed=self._fixed(poses[0].T, poses[row].T),
            steady=steady,
            turning=turning,
        )

    def _fixed(self, before: RigidTransform, after: RigidTransform) -> FixedStep | None:
        """Return a step about the axes of the first key pose, where odometry knows it so."""
        if self._options.drift.axes is not StepAxes.FIXED:
            return None
        back = self.state.first_R.T
        return FixedStep(back @ after.R @ before.R.T @ back.T, back @ (after.t - before.t))

    def _placed(self, waiting: Readings, trajectory: Trajectory, rows: IntArray) -> Readings:
        """Return readings thinned, at poses of odometry, those in gaps of it left out."""
        offset, options = self._known.offset, self._options
        at = waiting.stamp_ns + np.round(offset[waiting.sensor] / NS).astype(np.int64)
        near = has_pose(trajectory, at, options.max_pose_gap_s)
        near &= ~is_in_turn(trajectory.stamp_ns, far_turns(trajectory), at)
        there = waiting[np.flatnonzero(near)]
        taken = thinned_readings(there, trajectory, rows, options.key_poses.readings)
        return at_poses(taken, trajectory, offset)

    def _report(self, stamp_ns: int, kind: EventKind, text: str) -> None:
        self._events.append(OnlineEvent(stamp_ns, kind, text))


def scans_at(scans: Sequence[Scan], trajectory: Trajectory, row: int) -> tuple[ScanAtKeyPose, ...]:
    """Return scans as if taken at once, with their poses relative to that of a row."""
    stamps = np.array([each.stamp_ns for each in scans], dtype=np.int64)
    at, motion = interpolated(trajectory, stamps), twists(trajectory, stamps)
    key = trajectory.pose(row)
    return tuple(
        ScanAtKeyPose(taken_at_once(scan, twist), between(key, at.pose(k)))
        for k, (scan, twist) in enumerate(zip(scans, motion, strict=True))
    )
