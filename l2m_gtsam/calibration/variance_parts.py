r"""Which causes the variances of sensors come from.

The last graph is a least-squares problem of white rows a, of readings and of priors, each with an
error of its own of unit variance. Its covariance is

.. math::
    P = \Bigl(\sum a a^T\Bigr)^{-1} = \sum (P a) (P a)^T

so that each cause has the sum over its own rows: an estimate errs by P a times the error of each.
"""

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from l2m_gtsam.calibration.coverage import Coverage
from l2m_gtsam.calibration.group_noise import GroupNoise
from l2m_gtsam.calibration.joint_information import JointInformation, columns_at
from l2m_gtsam.calibration.sensor_columns import SENSOR, keys_of
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.records.error_budget import ErrorCause, VarianceShare

BLOCKS = (slice(0, 3), slice(3, 12), slice(12, 15))  # t, C, H
BY_SYMBOL = {
    "M": ErrorCause.MAP,
    "U": ErrorCause.SUITE,
    "P": ErrorCause.POSES,
    "Q": ErrorCause.CURRENTS,
    "W": ErrorCause.WANDER,
    "B": ErrorCause.FIELD,
    "F": ErrorCause.WARP,
    "K": ErrorCause.CLOCK,
    "L": ErrorCause.SMOOTHING,
    "A": ErrorCause.MOVING_PARTS,
}
LEAST = 1e-3  # of a variance: less is not listed
Parts = dict[ErrorCause, FloatArray]


def by_cause(columns: Mapping[int, slice]) -> dict[ErrorCause, IntArray]:
    """Return where the errors of each cause stand, (k,), from where those of each key do."""
    named: dict[ErrorCause, list[int]] = {}
    for key in columns:
        named.setdefault(BY_SYMBOL[chr(gtsam.symbolChr(key))], []).append(key)
    return {cause: columns_at(columns, keys) for cause, keys in named.items()}


def variance_parts(
    joint: JointInformation, coverage: Coverage, noise: GroupNoise, sensors: Sequence[int]
) -> tuple[Parts, ...]:
    """Return what each cause has of the variances of each sensor, by cause: t, C, H, shape (3,).

    Parameters
    ----------
    joint
        All variables, at the optimum.
    coverage
        The shared errors, which come first; causes are independent of each other.
    noise
        What readings have of noise, map and poses each.
    sensors
        Which sensors, S of them.
    """
    own = np.concatenate([columns_at(joint.columns, keys_of(s)) for s in sensors])
    # What surveys' sensors are looser by in truth than in the system is theirs.
    loose = joint.loose[own]
    influence = joint.every[:, own] - joint.loose @ loose.T
    variances: dict[ErrorCause, FloatArray] = {ErrorCause.SUITE: (loose**2).sum(axis=1)}

    def add(cause: ErrorCause, values: FloatArray) -> None:
        variances[cause] = variances.get(cause, np.zeros(len(own))) + values

    for cause, at in by_cause(coverage.columns).items():
        X = influence[at]
        add(cause, np.einsum("ki,ki->i", X, coverage.information[np.ix_(at, at)] @ X))
    of_map, of_poses = noise.shares
    for rows in joint.rows:
        squared = (rows.jacobian @ influence[rows.columns]) ** 2
        if not len(rows.readings):
            add(ErrorCause.PRIORS, squared.sum(axis=0))
            continue
        each = squared.reshape(len(rows.readings), 3, -1).sum(axis=1)
        by_map, by_poses = of_map[rows.readings], of_poses[rows.readings]
        add(ErrorCause.MAP, by_map @ each)
        add(ErrorCause.POSES, by_poses @ each)
        add(ErrorCause.NOISE, (1 - by_map - by_poses) @ each)
    return tuple(
        {cause: by_block(values[SENSOR * k :]) for cause, values in variances.items()}
        for k in range(len(sensors))
    )


def by_block(variances: FloatArray) -> FloatArray:
    """Return the sums of variances of t, C and H, shape (3,)."""
    return np.array([variances[block].sum() for block in BLOCKS])


def variance_shares(covariance: FloatArray, parts: Parts) -> tuple[VarianceShare, ...]:
    """Return the shares of all causes, those of t the largest first.

    Parameters
    ----------
    covariance
        Of t, C row by row and H as it is reported, shape (15, 15); infinite where it is open.
    parts
        What the model's causes have of it; what is beyond them is not modelled.
    """
    if not parts:
        return ()
    total = by_block(np.diag(covariance))
    known = np.isfinite(total) & (total > 0)
    unit = np.where(known, total, 1.0)
    shares = {cause: np.where(known, each / unit, 0.0) for cause, each in parts.items()}
    rest = np.where(known, 1 - np.sum(list(shares.values()), axis=0), 0.0)
    shares[ErrorCause.UNMODELLED] = np.maximum(rest, 0.0)
    listed = [
        VarianceShare(cause, *each.tolist()) for cause, each in shares.items() if each.max() > LEAST
    ]
    return tuple(sorted(listed, key=lambda each: -each.t))
