"""What readings and priors determine together, and what only the priors do.

A sensor that baselines connect to others is tested with all of these unknown: they are eliminated
from the rows of the cluster, and what remains speaks of the one sensor alone.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import block_diag, solve_triangular

from l2m_gtsam.calibration.optimise import clusters_of
from l2m_gtsam.calibration.priors import HOLD_S, Priors, prior_rows
from l2m_gtsam.calibration.sensor_columns import SENSOR, columns_among, rows_in
from l2m_gtsam.data import FloatArray
from l2m_gtsam.solve.rank import PARAMETERS, Determinacy, RankOptions, timed_determinacy

# Of the largest sigma of use: what is known of other sensors at least. It is as good as nothing.
LOOSE = 1e3
TIME_OFFSET = "time offset"
# A value is mostly a prior's if its sigma was so many times larger without: three quarters of what
# is known of it is not from the readings.
MOSTLY = 2.0


def determinacies(
    jacobians: Mapping[int, FloatArray], priors: Priors, values: gtsam.Values, options: RankOptions
) -> dict[int, Determinacy]:
    """Test the rank of every sensor.

    Parameters
    ----------
    jacobians
        Derivatives of each sensor's whitened residuals by (t, C row by row, H, offset), (M, 16).
    priors
        What is known beforehand.
    values
        Where priors are linearised: ``T(i)`` and ``D(i)``.
    options
        The scales of the test.
    """
    alone = {sensor: timed_determinacy(J, options) for sensor, J in jacobians.items()}
    if not priors.each:
        return alone
    held = frozenset(sensor for sensor, test in alone.items() if not test.offset)
    linear, tests = priors.graph(jacobians).linearize(values), dict(alone)
    for sensors in clusters_of(linear, list(jacobians)):
        known = Priors(priors.among(sensors))
        if known.each:
            few = {each: np.asarray(np.linalg.qr(jacobians[each], mode="r")) for each in sensors}
            cluster = Cluster(sensors, few, held, values, options)
            tests |= {each: with_priors(each, cluster, known) for each in sensors}
    return tests


@dataclass(frozen=True)
class Cluster:
    """Sensors that priors connect, or one alone.

    Attributes
    ----------
    sensors
        Which.
    jacobians
        Rows on each sensor that say what its readings do, shape (M, 16).
    held
        Sensors whose readings do not determine their time offset: in the graph it is held.
    values
        Where priors are linearised.
    options
        The scales of the test.
    """

    sensors: tuple[int, ...]
    jacobians: Mapping[int, FloatArray]
    held: frozenset[int]
    values: gtsam.Values
    options: RankOptions

    def rows_of(self, sensor: int, priors: Priors) -> FloatArray:
        """Return rows on one sensor that say what all do when the others are unknown, (M, 16)."""
        others = [other for other in self.sensors if other != sensor]
        readings = block_diag(*(self.jacobians[sensor] for sensor in self.sensors))
        known = [prior_rows(each, self.values, self.sensors)[0] for each in priors.each]
        rows = [readings, *known, *map(self._loose, others)]
        columns = columns_among(self.sensors, (*others, sensor))
        triangular = np.asarray(np.linalg.qr(np.concatenate(rows)[:, columns], mode="r"))
        first = SENSOR * len(others)
        return triangular[first:, first:]

    def _loose(self, other: int) -> FloatArray:
        """Return rows that keep another sensor's parameters finite and its offset where held."""
        scale = np.append(self.options.scale(), self.options.useful_offset_s)
        strength = 1 / (LOOSE * scale)
        if other in self.held:
            strength[-1] = 1 / HOLD_S
        rows = np.zeros((SENSOR, SENSOR * len(self.sensors)))
        rows[:, rows_in(self.sensors, other)] = np.diag(strength)
        return rows


def with_priors(sensor: int, cluster: Cluster, priors: Priors) -> Determinacy:
    """Return the rank test of a sensor with its cluster, and which priors decide what.

    Parameters
    ----------
    sensor
        The one that is tested.
    cluster
        Its cluster.
    priors
        What is known of the cluster.
    """
    scales = cluster.options
    every = Known.of(cluster.rows_of(sensor, priors), scales)
    before = Known.of(cluster.jacobians[sensor], scales)
    opened, weaker = before.open - every.open, before.weaker_than(every)
    kinds = list(dict.fromkeys(p.kind for p in priors.each)) if opened | weaker else []
    without = {
        kind: Known.of(cluster.rows_of(sensor, priors.without(kind)), scales) for kind in kinds
    }
    open_by = {kind: each.open for kind, each in without.items()}
    weaker_by = {kind: each.open | each.weaker_than(every) for kind, each in without.items()}
    return replace(
        every.test,
        borrowed=_reasons(opened, open_by),
        leaning=_reasons(weaker, weaker_by),
        lent=every.test.free - before.test.free,
    )


def _reasons(names: Collection[str], missed: Mapping[str, Collection[str]]) -> dict[str, str]:
    """Return by name the kinds of prior without any one of which it is missed, or all of them."""
    reasons = {}
    for name in (each for each in (*PARAMETERS, TIME_OFFSET) if each in names):
        needed = [kind for kind, without in missed.items() if name in without]
        reasons[name] = " and ".join(needed) or " or ".join(missed)
    return reasons


@dataclass(frozen=True)
class Known:
    """What rows on one sensor say of it.

    Attributes
    ----------
    test
        The rank test.
    open
        Names of the parameters that it leaves open.
    sigma
        Of the 15 parameters, where they are not, shape (15,).
    """

    test: Determinacy
    open: frozenset[str]
    sigma: FloatArray

    @classmethod
    def of(cls, rows: FloatArray, options: RankOptions) -> "Known":
        """Test white rows, shape (M, 16)."""
        test = timed_determinacy(rows, options)
        open_ = {PARAMETERS[index] for index in np.flatnonzero(test.touched)}
        held = np.zeros((len(test.held) + 1, SENSOR))
        held[:-1, :-1] = test.held
        held[-1, -1] = 0.0 if test.offset else 1 / HOLD_S
        scale = np.append(options.scale(), options.useful_offset_s)
        triangular = np.asarray(np.linalg.qr(np.concatenate([rows, held]) * scale, mode="r"))
        root = scale[:, None] * solve_triangular(triangular, np.eye(SENSOR))
        sigma = np.linalg.norm(root, axis=1)[:-1]
        return cls(test, frozenset(open_ if test.offset else open_ | {TIME_OFFSET}), sigma)

    def weaker_than(self, other: "Known") -> frozenset[str]:
        """Return what both determine, but this one far less."""
        far = np.flatnonzero(self.sigma > MOSTLY * other.sigma)
        return frozenset(PARAMETERS[index] for index in far) - self.open - other.open
