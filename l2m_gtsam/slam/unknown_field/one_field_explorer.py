"""On-line SLAM of one sensor in an unknown field: one field for all of the drive so far.

A filter follows the drive key pose by key pose. Each time that the path has grown by two fifths, or
by a quarter and has left the box of the field, the drive so far is solved as off line, from its
odometry on (:mod:`.smoothed_drive`), and the filter goes on from what that says of the last key
pose, field and sensor (``end_state``). The work is spread over the key poses that come
meanwhile, which are then followed. To begin the solution at the poses found so far was tried: it
stays near them, and errors on a model ship become half as large or twice as large by chance.

Where the field has more detail than the limit of eigenfunctions holds, the rest counts as noise:
field and noise are learnt at the poses found so far, and the drive is followed from its start. The
same is done where a longer drive than can be solved in the meantime leaves the box.

Where the field changes within less than the pose is known to, the filter may go astray. A pose that
odometry excludes is refused, and the drive goes on by odometry until the drive is solved again. All
key poses with their readings are kept, about a kilobyte of each.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.training import FEWEST
from l2m_gtsam.slam.drive import Drive, KnownSensors, StartPose, as_pose, stacked
from l2m_gtsam.slam.online.belief import POSE, Belief
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose, drive_of
from l2m_gtsam.slam.online.step_doubts import StepDecision, decided
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.field_filter import DeadReckoning, FieldFilter, FilterState
from l2m_gtsam.slam.unknown_field.odometry_hypotheses import Hypotheses, Hypothesis, step_of
from l2m_gtsam.slam.unknown_field.read_path import ReadPath
from l2m_gtsam.slam.unknown_field.smoothed_drive import ON_LINE, end_state, smoothed
from l2m_gtsam.slam.unknown_field.whole_field import COARSE, WholePrior, full_prior, spectrum_at
from l2m_gtsam.solve.chi_square import exceeded_by

GROWN = 1.4  # path, after which the drive is solved again: all takes 3.5 times the last solution
LEFT = 1.25  # the same where the vehicle has left the box, or a correction was refused
NEAR = 1.0  # lengths of the field, to the faces of the box: nearer, these matter
IMPOSSIBLE = float(exceeded_by(1e-6, POSE))  # squared distance from odometry in its sigmas
NEAR_DRIFT = 0.3  # sigmas of odometry's drift, within which a path is linear in it
LEAST, MOST = 20, 1500  # key poses that are solved as a whole; a round of 350 takes two seconds
PIECE = 20  # key poses that are followed anew while one comes


@dataclass(frozen=True)
class SolvedBeginning:
    """The beginning of a drive, solved as a whole.

    Attributes
    ----------
    poses
        Its key poses, in the frame of the field.
    state
        At the last of them.
    recorded
        Numbers of the key poses to which the step was as recorded, of those in doubt.
    """

    poses: tuple[gtsam.Pose3, ...]
    state: FilterState
    recorded: frozenset[int]


@dataclass(frozen=True)
class OneFieldState:
    """What an explorer with one field has to keep.

    Attributes
    ----------
    key_poses
        All so far.
    prior
        Of the field; None where it is not learnt yet.
    beginning
        What was solved in it; None where the drive is followed from its start.
    learnt_m
        Path at which it was learnt, metres.
    decisions
        What steps in doubt were.
    """

    key_poses: tuple[ArrivedKeyPose, ...]
    prior: WholePrior | None
    beginning: SolvedBeginning | None
    learnt_m: float
    decisions: tuple[StepDecision, ...]


@dataclass(frozen=True)
class FollowedField:
    """The field, what was solved in it, the filter, and what the drive may be."""

    prior: WholePrior
    beginning: SolvedBeginning | None
    follows: FieldFilter
    hypotheses: Hypotheses


Pieces = Iterator[FollowedField | float | None]
"""Work in pieces: the last yields the field, those before the share that is done or nothing."""


class OneFieldExplorer:
    """Estimates poses and one field on line from the readings of one sensor.

    Parameters
    ----------
    start, sensors
        Prior of the first key pose, and the sensor.
    options
        As of a localisation.

    Attributes
    ----------
    key_poses
        All so far.
    """

    def __init__(self, start: StartPose, sensors: KnownSensors, options: SlamOptions) -> None:
        self.start, self._sensors, self._options = start, sensors, _of_short_drives(options)
        self._origin = as_pose(start.T_map_lidar)
        self.key_poses: list[ArrivedKeyPose] = []
        self._path_m, self._learnt_m = 0.0, 0.0
        self._read = ReadPath()
        self._reckoned = DeadReckoning.at_start()
        # The same less a drift near that of the estimate.
        self._drifting = DeadReckoning.at_start()
        self._now: FollowedField | None = None
        self._work: Pieces | None = None
        self._open: list[int] = []  # steps in doubt that are not decided
        self._decisions: dict[int, StepDecision] = {}
        self._news: list[StepDecision] = []
        self._has_refused = False

    @property
    def is_learnt(self) -> bool:
        """Whether the prior of the field is learnt; until then poses are those of odometry."""
        return self._now is not None

    def add(self, key_pose: ArrivedKeyPose) -> Belief:
        """Add the next key pose, and return its posterior."""
        key_pose = key_pose.as_mixture
        self.key_poses.append(key_pose)
        self._count_path(key_pose)
        if key_pose.recorded is not None:
            self._open.append(key_pose.number)
        self._dead_reckon(key_pose)
        if self._now is not None:
            self._now = self._after(self._now, key_pose)
            self._decide(self._now.hypotheses)
        if self._work is None:
            self._work = self._due(self._now)
        self._go_on()
        if self._now is not None and not self._is_possible(self._now):
            self._refuse()
        return self._known()

    def finish(self) -> Belief:
        """Return the posterior of the last key pose, with all work done that has begun."""
        if self._now is None and self._work is None and self._read.is_enough:
            self._work = self._learning(None)
        self._complete()
        if self._now is not None and not self._is_possible(self._now):
            self._refuse()
        return self._known()

    def poses(self) -> list[gtsam.Pose3]:
        """Return all key poses, each by the readings until then."""
        if self._now is None:
            return self._drive(len(self.key_poses)).dead_reckoning()
        return [self._origin.compose(each) for each in self._now.hypotheses.best.poses]

    def field_along_path(self) -> tuple[FloatArray, FloatArray]:
        """Return the key poses, m, and the field there, uT, shapes (N, 3)."""
        if self._now is None:
            return np.empty((0, 3)), np.empty((0, 3))
        best, R = self._now.hypotheses.best, self._origin.rotation().matrix()
        axes, points = stacked(best.poses)
        field = self._now.prior.field.field_and_gradient(points, best.state.weights)[0]
        # As a sensor with the given calibration has it, whose readings its readers know.
        found, given = best.state.distortion[0], self._sensors.distortion[0]
        read = np.einsum("nji,nj->ni", axes, field) @ found[:9].reshape(3, 3).T + found[9:]
        corrected = np.linalg.solve(given[:9].reshape(3, 3), (read - given[9:]).T).T
        field = np.einsum("nij,nj->ni", axes, corrected)
        return points @ R.T + self._origin.translation(), field @ R.T

    def decisions(self) -> tuple[StepDecision, ...]:
        """Return what steps in doubt were, of those decided since the last call."""
        found, self._news = self._news, []
        return tuple(found)

    def has_refused(self) -> bool:
        """Return whether a correction was impossible by odometry since the last call."""
        found, self._has_refused = self._has_refused, False
        return found

    def state(self) -> OneFieldState:
        """Do all work that has begun, and return what is to be kept."""
        self._complete()
        prior = None if self._now is None else self._now.prior
        beginning = None if self._now is None else self._now.beginning
        decisions = tuple(self._decisions.values())
        return OneFieldState(tuple(self.key_poses), prior, beginning, self._learnt_m, decisions)

    @classmethod
    def resumed(
        cls, state: OneFieldState, start: StartPose, sensors: KnownSensors, options: SlamOptions
    ) -> "OneFieldExplorer":
        """Return an explorer that goes on from a state; other parameters as of the class."""
        own = cls(start, sensors, options)
        for each in state.key_poses:
            own._count_path(each)
            own._dead_reckon(each)
        own._decisions = {each.number: each for each in state.decisions}
        own.key_poses = list(state.key_poses)
        doubts = [each.number for each in state.key_poses if each.recorded is not None]
        own._open = [number for number in doubts if number not in own._decisions]
        own._learnt_m = state.learnt_m
        if state.prior is not None:
            own._work = own._following(state.prior, state.beginning)
            own._complete()
        own._news = []
        return own

    def _count_path(self, key_pose: ArrivedKeyPose) -> None:
        if key_pose.number > 0:
            self._path_m += key_pose.length_m
            self._read.add(key_pose.length_m, len(key_pose.readings))

    def _dead_reckon(self, key_pose: ArrivedKeyPose) -> None:
        if key_pose.number > 0:
            step = step_of(key_pose)
            self._reckoned = self._reckoned.after(step)
            self._drifting = self._drifting.after(step)

    def _known(self) -> Belief:
        """Return the posterior of the last key pose, in the map."""
        pose, covariance = self._reckoned.pose, self._reckoned.covariance
        if self._now is not None:
            hypotheses = self._now.hypotheses
            pose, covariance = hypotheses.best.state.pose, hypotheses.pose_covariance()
        # The first pose is given in the frame of the field; its own doubt comes along.
        back = pose.inverse().AdjointMap()
        covariance = covariance + back @ self.start.covariance @ back.T
        return Belief(self._origin.compose(pose), self._sensors, covariance)

    @property
    def _recorded(self) -> frozenset[int]:
        """Key poses whose steps in doubt are likeliest as recorded."""
        if self._now is None:
            return frozenset()
        return self._now.hypotheses.best.recorded

    def _drive(self, count: int) -> Drive:
        """Return so many key poses, steps in doubt as they are likeliest to be."""
        recorded = self._recorded
        chosen = [
            each if each.recorded is None or each.number not in recorded else each.recorded
            for each in self.key_poses[:count]
        ]
        return drive_of(chosen, self.start, self._sensors)

    def _due(self, now: FollowedField | None) -> Pieces | None:
        """Return work that is due, to be done in pieces."""
        is_long = self._read.length_m >= self._options.whole_field.solve_after_m
        if not (self._read.is_enough and is_long):
            return None
        inside = now is not None and _is_inside(now)
        if inside and len(self.key_poses) > MOST:
            return None
        growth = GROWN if inside else LEFT
        return self._learning(now) if self._path_m >= growth * self._learnt_m else None

    def _learning(self, now: FollowedField | None) -> Pieces:
        """Solve the drive so far, and follow the rest, in pieces."""
        self._learnt_m = self._path_m
        # A step that nothing has decided yet is followed both ways.
        count = min([len(self.key_poses), *self._open])
        recorded = frozenset(each for each in self._recorded if each < count)
        drive = self._drive(count)
        solvable = LEAST <= count <= MOST and len(drive.readings) >= FEWEST
        smooth = None
        if solvable:
            initial = drive.dead_reckoning()
            smooth = yield from smoothed(drive, initial, self._options, ON_LINE)
        if smooth is not None:
            poses = smooth.stage.last.poses
            relative = tuple(poses[0].between(pose) for pose in poses)
            beginning = SolvedBeginning(relative, end_state(smooth), recorded)
            yield None
            yield from self._following(smooth.prior, beginning)
            return
        options, everything = self._options.whole_field, self._drive(len(self.key_poses))
        first, poses = None if now is None else now.prior.spectrum, self.poses()
        spectrum = spectrum_at(everything, poses, options, COARSE, first)
        yield None
        prior = full_prior(everything, poses, spectrum, COARSE).capped(options.waves)
        yield from self._following(prior, None)

    def _is_possible(self, now: FollowedField) -> bool:
        """Return whether odometry, with the drift that is stated, can have been so far off."""
        state = now.hypotheses.best.state
        if self._reckoned.squared_distance(state.pose) <= IMPOSSIBLE:
            return True
        if np.abs(state.steady - self._drifting.drift).max() > NEAR_DRIFT:
            self._drifting = DeadReckoning.at_start(state.steady)
            for each in self.key_poses[1:]:
                self._drifting = self._drifting.after(step_of(each))
        return self._drifting.squared_distance(state.pose) <= IMPOSSIBLE

    def _refuse(self) -> None:
        """Follow odometry, until field and noise are learnt again at its poses."""
        self._now = self._work = None
        self._learnt_m = self._path_m
        self._has_refused = True

    def _mean_distance(self) -> float:
        """Return the path between two readings in metres, in the mean of what was learnt from."""
        path = np.cumsum([each.length_m * (each.number > 0) for each in self.key_poses])
        count = np.searchsorted(path, self._learnt_m, side="right")
        readings = sum(len(each.readings) for each in self.key_poses[:count])
        return self._learnt_m / max(readings, 1)

    def _following(self, prior: WholePrior, beginning: SolvedBeginning | None) -> Pieces:
        """Follow all key poses from a beginning, or the start, on, in pieces.

        Yields nothing, and at last the result.
        """
        options = self._options
        sensors = self._sensors.corrected(prior.spectrum.correction)
        sensors = sensors.loosened(0.0, options.whole_field.offset)
        # The filter knows no slow errors.
        noise = np.array([prior.spectrum.noise.as_white(self._mean_distance())])
        follows = FieldFilter(prior.field, replace(sensors, noise=noise), options.robust.largest)
        hypotheses, done = Hypotheses.begun(follows), 1
        if beginning is not None:
            known = Hypothesis(beginning.state, beginning.poses, beginning.recorded)
            hypotheses, done = Hypotheses((known,)), len(beginning.poses)
        anew = FollowedField(prior, beginning, follows, hypotheses)
        while done < len(self.key_poses):
            anew = self._after(anew, self.key_poses[done])
            done += 1
            if done % PIECE == 0:
                yield None
        yield anew

    def _after(self, now: FollowedField, key_pose: ArrivedKeyPose) -> FollowedField:
        if not _is_inside(now):  # the field says nothing there
            key_pose = key_pose.without_readings()
        decision = self._decisions.get(key_pose.number)
        was_motion = None if decision is None else decision.was_motion
        return replace(now, hypotheses=now.hypotheses.after(key_pose, now.follows, was_motion))

    def _go_on(self) -> None:
        """Do a piece of the work, if there is any."""
        found = None if self._work is None else next(self._work)
        if isinstance(found, FollowedField):
            self._now, self._work = found, None
            self._decide(found.hypotheses)

    def _complete(self) -> None:
        """Do all work that has begun."""
        while self._work is not None:
            self._go_on()

    def _decide(self, hypotheses: Hypotheses) -> None:
        """Keep what all hypotheses agree on."""
        for each in decided(hypotheses.all, self._open):
            self._open.remove(each.number)
            self._decisions[each.number] = each
            self._news.append(each)


def _of_short_drives(options: SlamOptions) -> SlamOptions:
    """Return options with what a drive so far may show of C in place of what a whole one may."""
    whole = options.whole_field
    short = whole.model_copy(update={"distortion": whole.online_distortion})
    return options.model_copy(update={"whole_field": short})


def _is_inside(now: FollowedField) -> bool:
    """Return whether the vehicle is so far inside of the box that its faces do not matter."""
    margin = NEAR * now.prior.spectrum.prior.length
    place = now.hypotheses.best.state.pose.translation()
    return bool(np.all(place > now.prior.low + margin) and np.all(place < now.prior.high - margin))
