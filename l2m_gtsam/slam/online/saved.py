"""States of localisations on line as arrays and plain values, and localisations that go on."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import RigidTransform
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.slam.drive import StartPose, as_pose
from l2m_gtsam.slam.online.begun_with import (
    is_same_calibration,
    is_same_map,
    packed_map,
    packed_sensors,
)
from l2m_gtsam.slam.online.belief import POSE, Belief
from l2m_gtsam.slam.online.branches import Branch, BranchedFollower, GapDoubt
from l2m_gtsam.slam.online.events import EventKind, OnlineEvent
from l2m_gtsam.slam.online.follower import Follower, LastBelief
from l2m_gtsam.slam.online.intake import Intake, IntakeState
from l2m_gtsam.slam.online.odometry_check import SuspectStep
from l2m_gtsam.slam.online.odometry_pose import OdometryPose
from l2m_gtsam.slam.online.packing import (
    Arrays,
    named,
    packed_both_ways,
    packed_drift,
    packed_gaussian,
    packed_key_poses,
    packed_loops,
    packed_one_field,
    packed_poses,
    resume_loops,
    under,
    unpacked_both_ways,
    unpacked_drift,
    unpacked_gaussian,
    unpacked_key_poses,
    unpacked_one_field,
    unpacked_poses,
)
from l2m_gtsam.slam.online.scan_matching import LoopMatcher, ScanMatcher
from l2m_gtsam.slam.online.sensor_buffer import SensorBuffer
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.online.start_search import StartSearchState
from l2m_gtsam.slam.online.tracked_drift import TrackedDrift
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.explorer import Explorer, ExplorerState, MarginalizedPose
from l2m_gtsam.slam.unknown_field.field_memory import FieldMemory, RememberedTile
from l2m_gtsam.slam.unknown_field.one_field_explorer import OneFieldExplorer
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, WaveTile
from l2m_gtsam.storage.online_log import SavedState

FOLLOWING, EXPLORING, ONE_FIELD = "following", "exploring", "one_field"
SEARCHING, WAITING = "searching", "waiting"
SENSORS = ("t", "distortion", "covariance")
BEGIN = "begin without --resume"
OTHER = f"the saved state is of another calibration, map or configuration: {BEGIN}"
# What a file that was changed by hand may raise where arrays become objects.
BROKEN = (KeyError, ValueError, IndexError, TypeError, RuntimeError, OverflowError)


def saved_state(slam: OnlineSlam) -> SavedState:
    """Return all that a localisation needs to go on; its open section is closed for it."""
    arrays = {
        **named("intake", _packed_intake(slam.intake.state)),
        **named("given", _packed_given(slam)),
        "sensor.names": np.frombuffer("\n".join(slam.sensors.names).encode(), dtype=np.uint8),
        "base": np.array([slam.base, slam.stamp_ns], dtype=np.int64),
    }
    facts: dict[str, Any] = {"options": slam.options.model_dump(mode="json")}
    facts["suspect"] = {
        str(stamp): [each.kind.value, each.text]
        for stamp, each in slam.intake.state.suspect.items()
    }
    facts["refuted"], facts["left_out"] = sorted(slam.watch.reported), sorted(slam.watch.out)
    if isinstance(slam.matcher, LoopMatcher):
        arrays |= named("loops", packed_loops(slam.matcher))
    estimator, search = slam.estimator, slam.search
    if isinstance(estimator, BranchedFollower):
        facts["stage"] = FOLLOWING
        arrays |= named("belief", _packed_branches(estimator))
    elif isinstance(estimator, Explorer):
        facts["stage"] = EXPLORING
        arrays |= named("explorer", _packed_explorer(estimator, facts))
    elif isinstance(estimator, OneFieldExplorer):
        facts["stage"] = ONE_FIELD
        arrays |= named("start", _packed_start(estimator.start))
        arrays |= named("one_field", packed_one_field(estimator.state()))
    elif search is not None:
        facts["stage"] = SEARCHING
        arrays |= named("waiting", packed_key_poses(search.waiting))
        arrays |= named("first", _packed_start(search.first))
        arrays["window_m"] = np.array([search.window_m])
        own = {name: getattr(slam.sensors, name) for name in SENSORS}
        arrays |= named("sensors", own)
    else:
        facts["stage"] = WAITING
    unread = slam.unread_events()
    facts["events"] = [[each.stamp_ns, each.kind.value, each.text] for each in unread]
    return SavedState(arrays, facts)


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
    names = "\n".join(slam.sensors.names).encode()
    try:
        if state.arrays["sensor.names"].tobytes() != names:
            raise ConfigError(OTHER)
        _refuse_other(slam, under("given", state.arrays))
        # Options that a state of an older version does not name have their defaults.
        if SlamOptions.model_validate(state.facts["options"]) != slam.options:
            raise ConfigError(OTHER)
        _resume(slam, state)
        unread = _unpacked_events(state.facts)
    except BROKEN as error:
        raise ConfigError(f"the saved state is damaged: {BEGIN}") from error
    slam.resume_report(unread)
    return slam


def _packed_given(slam: OnlineSlam) -> Arrays:
    arrays = packed_sensors(slam.given_sensors)
    return arrays if slam.field_map is None else arrays | packed_map(slam.field_map)


def _refuse_other(slam: OnlineSlam, given: Arrays) -> None:
    """Refuse another calibration or map than a state was begun with; older states do not say."""
    if not given:
        return
    if not is_same_calibration(given, slam.given_sensors):
        raise ConfigError(f"the saved state is of another calibration: give that one, or {BEGIN}")
    if not is_same_map(given, slam.field_map):
        raise ConfigError(f"the saved state is of another map: give that one, or {BEGIN}")


def _unpacked_events(facts: dict[str, Any]) -> list[OnlineEvent]:
    """Return the events of a state that nobody has read; older states have none."""
    saved = facts.get("events", [])
    return [OnlineEvent(int(at), EventKind(kind), str(text)) for at, kind, text in saved]


def _resume(slam: OnlineSlam, state: SavedState) -> None:
    arrays, facts = state.arrays, state.facts
    slam.intake.resume(_unpacked_intake(under("intake", arrays), facts["suspect"], slam.intake))
    slam.base, slam.stamp_ns = (int(each) for each in arrays["base"])
    for names, key in ((slam.watch.reported, "refuted"), (slam.watch.out, "left_out")):
        names.update(set(facts.get(key, ())) & set(slam.sensors.names))  # older states do not say
    if isinstance(slam.matcher, LoopMatcher):
        resume_loops(slam.matcher, under("loops", arrays))
    stages: dict[str, Callable[[], None]] = {
        FOLLOWING: lambda: _resume_following(slam, under("belief", arrays)),
        EXPLORING: lambda: _resume_exploring(slam, under("explorer", arrays), facts),
        ONE_FIELD: lambda: _resume_one_field(slam, arrays),
        SEARCHING: lambda: _resume_searching(slam, arrays),
        WAITING: lambda: None,
    }
    stages[facts["stage"]]()


def _packed_start(start: StartPose) -> Arrays:
    return {"R": start.T_map_lidar.R, "p": start.T_map_lidar.t, "covariance": start.covariance}


def _unpacked_start(arrays: Arrays) -> StartPose:
    return StartPose(RigidTransform(arrays["R"], arrays["p"]), arrays["covariance"])


def _resume_searching(slam: OnlineSlam, arrays: Arrays) -> None:
    waiting = unpacked_key_poses(under("waiting", arrays))
    first = _unpacked_start(under("first", arrays))
    t, distortion, covariance = (under("sensors", arrays)[name] for name in SENSORS)
    slam.sensors = replace(slam.sensors, t=t, distortion=distortion, covariance=covariance)
    slam.search = StartSearchState(first, waiting, float(arrays["window_m"][0]))


def _packed_branches(branched: BranchedFollower) -> Arrays:
    best, *others = branched.branches
    at = [[number, each.stamp_ns] for number, each in branched.doubts.items()]
    arrays = {
        **_packed_branch(best),
        "doubt.at": np.array(at, dtype=np.int64).reshape(-1, 2),
        "doubt.covariance": np.reshape(
            [each.covariance for each in branched.doubts.values()], (-1, POSE, POSE)
        ),
    }
    for i, each in enumerate(others):
        arrays |= named(f"other.{i}", _packed_branch(each))
    return arrays


def _packed_branch(branch: Branch) -> Arrays:
    branch.follower.finish()
    last = branch.follower.last
    sensors = last.belief.sensors
    return {
        **packed_poses([last.belief.pose]),
        "covariance": last.belief.covariance,
        "t": sensors.t,
        "distortion": sensors.distortion,
        "number": np.array([last.number], dtype=np.int64),
        "recorded": np.array(sorted(branch.recorded), dtype=np.int64),
        "log_likelihood": np.array([branch.follower.log_likelihood]),
        **named("drift", packed_drift(last.drift)),
    }


def _resume_following(slam: OnlineSlam, arrays: Arrays) -> None:
    count = len({name.split(".")[1] for name in arrays if name.startswith("other.")})
    others = [_unpacked_branch(slam, under(f"other.{i}", arrays)) for i in range(count)]
    # Older states have no doubts.
    doubts = {}
    if "doubt.at" in arrays:
        both = zip(arrays["doubt.at"].tolist(), arrays["doubt.covariance"], strict=True)
        doubts = {number: GapDoubt(stamp, own) for (number, stamp), own in both}
    slam.estimator = BranchedFollower(_unpacked_branch(slam, arrays), *others, doubts=doubts)


def _unpacked_branch(slam: OnlineSlam, arrays: Arrays) -> Branch:
    sensors = replace(slam.sensors, t=arrays["t"], distortion=arrays["distortion"])
    belief = Belief(unpacked_poses(arrays)[0], sensors, arrays["covariance"])
    over_m, own = slam.options.drift.over_m, under("drift", arrays)
    # Older states have none: it is found again.
    drift = unpacked_drift(own, over_m) if own else TrackedDrift.at_start(over_m, belief)
    last = LastBelief(int(arrays["number"][0]), belief, drift)
    follower = Follower.resumed(last, slam.known_map(), slam.options)
    if "recorded" not in arrays:
        return Branch(follower)
    follower.log_likelihood = float(arrays["log_likelihood"][0])
    return Branch(follower, frozenset(arrays["recorded"].tolist()))


def _packed_explorer(explorer: Explorer, facts: dict[str, Any]) -> Arrays:
    state = explorer.state()
    arrays = named("start", _packed_start(explorer.start))
    if state.prior is None:
        return {**arrays, **packed_both_ways("waiting", state.waiting)}
    facts["field"] = {
        "hyperparameters": state.prior.hyperparameters.model_dump(mode="json"),
        "resolution": [state.prior.resolution.floor, state.prior.resolution.ceiling],
    }
    arrays |= named("known", packed_gaussian(state.memory.known))
    arrays |= named("past", packed_poses([each.T_anchor_key for each in state.past]))
    arrays["past.anchor"] = np.array([each.anchor for each in state.past], dtype=np.int64)
    arrays["last"] = np.array([state.last], dtype=np.int64)
    for tile in state.memory.tiles:
        frame = tile.field.basis.frame
        low = float(frame.R_map_tile[:, 2] @ frame.corner)
        arrays |= named(
            f"tile.{tile.number}",
            {
                "anchor": np.array([tile.anchor], dtype=np.int64),
                "R": frame.R_map_tile,
                "heights": np.array([low, low + frame.height]),
                "past_information": tile.past_information,
                "returns": np.array([tile.returns], dtype=np.int64),
            },
        )
    return arrays


def _resume_exploring(slam: OnlineSlam, arrays: Arrays, facts: dict[str, Any]) -> None:
    start = _unpacked_start(under("start", arrays))
    if "field" not in facts:
        waiting = tuple(unpacked_both_ways("waiting", arrays))
        state = ExplorerState(None, FieldMemory.at_start(start), (), waiting, 0)
    else:
        state = _unpacked_memory(slam, arrays, facts["field"])
    slam.estimator = Explorer.resumed(state, start, slam.sensors, slam.options)


def _resume_one_field(slam: OnlineSlam, arrays: Arrays) -> None:
    start = _unpacked_start(under("start", arrays))
    state = unpacked_one_field(under("one_field", arrays))
    slam.estimator = OneFieldExplorer.resumed(state, start, slam.sensors, slam.options)


def _unpacked_memory(slam: OnlineSlam, arrays: Arrays, field: dict[str, Any]) -> ExplorerState:
    floor, ceiling = (float(each) for each in field["resolution"])
    hyperparameters = Hyperparameters.model_validate(field["hyperparameters"])
    prior = FieldPrior(hyperparameters, Resolution(floor, ceiling), slam.options.tiles)
    count = len({name.split(".")[1] for name in arrays if name.startswith("tile.")})
    tiles = tuple(_unpacked_tile(k, under(f"tile.{k}", arrays), prior) for k in range(count))
    past = under("past", arrays)
    poses = zip(past["anchor"].tolist(), unpacked_poses(past), strict=True)
    memory = FieldMemory(unpacked_gaussian(under("known", arrays)), tiles)
    kept = tuple(MarginalizedPose(anchor, pose) for anchor, pose in poses)
    return ExplorerState(prior, memory, kept, (), int(arrays["last"][0]))


def _unpacked_tile(number: int, arrays: Arrays, prior: FieldPrior) -> RememberedTile:
    R = arrays["R"]
    field = WaveTile.about(prior, R, arrays["heights"][:, None] * R[:, 2])
    returns = int(arrays["returns"][0]) if "returns" in arrays else 0  # of older states
    anchor, past = int(arrays["anchor"][0]), arrays["past_information"]
    return RememberedTile(number, anchor, field, past, returns)


def _packed_intake(state: IntakeState) -> Arrays:
    poses, unknown = state.poses, np.full((6, 6), np.nan)
    arrays: Arrays = {
        **packed_poses([as_pose(each.T) for each in poses]),
        "stamp_ns": np.array([each.stamp_ns for each in poses], dtype=np.int64),
        "covariance": np.reshape(
            [unknown if each.covariance is None else each.covariance for each in poses], (-1, 6, 6)
        ),
        "number": np.array([state.number, state.disordered], dtype=np.int64),
        "velocity": np.stack([state.velocity, state.last_velocity]),
        "first_R": state.first_R,
    }
    for stamp, each in state.suspect.items():
        own = {"R": each.end.R, "p": each.end.t, "covariance": each.covariance}
        own["flags"] = np.array([each.lost, each.doubtful], dtype=np.int64)
        arrays |= named(f"suspect.{stamp}", own)
    for i, buffer in enumerate(state.sensors):
        flags = [buffer.last_ns, buffer.same, buffer.silent, buffer.stuck, buffer.disordered]
        own = {
            "stamp_ns": np.array(buffer.stamp_ns, dtype=np.int64),
            "values": np.reshape(buffer.values, (-1, 3)),
            "last": buffer.last,
            "flags": np.array(flags, dtype=np.int64),
        }
        arrays |= named(f"sensor.{i}", own)
    return arrays


def _unpacked_intake(arrays: Arrays, texts: dict[str, Any], intake: Intake) -> IntakeState:
    poses = [
        OdometryPose(int(stamp), RigidTransform(R, p), P if np.isfinite(P).all() else None)
        for stamp, R, p, P in zip(
            arrays["stamp_ns"], arrays["R"], arrays["p"], arrays["covariance"], strict=True
        )
    ]
    suspect = {}
    for stamp, (kind, text) in texts.items():
        own = under(f"suspect.{stamp}", arrays)
        end = RigidTransform(own["R"], own["p"])
        flags = (bool(each) for each in own["flags"])
        suspect[int(stamp)] = SuspectStep(
            EventKind(kind), str(text), end, own["covariance"], *flags
        )
    sensors = []
    for i in range(len(intake.state.sensors)):
        own = under(f"sensor.{i}", arrays)
        last_ns, same, silent, stuck, disordered = own["flags"].tolist()
        sensors.append(
            SensorBuffer(
                own["stamp_ns"].tolist(),
                list(own["values"]),
                last_ns,
                own["last"],
                same,
                bool(silent),
                bool(stuck),
                bool(disordered),
            )
        )
    number, disordered = arrays["number"].tolist()
    usual, last = arrays["velocity"]
    return IntakeState(
        poses, sensors, number, suspect, usual, last, bool(disordered), arrays["first_R"]
    )
