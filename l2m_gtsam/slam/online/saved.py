"""States of localisations on line as arrays, and localisations that go on."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.slam.drive import KnownSensors, StartPose
from l2m_gtsam.slam.joint_gaussian import JointGaussian, is_pose
from l2m_gtsam.slam.online.begun_with import BegunWith
from l2m_gtsam.slam.online.branches import Branch, BranchedFollower, GapDoubt
from l2m_gtsam.slam.online.columns import packed, unpacked
from l2m_gtsam.slam.online.events import OnlineEvent
from l2m_gtsam.slam.online.follower import Follower, LastBelief
from l2m_gtsam.slam.online.intake import IntakeState
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose
from l2m_gtsam.slam.online.scan_matching import KeptScan, LoopMatcher, ScanMatcher
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.online.start_search import StartSearchState
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.explorer import Explorer, ExplorerState, MarginalizedPose
from l2m_gtsam.slam.unknown_field.field_memory import FieldMemory, RememberedTile
from l2m_gtsam.slam.unknown_field.one_field_explorer import OneFieldExplorer, OneFieldState
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, WaveTile
from l2m_gtsam.storage.online_log import SavedState

NAME = "state"
BEGIN = "begin without --resume"
OTHER = f"the saved state is of another calibration, map or configuration: {BEGIN}"
# What a file that was changed by hand may raise where arrays become objects.
BROKEN = (KeyError, ValueError, IndexError, TypeError, RuntimeError, OverflowError)


@dataclass(frozen=True)
class KeptLoops:
    """What a loop matcher remembers; attributes are its own."""

    kept: tuple[KeptScan, ...]
    path_m: float
    last_m: float


@dataclass(frozen=True)
class KeptBranch:
    """A branch of a drive in a map; attributes are those of its follower, and its own."""

    last: LastBelief
    log_likelihood: float
    recorded: frozenset[int]

    @classmethod
    def of(cls, branch: Branch) -> "KeptBranch":
        """Return a branch whose open section is closed."""
        branch.follower.finish()
        return cls(branch.follower.last, branch.follower.log_likelihood, branch.recorded)

    def branch(self, slam: OnlineSlam) -> Branch:
        """Return the branch that goes on."""
        if self.last.belief.sensors.names != slam.sensors.names:
            raise ValueError("a branch has other sensors than the calibration")
        follower = Follower.resumed(self.last, slam.known_map(), slam.options)
        follower.log_likelihood = self.log_likelihood
        return Branch(follower, self.recorded)


@dataclass(frozen=True)
class KeptFollowing:
    """A drive that is followed in a map; attributes are those of a ``BranchedFollower``."""

    branches: tuple[KeptBranch, ...]
    doubts: dict[int, GapDoubt]


@dataclass(frozen=True)
class KeptTile:
    """A tile of an unknown field.

    Attributes
    ----------
    anchor, past_information, returns
        As of a ``RememberedTile``.
    R_anchor_level
        Axes of its box, shape (3, 3); the last points up.
    heights
        Along that, of the faces of the box, shape (2,), metres.
    """

    anchor: int
    past_information: FloatArray
    returns: int
    R_anchor_level: FloatArray
    heights: FloatArray

    @classmethod
    def of(cls, tile: RememberedTile) -> "KeptTile":
        """Return what is to be kept of a tile; the rest follows from the prior."""
        frame = tile.field.basis.frame
        low = float(frame.R_map_tile[:, 2] @ frame.corner)
        heights = np.array([low, low + frame.height])
        return cls(tile.anchor, tile.past_information, tile.returns, frame.R_map_tile, heights)

    def tile(self, number: int, prior: FieldPrior) -> RememberedTile:
        """Return the tile."""
        R = self.R_anchor_level
        field = WaveTile.about(prior, R, self.heights[:, None] * R[:, 2])
        return RememberedTile(number, self.anchor, field, self.past_information, self.returns)


@dataclass(frozen=True)
class KeptMemory:
    """The memory of an unknown field.

    Attributes
    ----------
    poses, vectors
        Means of the variables of its joint Gaussian, by key.
    sizes, covariance
        As of the ``JointGaussian``.
    tiles
        By number.
    """

    poses: dict[int, gtsam.Pose3]
    vectors: dict[int, FloatArray]
    sizes: dict[int, int]
    covariance: FloatArray
    tiles: tuple[KeptTile, ...]

    @classmethod
    def of(cls, memory: FieldMemory) -> "KeptMemory":
        """Return what is to be kept of a memory."""
        known = memory.known
        return cls(
            {key: known.values.atPose3(key) for key in known.sizes if is_pose(key)},
            {
                key: known.values.atVector(key)[:size]
                for key, size in known.sizes.items()
                if not is_pose(key)
            },
            dict(known.sizes),
            known.covariance,
            tuple(KeptTile.of(each) for each in memory.tiles),
        )

    def memory(self, prior: FieldPrior) -> FieldMemory:
        """Return the memory, of tiles of a prior."""
        values = gtsam.Values()
        for key, mean in (self.poses | self.vectors).items():
            values.insert(key, mean)
        known = JointGaussian(values, self.sizes, self.covariance)
        return FieldMemory(known, tuple(own.tile(k, prior) for k, own in enumerate(self.tiles)))


@dataclass(frozen=True)
class KeptExploring:
    """A drive in an unknown field.

    Attributes
    ----------
    start
        Of the ``Explorer``.
    prior, past, waiting, last
        As of an ``ExplorerState``.
    memory
        The same; None where the field is not learnt yet.
    """

    start: StartPose
    prior: FieldPrior | None
    memory: KeptMemory | None
    past: tuple[MarginalizedPose, ...]
    waiting: tuple[ArrivedKeyPose, ...]
    last: int

    @classmethod
    def of(cls, explorer: Explorer) -> "KeptExploring":
        """Return what is to be kept of an explorer, whose section is closed for it."""
        state = explorer.state()
        memory = None if state.prior is None else KeptMemory.of(state.memory)
        return cls(explorer.start, state.prior, memory, state.past, state.waiting, state.last)

    def explorer(self, slam: OnlineSlam) -> Explorer:
        """Return the explorer that goes on."""
        memory = FieldMemory.at_start(self.start)
        if self.prior is not None and self.memory is not None:
            memory = self.memory.memory(self.prior)
        state = ExplorerState(self.prior, memory, self.past, self.waiting, self.last)
        return Explorer.resumed(state, self.start, slam.sensors, slam.options)


@dataclass(frozen=True)
class KeptOneField:
    """A drive of one sensor in an unknown field; attributes are its explorer's."""

    start: StartPose
    state: OneFieldState


@dataclass(frozen=True)
class KeptSlam:
    """All that a localisation needs to go on.

    Attributes
    ----------
    begun_with
        Calibration and map: it does not go on with others.
    intake, base, stamp_ns, search
        As of an ``OnlineSlam``.
    sensors
        The same, where a drive whose place was lost has refined them.
    refuted, left_out
        Sensors that its ``CalibrationWatch`` has reported, and those whose readings do not count.
    events
        That nobody has read.
    loops
        What its ``LoopMatcher`` remembers, if it has one.
    following, exploring, one_field
        Its estimator; at most one is there.
    """

    begun_with: BegunWith
    intake: IntakeState
    sensors: KnownSensors | None
    base: int
    stamp_ns: int
    refuted: frozenset[str]
    left_out: frozenset[str]
    events: tuple[OnlineEvent, ...]
    loops: KeptLoops | None
    search: StartSearchState | None
    following: KeptFollowing | None
    exploring: KeptExploring | None
    one_field: KeptOneField | None


def saved_state(slam: OnlineSlam) -> SavedState:
    """Return all that a localisation needs to go on; its open section is closed for it."""
    estimator, matcher, search = slam.estimator, slam.matcher, slam.search
    following = exploring = one_field = loops = None
    if isinstance(estimator, BranchedFollower):
        branches = tuple(KeptBranch.of(each) for each in estimator.branches)
        following = KeptFollowing(branches, estimator.doubts)
    elif isinstance(estimator, Explorer):
        exploring = KeptExploring.of(estimator)
    elif isinstance(estimator, OneFieldExplorer):
        one_field = KeptOneField(estimator.start, estimator.state())
    if isinstance(matcher, LoopMatcher):
        loops = KeptLoops(tuple(matcher.kept), matcher.path_m, matcher.last_m)
    if search is not None:  # scans of all key poses would be gigabytes
        search = replace(search, waiting=[replace(each, scans=()) for each in search.waiting])
    kept = KeptSlam(
        BegunWith.of(slam.given_sensors, slam.field_map),
        slam.intake.state,
        None if slam.sensors is slam.given_sensors else slam.sensors,
        slam.base,
        slam.stamp_ns,
        frozenset(slam.watch.reported),
        frozenset(slam.watch.out),
        slam.unread_events(),
        loops,
        search,
        following,
        exploring,
        one_field,
    )
    options = slam.options.model_dump(mode="json")
    return SavedState(packed(KeptSlam, [kept], NAME), {"options": options})


def resumed_slam(
    state: SavedState,
    calibration: CalibrationResult,
    options: SlamOptions,
    field_map: QueryableMap | None = None,
    matcher: ScanMatcher | LoopMatcher | None = None,
) -> OnlineSlam:
    """Return a localisation that goes on from a state.

    Parameters
    ----------
    state
        As of ``saved_state``.
    calibration, options, field_map, matcher
        As of ``OnlineSlam``; the same as before.

    Raises
    ------
    ConfigError
        The state is of another calibration, map or configuration, or it is damaged.
    """
    slam = OnlineSlam(calibration, options, field_map, matcher)
    try:
        (kept,) = unpacked(KeptSlam, state.arrays, 1, NAME)
        _refuse_other(slam, kept.begun_with)
        if SlamOptions.model_validate(state.facts["options"]) != slam.options:
            raise ConfigError(OTHER)
        _resume(slam, kept)
    except BROKEN as error:
        raise ConfigError(f"the saved state is damaged: {BEGIN}") from error
    return slam


def _refuse_other(slam: OnlineSlam, begun_with: BegunWith) -> None:
    """Refuse another calibration or map than a state was begun with."""
    if not begun_with.is_calibration(slam.given_sensors):
        raise ConfigError(f"the saved state is of another calibration: give that one, or {BEGIN}")
    if not begun_with.is_map(slam.field_map):
        raise ConfigError(f"the saved state is of another map: give that one, or {BEGIN}")


def _resume(slam: OnlineSlam, kept: KeptSlam) -> None:
    names = frozenset(slam.sensors.names)
    if len(kept.intake.sensors) != len(names) or not kept.refuted | kept.left_out <= names:
        raise ValueError("the state has other sensors than the calibration")
    slam.intake.resume(kept.intake)
    slam.sensors = kept.sensors or slam.given_sensors
    slam.search, slam.base, slam.stamp_ns = kept.search, kept.base, kept.stamp_ns
    slam.watch.reported, slam.watch.out = set(kept.refuted), set(kept.left_out)
    if isinstance(slam.matcher, LoopMatcher) and kept.loops is not None:
        slam.matcher.resume(kept.loops.kept, kept.loops.path_m, kept.loops.last_m)
    if kept.following is not None:
        branches = [each.branch(slam) for each in kept.following.branches]
        slam.estimator = BranchedFollower(*branches, doubts=kept.following.doubts)
    elif kept.exploring is not None:
        slam.estimator = kept.exploring.explorer(slam)
    elif kept.one_field is not None:
        start, state = kept.one_field.start, kept.one_field.state
        slam.estimator = OneFieldExplorer.resumed(state, start, slam.sensors, slam.options)
    slam.resume_report(kept.events)
