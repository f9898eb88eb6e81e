"""The state of an explorer with one field as plain arrays, and back."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.maps.potential import PotentialHyperparameters
from l2m_gtsam.slam.online.packing import (
    Arrays,
    named,
    packed_key_poses,
    packed_poses,
    under,
    unpacked_key_poses,
    unpacked_poses,
)
from l2m_gtsam.slam.unknown_field.field_filter import FilterState
from l2m_gtsam.slam.unknown_field.odometry_hypotheses import JumpDecision
from l2m_gtsam.slam.unknown_field.one_field_explorer import OneFieldState, SolvedBeginning
from l2m_gtsam.slam.unknown_field.sensor_noise import SensorNoise
from l2m_gtsam.slam.unknown_field.spectrum import FieldSpectrum
from l2m_gtsam.slam.unknown_field.whole_field import WholePrior

STATE = ("weights", "distortion", "steady", "covariance")


def packed_one_field(state: OneFieldState) -> Arrays:
    """Return a state as arrays."""
    recorded = [each.recorded for each in state.key_poses if each.recorded is not None]
    decisions = [[each.number, each.was_motion] for each in state.decisions]
    arrays = {
        **named("key_poses", packed_key_poses(state.key_poses)),
        **named("recorded", packed_key_poses(recorded)),
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
    recorded = {each.number: each for each in unpacked_key_poses(under("recorded", arrays))}
    key_poses = tuple(
        replace(each, recorded=recorded.get(each.number))
        for each in unpacked_key_poses(under("key_poses", arrays))
    )
    decisions = arrays["decisions"].tolist()
    prior, beginning = under("prior", arrays), under("beginning", arrays)
    return OneFieldState(
        key_poses,
        _unpacked_prior(prior) if prior else None,
        _unpacked_beginning(beginning) if beginning else None,
        float(arrays["learnt_m"][0]),
        tuple(JumpDecision(number, bool(was_motion)) for number, was_motion in decisions),
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
