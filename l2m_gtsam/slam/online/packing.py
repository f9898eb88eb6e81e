"""What estimators on line remember as plain arrays, and back."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from l2m_factors import KeyPoseReadings
from l2m_gtsam.data import FloatArray, RigidTransform, joined_rows
from l2m_gtsam.maps.potential import PotentialHyperparameters
from l2m_gtsam.slam.drift import DRIFT
from l2m_gtsam.slam.drive import as_poses
from l2m_gtsam.slam.joint_gaussian import JointGaussian, is_pose
from l2m_gtsam.slam.key_pose_readings import joined_readings
from l2m_gtsam.slam.links import Links
from l2m_gtsam.slam.odometry import FixedStep
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose
from l2m_gtsam.slam.online.scan_matching import KeptScan, LoopMatcher
from l2m_gtsam.slam.online.step_doubts import StepDecision
from l2m_gtsam.slam.online.tracked_drift import DriftPrior, TrackedDrift, WaySinceAnchor
from l2m_gtsam.slam.unknown_field.field_filter import FilterState
from l2m_gtsam.slam.unknown_field.one_field_explorer import OneFieldState, SolvedBeginning
from l2m_gtsam.slam.unknown_field.sensor_noise import SensorNoise
from l2m_gtsam.slam.unknown_field.spectrum import FieldSpectrum
from l2m_gtsam.slam.unknown_field.whole_field import WholePrior

Arrays = dict[str, npt.NDArray[Any]]
WAY = ("p", "p_covariance", "shift", "random", "drift_m")
READINGS = ("key_pose", "sensor", "R_key_lidar", "p_key_lidar", "fraction", "field")
STATE = ("weights", "distortion", "steady", "covariance")


def named(prefix: str, arrays: Mapping[str, npt.NDArray[Any]]) -> Arrays:
    """Return arrays with a prefix before their names."""
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def under(prefix: str, arrays: Mapping[str, npt.NDArray[Any]]) -> Arrays:
    """Return the arrays whose names have a prefix, without it."""
    begin = f"{prefix}."
    return {
        name.removeprefix(begin): array for name, array in arrays.items() if name.startswith(begin)
    }


def packed_poses(poses: Sequence[gtsam.Pose3]) -> Arrays:
    """Return n poses as R (n, 3, 3) and p (n, 3)."""
    return {
        "R": np.reshape([pose.rotation().matrix() for pose in poses], (-1, 3, 3)),
        "p": np.reshape([pose.translation() for pose in poses], (-1, 3)),
    }


def unpacked_poses(arrays: Arrays) -> list[gtsam.Pose3]:
    """Return poses of ``packed_poses``."""
    return as_poses(arrays["R"], arrays["p"])


def packed_key_poses(key_poses: Sequence[ArrivedKeyPose]) -> Arrays:
    """Return key poses as arrays."""
    readings = joined_readings([each.readings for each in key_poses])
    links = joined_rows([Links.none(), *(each.links for each in key_poses)])
    return {
        "number": np.array([each.number for each in key_poses], dtype=np.int64),
        "stamp_ns": np.array([each.stamp_ns for each in key_poses], dtype=np.int64),
        "R": np.reshape([each.R for each in key_poses], (-1, 3, 3)),
        "p": np.reshape([each.p for each in key_poses], (-1, 3)),
        "covariance": np.reshape([each.covariance for each in key_poses], (-1, 6, 6)),
        "steady": np.reshape([each.steady for each in key_poses], (-1, 3)),
        "turning": np.reshape([each.turning for each in key_poses], (-1, 3)),
        "count": np.array([len(each.readings) for each in key_poses], dtype=np.int64),
        "reading_ns": np.concatenate(
            [np.empty(0, dtype=np.int64), *(each.reading_ns for each in key_poses)]
        ),
        "links": np.array([len(each.links) for each in key_poses], dtype=np.int64),
        **named("reading", {name: getattr(readings, name) for name in READINGS}),
        **named("link", vars(links)),
        **named("fixed", _packed_fixed(key_poses)),
    }


def _packed_fixed(key_poses: Sequence[ArrivedKeyPose]) -> Arrays:
    """Return steps along fixed axes, not finite where there is none."""
    none = FixedStep(np.full((3, 3), np.nan), np.full(3, np.nan))
    steps = [none if each.fixed is None else each.fixed for each in key_poses]
    return {
        "turn": np.reshape([each.turn for each in steps], (-1, 3, 3)),
        "shift": np.reshape([each.shift for each in steps], (-1, 3)),
    }


def unpacked_key_poses(arrays: Arrays) -> list[ArrivedKeyPose]:
    """Return key poses of ``packed_key_poses``."""
    columns = under("reading", arrays)
    key, sensor, R, p, fraction, field = (columns[name] for name in READINGS)
    readings = KeyPoseReadings(key, sensor, R, p, fraction, field)
    links = Links(**under("link", arrays))
    fixed = under("fixed", arrays)
    turning = arrays.get("turning", np.zeros((len(arrays["number"]), 3)))  # older states have none
    found, reading, link = [], 0, 0
    for k in range(len(arrays["number"])):
        rows = np.arange(reading, reading + int(arrays["count"][k]))
        own = np.arange(link, link + int(arrays["links"][k]))
        reading, link = reading + len(rows), link + len(own)
        step = FixedStep(fixed["turn"][k], fixed["shift"][k])
        found.append(
            ArrivedKeyPose(
                int(arrays["number"][k]),
                int(arrays["stamp_ns"][k]),
                arrays["R"][k],
                arrays["p"][k],
                arrays["covariance"][k],
                readings[rows],
                arrays["reading_ns"][rows],
                links[own],
                fixed=step if np.isfinite(step.shift).all() else None,
                steady=np.broadcast_to(arrays["steady"][k], 3),  # older states have one
                turning=turning[k],
            )
        )
    return found


def packed_both_ways(name: str, key_poses: Sequence[ArrivedKeyPose]) -> Arrays:
    """Return key poses as arrays under a name, and their recorded steps where these are others."""
    recorded = [each.recorded for each in key_poses if each.recorded is not None]
    return {
        **named(name, packed_key_poses(key_poses)),
        **named("recorded", packed_key_poses(recorded)),
    }


def unpacked_both_ways(name: str, arrays: Arrays) -> list[ArrivedKeyPose]:
    """Return key poses of ``packed_both_ways``; older states may have no recorded steps."""
    of_recorded = under("recorded", arrays)
    recorded = (
        {each.number: each for each in unpacked_key_poses(of_recorded)} if of_recorded else {}
    )
    return [
        replace(each, recorded=recorded.get(each.number))
        for each in unpacked_key_poses(under(name, arrays))
    ]


def packed_drift(tracked: TrackedDrift) -> Arrays:
    """Return a tracked drift as arrays."""
    way, both = tracked.way, (tracked.before, tracked.known)
    return {
        "mean": np.stack([each.drift for each in both]),
        "covariance": np.stack([each.covariance for each in both]),
        "p": way.p,
        "p_covariance": way.covariance,
        "shift": way.shift,
        "random": way.random,
        "drift_m": way.drift_m,
        "unobserved_m": np.array([tracked.unobserved_m]),
    }


def unpacked_drift(arrays: Arrays, over_m: float) -> TrackedDrift:
    """Return a tracked drift of ``packed_drift``."""
    before, known = (
        DriftPrior(mean, covariance)
        for mean, covariance in zip(arrays["mean"], arrays["covariance"], strict=True)
    )
    way = WaySinceAnchor(*(arrays[name] for name in WAY))
    return TrackedDrift(before, known, way, over_m, float(arrays["unobserved_m"][0]))


def packed_gaussian(known: JointGaussian) -> Arrays:
    """Return a joint Gaussian as arrays: keys, sizes, means one after the other, covariance."""
    means: list[FloatArray] = [np.empty(0)]
    for key, size in known.sizes.items():
        if is_pose(key):
            pose = known.values.atPose3(key)
            means += [pose.rotation().matrix().ravel(), pose.translation()]
        else:
            means.append(known.values.atVector(key)[:size])
    return {
        "key": np.array(list(known.sizes), dtype=np.uint64),
        "size": np.array(list(known.sizes.values()), dtype=np.int64),
        "mean": np.concatenate(means),
        "covariance": known.covariance,
    }


def unpacked_gaussian(arrays: Arrays) -> JointGaussian:
    """Return a joint Gaussian of ``packed_gaussian``."""
    values, at, mean = gtsam.Values(), 0, arrays["mean"]
    sizes = dict(zip(arrays["key"].tolist(), arrays["size"].tolist(), strict=True))
    for key, size in sizes.items():
        if is_pose(key):
            R, p = mean[at : at + 9].reshape(3, 3), mean[at + 9 : at + 12]
            values.insert(key, gtsam.Pose3(gtsam.Rot3(R), p))
            at += 12
        else:
            values.insert(key, mean[at : at + size])
            at += size
    return JointGaussian(values, sizes, arrays["covariance"])


def packed_loops(matcher: LoopMatcher) -> Arrays:
    """Return what a matcher remembers as arrays."""
    kept = matcher.kept
    points = [np.empty((0, 3), dtype=np.float32), *(each.points for each in kept)]
    return {
        "path_m": np.array([matcher.path_m, matcher.last_m]),
        "key_pose": np.array([each.key_pose for each in kept], dtype=np.int64),
        "stamp_ns": np.array([each.stamp_ns for each in kept], dtype=np.int64),
        "scan_path_m": np.array([each.path_m for each in kept], dtype=np.float64),
        "R_key_scan": np.reshape([each.T_key_scan.R for each in kept], (-1, 3, 3)),
        "t_key_scan": np.reshape([each.T_key_scan.t for each in kept], (-1, 3)),
        "points": np.concatenate(points),
        "count": np.array([len(each.points) for each in kept], dtype=np.int64),
    }


def resume_loops(matcher: LoopMatcher, arrays: Arrays) -> None:
    """Give a matcher what another one remembered."""
    points = np.split(arrays["points"], np.cumsum(arrays["count"]))[:-1]
    columns = (
        arrays["key_pose"].tolist(),
        map(RigidTransform, arrays["R_key_scan"], arrays["t_key_scan"]),
        arrays["stamp_ns"].tolist(),
        points,
        arrays["scan_path_m"].tolist(),
    )
    kept = [KeptScan(*each) for each in zip(*columns, strict=True)]
    path_m, last_m = arrays["path_m"].tolist()
    matcher.resume(kept, path_m, last_m)


def packed_one_field(state: OneFieldState) -> Arrays:
    """Return a state as arrays."""
    decisions = [[each.number, each.was_motion] for each in state.decisions]
    arrays = {
        **packed_both_ways("key_poses", state.key_poses),
        "learnt_m": np.array([state.learnt_m]),
        "decisions": np.reshape(np.array(decisions, dtype=np.int64), (-1, 2)),
    }
    if state.prior is not None:
        arrays |= named("prior", _packed_prior(state.prior))
    if state.beginning is not None:
        arrays |= named("beginning", _packed_beginning(state.beginning))
    return arrays


def unpacked_one_field(arrays: Arrays) -> OneFieldState:
    """Return the state of ``packed_one_field``."""
    decisions = arrays["decisions"].tolist()
    prior, beginning = under("prior", arrays), under("beginning", arrays)
    return OneFieldState(
        tuple(unpacked_both_ways("key_poses", arrays)),
        _unpacked_prior(prior) if prior else None,
        _unpacked_beginning(beginning) if beginning else None,
        float(arrays["learnt_m"][0]),
        tuple(StepDecision(number, bool(was_motion)) for number, was_motion in decisions),
    )


def _packed_beginning(beginning: SolvedBeginning) -> Arrays:
    state = beginning.state
    return {
        **named("poses", packed_poses(beginning.poses)),
        **{name: getattr(state, name) for name in STATE},
        "recorded": np.array(sorted(beginning.recorded), dtype=np.int64),
    }


def _unpacked_beginning(arrays: Arrays) -> SolvedBeginning:
    weights, distortion, steady, covariance = (arrays[name] for name in STATE)
    if len(steady) < DRIFT:  # an older state, which knew no turning
        more = DRIFT - len(steady)
        steady = np.append(steady, np.zeros(more))
        covariance = block_diag(covariance, np.eye(more))
    poses = tuple(unpacked_poses(under("poses", arrays)))
    # The last pose is the state's, and the likelihood counts readings from there on.
    state = FilterState(poses[-1], weights, distortion, steady, covariance, 0.0)
    return SolvedBeginning(poses, state, frozenset(arrays["recorded"].tolist()))


def _packed_prior(prior: WholePrior) -> Arrays:
    found = prior.spectrum
    noise = found.noise
    return {
        "potential": np.array([found.prior.sigma, found.prior.length]),
        "noise": np.array([noise.ut, noise.white, noise.slow_s]),
        "correction": found.correction,
        "log_likelihood": np.array([found.log_likelihood]),
        "at": found.at,
        "box": np.stack([prior.low, prior.high]),
        "waves": np.array([prior.waves], dtype=np.int64),
    }


def _unpacked_prior(arrays: Arrays) -> WholePrior:
    sigma, length = arrays["potential"].tolist()
    spectrum = FieldSpectrum(
        PotentialHyperparameters(sigma=sigma, length=length),
        SensorNoise(*arrays["noise"].tolist()),
        arrays["correction"],
        float(arrays["log_likelihood"][0]),
        arrays["at"],
    )
    low, high = arrays["box"]
    return WholePrior(spectrum, low, high, int(arrays["waves"][0]))
