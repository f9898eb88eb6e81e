"""A drive localised as it is driven: in a map, without one, or from a start that is to be found.

Odometry, readings and scan registrations are given one by one; what is known of each key pose comes
back when it is made. Nothing is kept that grows with the drive, but in an unknown field each past
key pose relative to its tile.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap, for_solvers
from l2m_gtsam.data import FloatArray, Trajectory, joined_rows
from l2m_gtsam.errors import CalibrationError, ConfigError
from l2m_gtsam.lidar.registration import PoseEstimate
from l2m_gtsam.maps.field_map import Surveyed
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.localisation import StartVerdict
from l2m_gtsam.records.scans import Scan
from l2m_gtsam.slam.drive import EXACT_START, StartPose, as_transform
from l2m_gtsam.slam.held_calibration import with_calibration_use
from l2m_gtsam.slam.localisation import known_sensors, left_out, start_pose, why_unusable
from l2m_gtsam.slam.online.arguments import refuse_unusable
from l2m_gtsam.slam.online.belief import Belief
from l2m_gtsam.slam.online.branches import Branch, BranchedFollower, GapDoubt
from l2m_gtsam.slam.online.calibration_watch import CalibrationWatch
from l2m_gtsam.slam.online.events import EventKind, OnlineEvent
from l2m_gtsam.slam.online.explained_readings import ExplainedReadings
from l2m_gtsam.slam.online.follower import Follower
from l2m_gtsam.slam.online.intake import Intake
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose, drive_of, renumbered
from l2m_gtsam.slam.online.odometry_pose import OdometryPose, trajectory_of
from l2m_gtsam.slam.online.online_pose import OnlinePose
from l2m_gtsam.slam.online.scan_matching import LoopMatcher, ScanLinks, ScanMatcher
from l2m_gtsam.slam.online.start_search import StartSearchState
from l2m_gtsam.slam.online.step_doubts import StepDecision
from l2m_gtsam.slam.options import SlamOptions, refuse_offline_only
from l2m_gtsam.slam.slips import FAR_M
from l2m_gtsam.slam.start.search import GROWTH, find_start, start_found
from l2m_gtsam.slam.unknown_field.explorer import Explorer
from l2m_gtsam.slam.unknown_field.one_field_explorer import OneFieldExplorer

WEAKLY_HELD = (
    "one sensor in an unknown field holds the path weakly: poses come to be better only where the "
    "vehicle returns; localise the recorded drive off line for the best, or give a map"
)
IMPOSSIBLE = (
    "readings put the vehicle further from odometry than its drift, as stated, can have: poses "
    "follow odometry until the field is learnt anew"
)
Estimator = BranchedFollower | Explorer | OneFieldExplorer


class OnlineSlam:
    """Localises a vehicle while it drives.

    Parameters
    ----------
    calibration
        Of its sensors.
    options
        As of a localisation off line. ``start.anywhere`` searches the map for the start.
    field_map
        Map; without one the field is found with the poses.
    matcher
        Registers scans on the cloud of the map or, where there is none, on those of earlier visits;
        without it scans take no part.

    Attributes
    ----------
    field_map
        The map in its form for solvers, if there is one.

    Raises
    ------
    InputError
        The calibration, the options or the map is something else.
    CalibrationError
        No sensor is calibrated.
    ConfigError
        An option works off line only, or needs a map.
    """

    def __init__(
        self,
        calibration: CalibrationResult,
        options: SlamOptions,
        field_map: QueryableMap | None = None,
        matcher: ScanMatcher | LoopMatcher | None = None,
    ) -> None:
        refuse_unusable(calibration, options, field_map)
        reasons = {each.sensor: why_unusable(each) for each in calibration.sensors}
        usable = tuple(each for each in calibration.sensors if not reasons[each.sensor])
        if not usable:
            told = "; ".join(left_out(name, reason) for name, reason in reasons.items())
            raise CalibrationError(f"no sensor has a calibration that can be used: {told}")
        self._one_field = field_map is None and matcher is None and len(usable) == 1
        refuse_offline_only(options, has_map=field_map is not None, one_field=self._one_field)
        self.sensors = self.given_sensors = known_sensors(usable)
        self.options = with_calibration_use(options, self.sensors, one_field=self._one_field)
        self.field_map = None if field_map is None else for_solvers(field_map)
        self.matcher = matcher
        axes = None if field_map is None else np.array([1.0, 1.0, options.drift.of_height])
        # The axes of the one field are the first key pose's, of which none need be vertical.
        axes = np.ones(3) if self._one_field else axes
        self.intake = Intake(self.sensors, options, axes, reasons)
        self.estimator: Estimator | None = None
        self.search: StartSearchState | None = None
        self.base, self.stamp_ns = 0, 0  # number of the first key pose, time of the last
        self._explained = ExplainedReadings()
        self._events: list[OnlineEvent] = []
        self.watch = CalibrationWatch(self.sensors, self._follower)

    @one_blas_thread()
    def add_odometry(self, pose: OdometryPose) -> tuple[OnlinePose, ...]:
        """Take a pose of odometry, and return the key poses that are made by it.

        Raises
        ------
        CalibrationError
            The system is too badly scaled to be solved.
        MapError
            There are too few readings to learn a prior of the field from.
        """
        self.intake.add_odometry(pose)
        return tuple(self._advance(to_the_end=False))

    def add_reading(self, stamp_ns: int, sensor: str, field_ut: FloatArray) -> None:
        """Take a reading in uT, shape (3,)."""
        self.intake.add_reading(stamp_ns, sensor, field_ut)

    def add_scan(self, scan: Scan) -> None:
        """Take a scan; it takes part where there is something that registers it."""
        if self.matcher is not None:
            self.intake.add_scan(scan)

    @one_blas_thread()
    def finish(self) -> tuple[OnlinePose, ...]:
        """Make key poses of all that is there, solve for them, and return the last anew.

        Raises
        ------
        CalibrationError, MapError
            As of ``add_odometry``.
        """
        found = [*self._advance(to_the_end=True)]
        if self.estimator is None:
            if self.search is not None:
                found += self._searched(self.search, at_end=True)
            if self.estimator is None:
                return tuple(found)
        last = OnlinePose.of(self.stamp_ns, self.estimator.finish())
        self._report_decided(self.estimator)
        return (*(each for each in found if each.stamp_ns < last.stamp_ns), last)

    def events(self) -> tuple[OnlineEvent, ...]:
        """Return what happened since the last call, in order."""
        found, self._events = [*self.intake.events(), *self._events], []
        return tuple(sorted(found, key=lambda each: each.stamp_ns))

    def _advance(self, *, to_the_end: bool) -> Iterator[OnlinePose]:
        for key_pose in self.intake.key_poses(to_the_end=to_the_end):
            if self.estimator is None and self.search is None:
                self._begin()
            yield from self._added(self.watch.counting(renumbered(key_pose, self.base)))

    def _begin(self) -> None:
        """Begin at the first key pose, which is the first that waits."""
        start_options, first = self.options.start, trajectory_of(self.intake.state.poses[:1])
        if start_options.anywhere:
            self.search = self._search_from(first, [])
            return
        start = start_pose(first, start_options)
        if self.field_map is None:
            if not start_options.is_given:
                start = replace(start, covariance=EXACT_START)
            if self._one_field:
                self.estimator = OneFieldExplorer(start, self.sensors, self.options)
                self._report(EventKind.ONE_SENSOR, WEAKLY_HELD)
            else:
                self.estimator = Explorer(start, self.sensors, self.options)
            return
        self._follow(start)

    def _follow(self, start: StartPose) -> None:
        """Follow the drive in the map from a start."""
        self.watch.begun(start)
        self.estimator = self._follower(start)

    def _search_from(self, first: Trajectory, waiting: list[ArrivedKeyPose]) -> StartSearchState:
        window_m = self.options.start.search.window_m
        return StartSearchState(start_pose(first, self.options.start), waiting, window_m)

    def _follower(self, start: StartPose) -> BranchedFollower:
        follower = Follower(start, self.sensors, self.known_map(), self.options)
        return BranchedFollower(Branch(follower))

    def known_map(self) -> QueryableMap:
        """Return the map.

        Raises
        ------
        ConfigError
            There is none.
        """
        if self.field_map is None:
            raise ConfigError("a map is needed for this: give one with --map")
        return self.field_map

    def _added(self, key_pose: ArrivedKeyPose) -> Iterator[OnlinePose]:
        """Yield the key poses that are known by a new one."""
        following = isinstance(self.estimator, BranchedFollower)
        if key_pose.lost and following and isinstance(self.field_map, Surveyed):
            self._lose(key_pose)
            return
        if self.search is not None and key_pose.lost:
            self._begin_search(key_pose)  # no pattern of readings reaches over it
            return
        if self.search is not None:
            # No pose is followed yet, which could be so both ways.
            one_way = replace(key_pose, recorded=None) if key_pose.is_over_gap else key_pose
            self.search.waiting.append(one_way)
            if self.search.is_silent():
                self._begin_search(key_pose)
                return
            yield from self._searched(self.search, at_end=False)
            return
        pose = self._estimated(key_pose)
        if self.search is None:  # else it is the first of a search
            yield pose

    def _lose(self, key_pose: ArrivedKeyPose) -> None:
        """Search for the place of a key pose that odometry does not know, with what is known."""
        if self.estimator is not None:
            belief = self.estimator.finish()
            self.sensors = belief.known_sensors
        self.estimator, self.stamp_ns = None, key_pose.stamp_ns
        self._begin_search(key_pose)
        text = "the place of the vehicle is lost with odometry: it is searched for in the map"
        self._report(EventKind.START_OPEN, text)

    def _begin_search(self, key_pose: ArrivedKeyPose) -> None:
        """Search from a key pose on, which becomes the first."""
        self.base += key_pose.number
        links = renumbered(key_pose, key_pose.number).links
        anew = ArrivedKeyPose.first(key_pose.stamp_ns, links)
        self.search = self._search_from(trajectory_of(self.intake.state.poses[:1]), [anew])

    def _estimated(self, key_pose: ArrivedKeyPose) -> OnlinePose:
        estimator, self.stamp_ns = self.estimator, key_pose.stamp_ns
        if isinstance(estimator, Explorer | OneFieldExplorer):
            return OnlinePose.of(key_pose.stamp_ns, self._explored(estimator, key_pose))
        if estimator is None:
            raise ConfigError("the drive has not begun")
        before = estimator.best
        seen, used, refused = before.seen, before.used, before.fixes_refused
        key_pose = self._with_fixes(estimator, key_pose)
        belief, best = estimator.add(key_pose), estimator.best
        self.watch.followed(key_pose)
        if best.fixes_refused > refused:
            text = "a scan is left out: it contradicts odometry and readings"
            self._report(EventKind.SCAN_REFUSED, text)
        if key_pose.is_over_gap:
            self._explained.forget()
        if found := self._explained.add(best.seen - seen, best.used - used):
            self._report(*found)
        if better := self.watch.left_out(belief.known_sensors):
            self.estimator = estimator = better.follower
            belief = estimator.belief
            self._report(EventKind.CALIBRATION_REFUTED, better.moved.note())
        for each in self.watch.refuted(belief.known_sensors):
            self._report(EventKind.CALIBRATION_REFUTED, each.warning())
        wrong = self._wrong_over_gaps(estimator)
        if any(each.off_m > FAR_M for each in wrong) and isinstance(self.field_map, Surveyed):
            self._lose(key_pose)
        return OnlinePose.of(key_pose.stamp_ns, belief)

    def _explored(self, explorer: Explorer | OneFieldExplorer, key_pose: ArrivedKeyPose) -> Belief:
        """Return what is known of a key pose without a map."""
        learnt = explorer.is_learnt
        if isinstance(explorer, Explorer):
            key_pose = self._with_loops(explorer, key_pose)
        belief = explorer.add(key_pose)
        self._report_decided(explorer)
        if isinstance(explorer, OneFieldExplorer) and explorer.has_refused():
            self._report(EventKind.CORRECTION_REFUSED, IMPOSSIBLE)
        if explorer.is_learnt and not learnt:
            text = "strength and depth of the field's sources are learnt: poses are corrected"
            self._report(EventKind.FIELD_LEARNT, text)
        return belief

    def _wrong_over_gaps(self, estimator: BranchedFollower) -> list[GapDoubt]:
        """Return gaps whose step readings have just refuted, alone or with all it may have been."""
        if not (estimator.doubts and self._explained.is_telling):
            return []
        if self._explained.are_few:
            return list(estimator.doubts.values())
        decisions = estimator.decisions()
        for each, was_right in decisions:
            self._report_gap(each.stamp_ns, was_right=was_right)
        return [each for each, was_right in decisions if not was_right]

    def _report_decided(self, estimator: Estimator) -> None:
        """Report what the readings say of steps that were in doubt."""
        if isinstance(estimator, OneFieldExplorer):
            for each in estimator.decisions():
                self._report(EventKind.JUMP_DECIDED, decision_text(each, estimator.key_poses))
        elif isinstance(estimator, Explorer):
            for at_ns, was_right in estimator.decisions().items():
                self._report_gap(at_ns, was_right=was_right)

    def _report_gap(self, at_ns: int, *, was_right: bool) -> None:
        was = "right" if was_right else "wrong, or odometry errs by more than it states"
        text = f"the step over the gap of odometry until {1e-9 * at_ns:.3f} s was {was}"
        self._report(EventKind.GAP_DECIDED, f"{text}, by the readings")

    def _with_fixes(self, follower: BranchedFollower, key_pose: ArrivedKeyPose) -> ArrivedKeyPose:
        """Return a key pose with what its scans say of its place in the map."""
        if not isinstance(self.matcher, ScanMatcher) or not key_pose.scans:
            return key_pose
        expected = expected_place(follower.belief, follower.best.expected(key_pose))
        found = self.matcher.fixes(key_pose.scans, key_pose.number, expected, key_pose.length_m)
        return self._linked(key_pose, found)

    def _with_loops(self, explorer: Explorer, key_pose: ArrivedKeyPose) -> ArrivedKeyPose:
        """Return a key pose with what its scans say of its place, by those of earlier visits."""
        if not isinstance(self.matcher, LoopMatcher):
            return key_pose
        expected = expected_place(explorer.belief, key_pose)
        return self._linked(key_pose, self.matcher.loops(key_pose, expected, explorer.estimate))

    def _linked(self, key_pose: ArrivedKeyPose, found: ScanLinks) -> ArrivedKeyPose:
        for text in found.refused:
            self._report(EventKind.SCAN_REFUSED, text)
        return replace(key_pose, links=joined_rows([key_pose.links, found.links]), scans=())

    def _searched(self, search: StartSearchState, *, at_end: bool) -> Iterator[OnlinePose]:
        """Search for the start if the path is long enough; yield all key poses if it is found."""
        waiting, options = search.waiting, self.options.start
        if not search.is_due(at_end=at_end):
            return
        drive = drive_of(waiting, search.first, self.sensors)
        found = find_start(drive, self.known_map(), self.options, silent)
        self.stamp_ns = waiting[-1].stamp_ns
        if found.verdict is StartVerdict.UNIQUE:
            self.search = None
            self._follow(start_found(found, options))
            self._report(EventKind.START_FOUND, found.message)
            for each in waiting:
                yield self._estimated(each)
            return
        self._report(EventKind.START_OPEN, found.message)
        search.window_m *= GROWTH
        if search.window_m > options.search.longest_m or search.is_full:
            # Odometry's errors would blur more: begin anew from here, which bounds the memory, too.
            self._begin_search(waiting[-1])

    def unread_events(self) -> tuple[OnlineEvent, ...]:
        """Return what the next call of ``events`` will return."""
        found = self.events()
        self._events = list(found)
        return found

    def resume_report(self, unread: Sequence[OnlineEvent] = ()) -> None:
        """Report that the drive was resumed, after events that were not read before."""
        self._events += unread
        self._report(EventKind.RESUMED, "goes on from a saved state")

    def report_scans_ignored(self, text: str) -> None:
        """Report why scans take no part."""
        self._report(EventKind.SCAN_REFUSED, text)

    def _report(self, kind: EventKind, text: str) -> None:
        self._events.append(OnlineEvent(self.stamp_ns, kind, text))


def expected_place(before: Belief, key_pose: ArrivedKeyPose) -> PoseEstimate:
    """Return where the key pose after a belief is by odometry."""
    predicted = before.predicted(key_pose.step, key_pose.covariance).marginalize_previous()
    return PoseEstimate(as_transform(predicted.pose), predicted.pose_covariance)


def decision_text(decision: StepDecision, key_poses: Sequence[ArrivedKeyPose]) -> str:
    """Return what the readings say of a jump of odometry."""
    seconds = 1e-9 * key_poses[decision.number].stamp_ns
    was = "motion, as recorded" if decision.was_motion else "a slip: the motion before went on"
    return f"the jump of odometry at {seconds:.3f} s was {was}, by the readings"
