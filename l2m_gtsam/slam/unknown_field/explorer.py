"""On-line SLAM in an unknown field, key pose by key pose.

The memory is one Gaussian over the field's weights, tile by tile, the key poses that anchor tiles,
and the last key pose. The last stretch of the path is solved again as it grows, with the memory as
its prior; at its end the memory is updated, and the stretch's other poses are marginalised. So both
cost and memory grow with the building and not with the drive. The work is spread over the key poses
that come meanwhile.

The correlations between tiles are essential: tiles that count as independent, or as exactly known,
drift as odometry does, and the sigmas do not show it.
"""

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from pydantic import Field

from l2m_factors import M, X
from l2m_gtsam.data import FloatArray, joined_rows
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.lidar.registration import PoseEstimate
from l2m_gtsam.options import Options
from l2m_gtsam.slam.drive import KnownSensors, StartPose, as_transform
from l2m_gtsam.slam.links import Links, carried_on, seen_from_before
from l2m_gtsam.slam.marginals import reported_ill_conditioning
from l2m_gtsam.slam.online.belief import POSE, Belief
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose, drive_of
from l2m_gtsam.slam.online.step_doubts import CERTAIN
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions, StepAxes
from l2m_gtsam.slam.slips import SLIPPED
from l2m_gtsam.slam.unknown_field.field_memory import FieldMemory
from l2m_gtsam.slam.unknown_field.open_section import OpenSection
from l2m_gtsam.slam.unknown_field.read_path import ReadPath
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, drive_prior

GROUP, SECTION = 20, 100  # limits in key poses instead of metres, for a vehicle that turns
FEW = 20  # key poses: a section of fewer is cheap to solve again, and its poses gain by it
FINISHED = object()
PIECE_M = 0.1  # of path, in which a piece of the work is done; at least one at a key pose


class ExploringOptions(Options):
    """How an unknown field is explored on line; lengths in metres of path."""

    group_m: float = Field(default=2.0, gt=0)
    """New key poses are solved after this distance; until then, and while it is solved, they are
    predicted by odometry. Half of it costs nearly twice the time."""
    section_m: float = Field(default=10.0, gt=0)
    """So much is solved together at most; of what lies further back tiles alone are kept. A vehicle
    that comes back as far off as odometry has drifted has to find its place within it."""
    settled_m: float = Field(default=0.1, ge=0)
    """A section of 20 key poses or more ends before that once readings move none of them as far:
    fields of buildings change over half a metre and more, so that derivatives stay as they are.
    Most of the work is to solve sections again: dense key poses take half the time, and errors are
    the same."""


@dataclass(frozen=True)
class MarginalizedPose:
    """A marginalised key pose, kept relative to the anchor of its tile."""

    anchor: int
    T_anchor_key: gtsam.Pose3


@dataclass(frozen=True)
class ExplorerState:
    """What an explorer knows between two sections.

    Attributes
    ----------
    prior
        Of the field; None where it is not learnt yet.
    memory
        Of tiles, anchors and the last key pose.
    past
        Key poses that were marginalised.
    waiting
        Key poses so far where the field is not learnt.
    last
        Number of the last key pose.
    """

    prior: FieldPrior | None
    memory: FieldMemory
    past: tuple[MarginalizedPose, ...]
    waiting: tuple[ArrivedKeyPose, ...]
    last: int


class Explorer:
    """Estimates poses and field on line: its state after the key poses added so far.

    All readings of a tile determine the sensors' heights together; those of marginalised poses
    cannot be linearised again, at other calibrations neither.

    Parameters
    ----------
    start, sensors
        Prior of the first key pose, and calibrations.
    options
        As of a localisation. Fewer `tiles.modes` take far less time.
    pace
        How often is solved, and how much together.

    Attributes
    ----------
    memory
        Without the last stretch.
    belief
        The posterior of the last key pose.

    Raises
    ------
    ConfigError
        Odometry knows its steps along fixed axes.
    """

    def __init__(
        self,
        start: StartPose,
        sensors: KnownSensors,
        options: SlamOptions,
        pace: ExploringOptions | None = None,
    ) -> None:
        if options.drift.axes is StepAxes.FIXED:
            raise ConfigError("`slam.drift.axes: fixed` works off line; on line give `vehicle`")
        self.start, self._sensors, self._options = start, sensors, options
        self._pace = ExploringOptions() if pace is None else pace
        refined = options.calibration is CalibrationUse.REFINED
        self.memory = FieldMemory.at_start(start, sensors if refined else None)
        self._waiting: list[ArrivedKeyPose] = []  # until they are solved
        self._reckoned = dict[int, gtsam.Pose3]()  # where odometry has these
        self._work: Iterator[None] | None = None  # on the section, which is not finished
        self._path_m = self._solved_m = self._opened_m = 0.0
        self._read = ReadPath()  # until the field is learnt
        self._first, self._solved = 0, -1
        self._past: list[MarginalizedPose] = []
        self.belief = self._prior()
        self._section: OpenSection | None = None
        self._other: OpenSection | None = None  # the less likely where steps over gaps are in doubt
        self._doubts: list[int] = []  # times of their ends
        self._recorded = True  # whether these are as recorded in the likelier section
        self._decisions: dict[int, bool] = {}

    def add(self, key_pose: ArrivedKeyPose) -> Belief:
        """Add the next key pose, and return its posterior.

        Raises
        ------
        CalibrationError
            The system is too badly scaled to be solved.
        MapError
            There are too few readings to learn a prior of the field from.
        """
        self._waiting.append(key_pose)
        self._dead_reckon(key_pose)
        if self._section is None:
            self._read.add(key_pose.length_m, len(key_pose.readings))
        is_long = self._read.length_m >= self._options.tiles.learn_over_m
        if self._section is None and self._read.is_enough and is_long:
            self._learn()
        elif self._section is not None:
            if self._work is None and self._is_due():
                self._work = self._solving(self._section)
            for _ in range(max(round(key_pose.length_m / PIECE_M), 1)):
                self._go_on()
        return self.belief

    def finish(self) -> Belief:
        """Solve for the key poses that odometry alone has had so far; with few readings it stays.

        Raises
        ------
        MapError
            There are too few readings to learn a prior of the field from.
        """
        if self._section is None and self._read.is_enough:
            self._learn()
        self._complete()
        if self._section is not None and self._waiting:
            self._work = self._solving(self._section)
            self._complete()
        return self.belief

    @classmethod
    def resumed(
        cls, state: "ExplorerState", start: StartPose, sensors: KnownSensors, options: SlamOptions
    ) -> "Explorer":
        """Return an explorer that goes on from a state; other parameters are those of the class."""
        own = cls(start, sensors, options)
        if state.prior is None:
            for each in state.waiting:
                own.add(each)
            return own
        own.memory, own._past = state.memory, list(state.past)
        own._first = own._solved = state.last
        here = frozenset({state.memory.tile_at(state.last, state.prior.options.core)})
        own._section = OpenSection(sensors, state.prior, options, state.memory, state.last, here)
        own.belief = state.memory.belief(state.last, sensors)
        return own

    def state(self) -> "ExplorerState":
        """Solve for what is waiting, close the section, and return what is to be kept."""
        if self._section is None:
            return ExplorerState(None, self.memory, (), tuple(self._waiting), 0)
        self.finish()
        if self._solved > self._first:
            self._work = self._handing_over(self._section, self._solved, self._solved_m)
            self._complete()
        return ExplorerState(
            self._section.field_prior, self.memory, tuple(self._past), (), self._solved
        )

    def estimate(self, number: int) -> PoseEstimate:
        """Return a key pose as it is known now; that of a marginalised one is its anchor's."""
        if self._section is None or number > self._solved:
            pose = self._reckoned[number]
            return PoseEstimate(as_transform(pose), self.belief.pose_covariance)
        if number >= len(self._past):
            T = as_transform(self._section.pose(number))
            return PoseEstimate(T, self.belief.pose_covariance)
        past = self._past[number]
        T_map_anchor = as_transform(self._section.pose(past.anchor))
        known = self.memory.known.marginal([X(past.anchor)]).covariance
        step = as_transform(past.T_anchor_key)
        return carried_on(PoseEstimate(T_map_anchor, known), step, self._options.drift)

    def poses(self) -> list[gtsam.Pose3]:
        """Return all solved key poses, past ones relative to their anchors' current estimates."""
        if self._section is None:
            return []
        now = self._section
        past = [now.pose(each.anchor).compose(each.T_anchor_key) for each in self._past]
        return [*past, *(now.pose(k) for k in range(len(past), self._solved + 1))]

    def decisions(self) -> dict[int, bool]:
        """Return whether steps over gaps were right, by the times of their ends, of new ones."""
        found, self._decisions = self._decisions, {}
        return found

    @property
    def is_learnt(self) -> bool:
        """Whether the prior of the field is learnt; until then poses are those of odometry."""
        return self._section is not None

    def field_along_path(self) -> tuple[FloatArray, FloatArray]:
        """Return the key poses that are past, m, and the field there, uT, shapes (N, 3)."""
        if self._section is None or not self._past:
            return np.empty((0, 3)), np.empty((0, 3))
        section = self._section
        anchors = np.array([each.anchor for each in self._past])
        points, field = np.empty((len(anchors), 3)), np.empty((len(anchors), 3))
        for tile in self.memory.tiles:
            rows = np.flatnonzero(anchors == tile.anchor)
            if not len(rows):
                continue
            anchor = section.pose(tile.anchor)
            own = np.stack([self._past[row].T_anchor_key.translation() for row in rows])
            weights = self.memory.known.values.atVector(M(tile.number))
            R, p = anchor.rotation().matrix(), anchor.translation()
            points[rows] = own @ R.T + p
            field[rows] = tile.field.field_and_gradient(own, weights)[0] @ R.T
        return points, field

    def _prior(self) -> Belief:
        return self.memory.belief(0, self._sensors)

    def _learn(self) -> None:
        """Learn the prior at the poses of odometry, and solve for the key poses so far."""
        part = drive_of(self._waiting, self.start, self._sensors)
        prior = drive_prior(part, part.dead_reckoning(), self._options.tiles)
        self._section = OpenSection(self._sensors, prior, self._options, self.memory, 0)
        waiting, self._waiting = self._waiting, []
        self.belief, self._path_m = self._prior(), 0.0
        for each in waiting:
            self._waiting.append(each)
            self._dead_reckon(each)
            if self._is_due():
                self._work = self._solving(self._section)
                self._complete()

    def _is_due(self) -> bool:
        path = self._path_m - self._solved_m
        return bool(path >= self._pace.group_m or len(self._waiting) >= GROUP)

    def _dead_reckon(self, key_pose: ArrivedKeyPose) -> None:
        """Predict the belief by odometry."""
        if key_pose.number > 0:
            predicted = self.belief.predicted(key_pose.step, key_pose.covariance)
            self.belief = predicted.marginalize_previous()
            self._path_m += key_pose.length_m
        self._reckoned[key_pose.number] = self.belief.pose

    def _go_on(self) -> None:
        """Do a piece of the work on the section, if there is any."""
        if self._work is not None:
            with reported_ill_conditioning():
                finished = next(self._work, FINISHED)
            if finished is FINISHED:
                self._work = None

    def _complete(self) -> None:
        """Do all work on the section that has begun."""
        while self._work is not None:
            self._go_on()

    def _solving(self, section: OpenSection) -> Iterator[None]:
        """Solve the last stretch with what is waiting, and begin another if it is long."""
        group, path_m = [self._tied(each) for each in self._waiting], self._path_m
        self._waiting = []
        self._doubts += [each.stamp_ns for each in group if each.is_over_gap]
        if self._doubts:
            section, belief = yield from self._both_ways(section, group)
        else:
            yield from section.extended(group)
            belief = section.belief()
        last = group[-1].number
        if self._is_done(section, last, path_m):
            yield from self._handing_over(section, last, path_m)
            belief = self.memory.belief(last, self._sensors)
        self._solved, self._solved_m = last, path_m
        for each in self._waiting:
            belief = belief.predicted(each.step, each.covariance).marginalize_previous()
        self.belief = belief
        self._reckoned = {k: each for k, each in self._reckoned.items() if k > self._solved}

    def _both_ways(
        self, section: OpenSection, group: Sequence[ArrivedKeyPose]
    ) -> Generator[None, None, tuple[OpenSection, Belief]]:
        """Solve with steps over gaps as recorded, and as uncertain; return the likelier section."""
        recorded = [each.as_recorded for each in group]
        own, others = (recorded, list(group)) if self._recorded else (list(group), recorded)
        if self._other is None:
            self._other, others = section.begun_anew(), [*section.key_poses, *others]
        yield from section.extended(own)
        yield from self._other.extended(others)
        odds = section.log_likelihood() - self._other.log_likelihood()
        odds += SLIPPED if self._recorded else -SLIPPED
        yield
        if odds < 0:
            section, self._other, self._recorded = self._other, section, not self._recorded
            self._section = section
        belief, rest = section.belief(), self._other.belief()
        apart = gtsam.Pose3.Logmap(belief.pose.between(rest.pose))
        covariance = belief.covariance.copy()
        share = 1 / (1 + np.exp(abs(odds)))  # of the other
        covariance[:POSE, :POSE] += share * (rest.pose_covariance + np.outer(apart, apart))
        belief = replace(belief, covariance=covariance)
        if abs(odds) > CERTAIN:
            self._decisions |= dict.fromkeys(self._doubts, self._recorded)
            self._end_doubts()
        return section, belief

    def _undecided(self, section: OpenSection) -> Generator[None, None, OpenSection]:
        """Solve with the covariance of both ways, where a section ends before one is decided."""
        uncertain = section if self._other is None or not self._recorded else self._other
        both = section.begun_anew()
        yield from both.extended([each.as_mixture for each in uncertain.key_poses])
        self._section = both
        self._end_doubts()
        return both

    def _end_doubts(self) -> None:
        self._other, self._doubts, self._recorded = None, [], True

    def _is_done(self, section: OpenSection, last: int, path_m: float) -> bool:
        """Return whether a section ends here, and is not solved again when key poses come."""
        count, long_m = last - self._first, path_m - self._opened_m
        settled = not self._doubts and count >= FEW and section.moved_m < self._pace.settled_m
        return settled or count >= SECTION or long_m >= self._pace.section_m

    def _tied(self, key_pose: ArrivedKeyPose) -> ArrivedKeyPose:
        """Return a key pose whose links to marginalised key poses begin at these poses' anchors."""
        links, drift = key_pose.links, self._options.drift
        parts = [Links.none()]
        for row in np.flatnonzero(~links.in_map).tolist():
            origin, found = int(links.origin[row]), links.estimate(row)
            if origin < len(self._past):
                past = self._past[origin]
                step = as_transform(past.T_anchor_key)
                origin, found = past.anchor, seen_from_before(found, step, drift)
            parts.append(Links.single(origin, key_pose.number, found))
        return replace(key_pose, links=joined_rows(parts))

    def _handing_over(self, section: OpenSection, last: int, path_m: float) -> Iterator[None]:
        """Marginalise the key poses up to the last but anchors, and begin another section."""
        if self._doubts:
            section = yield from self._undecided(section)
        memory = yield from section.closed()
        for k in range(len(self._past), last + 1):
            anchor = section.tile(k).anchor
            self._past.append(
                MarginalizedPose(anchor, section.pose(anchor).between(section.pose(k)))
            )
        self.memory = memory
        self._first, self._opened_m = last, path_m
        self._section = section.next(self.memory, last)
