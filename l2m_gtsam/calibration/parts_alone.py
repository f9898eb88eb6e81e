r"""Variances of a sensor by the scatter of parts of a drive alone: no process is looked for.

A fit takes its share of every error, and what it takes no residual shows. Of white noise that share
is known (``cluster_robust``), but of an error that lasts it is larger: where H wanders, t, C, H and
the errors of the map follow it, and parts of a drive through a hall scatter by a half or a third of
what the estimates are wrong by. The bias of a cluster-robust covariance is reduced for a working
model of the errors (Bell and McCaffrey, Survey Methodology 28, 2002). For errors that last it is a
random walk of H. With its modes in the white rows, Z of unit size, part b shows
:math:`Y_b^T (Z - X \Sigma X^T Z)_b` and estimates move by :math:`\Sigma X^T Z`: the squares of the
former over those of the latter are the share that parts show. Where parts scatter by more than
chance, what is more is divided by that share.

H of a moment is not its mean over the drive: the walk itself adds to what estimates of H are wrong
by.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.budget.processes import TimeModes
from l2m_gtsam.calibration.cluster_robust import (
    BLOCKS,
    Gathered,
    VarianceRatio,
    divisions,
    gathered,
    whitening_of,
)
from l2m_gtsam.calibration.half_difference import WhiteGroup
from l2m_gtsam.calibration.sensor_columns import SENSOR
from l2m_gtsam.data import FloatArray, IntArray, Readings

CHANCE = 0.05  # of a scatter: with less the errors are said to last
MODES = 12  # of a random walk: the faster ones hold a twentieth of its variance
TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True)
class PartsRatio:
    """A variance by the scatter of parts over that of noise and map.

    Attributes
    ----------
    value
        Their ratio.
    directions
        How many directions errors differ in, by the scatter itself.
    freedom
        How well the ratio is known: it is a mean of so many squares.
    """

    value: float
    directions: float
    freedom: float


@dataclass(frozen=True)
class ByParts:
    """A sensor by the check alone: no process is in its graph, whatever the drive has.

    Attributes
    ----------
    sensor
        Index of the sensor.
    vector
        (t, C row by row, H) in m and uT, shape (15,).
    covariance
        Of noise, map and stated errors, shape (15, 15).
    ratios
        Of t, C and H by name: of 16 and 8 parts by time, then by place.
    """

    sensor: int
    vector: FloatArray
    covariance: FloatArray
    ratios: dict[str, tuple[PartsRatio, ...]]


@dataclass(frozen=True)
class Walk:
    """A random walk of a sensor's H, of unit size for each axis at the end of a drive.

    Attributes
    ----------
    rows
        What its m modes do to the white rows of each group, shapes (3 n, m).
    followed
        How far all variables follow them, shape (n, m).
    spread
        Mean square of H about its mean over a drive, along each axis.
    """

    rows: tuple[FloatArray, ...]
    followed: FloatArray
    spread: float

    @classmethod
    def of(
        cls,
        readings: Readings,
        groups: Sequence[WhiteGroup],
        H: IntArray,
        covariance: FloatArray,
    ) -> "Walk":
        """Return the walk of a sensor.

        Parameters
        ----------
        readings
            All that took part.
        groups
            The sensor's.
        H
            Where its offset stands among all n variables, shape (3,).
        covariance
            Of all n variables, shape (n, n).
        """
        modes = TimeModes.over(readings, MODES)
        size = 1 / (np.pi * modes.frequency)
        pull = np.zeros((len(covariance), len(H) * len(size)))
        rows = []
        for each in groups:
            Z = each.following(size * modes.values(readings, each.rows.readings), H)
            pull[each.rows.columns] += each.rows.jacobian.T @ Z
            rows.append(Z)
        spread = float((size[:MODES] ** 2).sum())
        return cls(tuple(rows), covariance @ pull, spread)

    def scores(
        self, groups: Sequence[WhiteGroup], labels: IntArray, influence: FloatArray, white: Gathered
    ) -> FloatArray:
        """Return what parts show of the modes, shape (B, 16, m).

        Parameters
        ----------
        groups
            The sensor's.
        labels
            Part of each reading.
        influence
            Covariance of all variables with the sensor's sixteen, shape (n, 16).
        white
            Sums over the parts.
        """
        found = -np.einsum("bni,nm->bim", white.crossed, self.followed)
        for each, Z in zip(groups, self.rows, strict=True):
            Y = each.rows.jacobian @ influence[each.rows.columns]
            label = np.repeat(labels[each.rows.readings], 3)
            for part in np.unique(label):
                found[part] += Y[label == part].T @ Z[label == part]
        return np.asarray(found)


def by_parts(
    sensor: int,
    vector: FloatArray,
    readings: Readings,
    groups: Sequence[WhiteGroup],
    own: IntArray,
    covariance: FloatArray,
) -> ByParts:
    """Return what the scatter of parts of a drive says of a sensor.

    Parameters
    ----------
    sensor, vector
        Its index, and the estimate of t, C and H, shape (15,).
    readings
        All that took part.
    groups
        Its white rows at the optimum.
    own
        Where its sixteen parameters stand among all n variables, shape (16,).
    covariance
        Of all n variables, shape (n, n).
    """
    P, influence = covariance[np.ix_(own, own)], covariance[:, own]
    rows = [each.rows for each in groups]
    walk = Walk.of(readings, groups, own[BLOCKS["H"]], covariance)
    found: dict[str, list[PartsRatio]] = {"t": [], "C": [], "H": []}
    for labels in divisions(readings, rows):
        white = gathered(rows, labels, own, covariance)
        shown = walk.scores(groups, labels, influence, white)
        for sums, seen in ((white, shown), (white.paired(), shown[::2] + shown[1::2])):
            scores = sums.scores(covariance)
            for name, ratios in found.items():
                block = BLOCKS[name]
                followed, spread = walk.followed[own[block]], walk.spread if name == "H" else 0.0
                share = share_shown(P[block, block], seen[:, block], followed, spread)
                ratio = scores.ratio(block, whitening_of(P[block, block]))
                ratios.append(lasting(ratio, share))
    return ByParts(
        sensor, vector, P[: SENSOR - 1, : SENSOR - 1], {k: tuple(v) for k, v in found.items()}
    )


def share_shown(
    covariance: FloatArray, seen: FloatArray, followed: FloatArray, spread: float
) -> float:
    """Return which share of the variance by an error that lasts the scatter of parts shows.

    Parameters
    ----------
    covariance
        Of k parameters, shape (k, k).
    seen
        What B parts show of its modes, shape (B, k, m).
    followed
        How far the parameters follow these, shape (k, m).
    spread
        Mean square of each parameter itself about its mean.
    """
    white = whitening_of(covariance)
    moved = np.square(white @ followed).sum() + spread * np.square(white).sum()
    return float(np.square(white @ seen).sum() / max(moved, TINY))


def lasting(ratio: VarianceRatio, share: float) -> PartsRatio:
    """Return a ratio of which what is no chance is an error of which parts show a share."""
    value = ratio.value
    if ratio.beyond_chance(CHANCE) > 1:
        value = 1 + (value - 1) * ratio.shown / max(share, TINY)
    return PartsRatio(value, ratio.directions, ratio.parts * ratio.directions)
