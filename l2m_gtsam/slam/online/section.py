"""The last key poses of a drive, solved incrementally by iSAM2; earlier ones are a prior."""

import gtsam
import numpy as np

from l2m_factors import X
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.marginals import net_covariance, unless_indeterminate
from l2m_gtsam.slam.online.belief import POSE

# Steps after which a variable is relinearised: rad and m, as a field is curved within decimetres;
# entries of C; never for H, in which readings are linear.
RELINEARISE = {
    "X": np.full(6, 0.01),
    "T": np.full(3, 0.01),
    "D": np.concatenate([np.full(9, 0.01), np.full(3, np.inf)]),
}
CHOLESKY, QR = "CHOLESKY", "QR"
ANEW = 10  # iterations of a section that is solved again from its beginning


class Section:
    """A stretch of a drive that is solved as it grows.

    Its marginal becomes a Gaussian prior of the next section's variables that both share. GTSAM's
    fixed-lag smoothers, which marginalise one pose after the other, fix such variables at their
    linearisation point of the first marginalisation; here calibrations can be relinearised.

    Linear systems are solved by Cholesky: where calibrations are refined QR takes twice the time.
    Once GTSAM calls a system indeterminate, this and later sections are solved by QR.

    Parameters
    ----------
    calibrations
        Keys of the calibrations that are variables.
    solver
        Of linear systems, to begin with.
    """

    def __init__(self, calibrations: list[int], solver: str = CHOLESKY) -> None:
        self._engine, self._calibrations, self._solver = _engine(solver), calibrations, solver
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()  # all so far
        self._observed: set[int] = set()  # calibrations of sensors with readings

    def add(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, last: int, again: int
    ) -> None:
        """Add factors and new variables up to a key pose, with ``again`` further iterations."""
        for n in range(graph.size()):
            keys = set(graph.at(n).keys())
            if not keys.issubset(self._calibrations):
                self._observed |= keys.intersection(self._calibrations)
        self._graph.push_back(graph)
        self._values.insert(values)
        if self._solver == QR:
            self._update(graph, values, last, again)
        elif unless_indeterminate(lambda: self._update(graph, values, last, again)) is None:
            self._solver, self._engine = QR, _engine(QR)
            self._update(self._graph, self._values, last, ANEW)

    def _update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, last: int, again: int
    ) -> gtsam.ISAM2Result:
        order = self._last_group(last)
        result = self._engine.update(graph, values, constrainedKeys=order)
        for _ in range(again):
            result = self._engine.update(constrainedKeys=order)
        return result

    def _last_group(self, last: int) -> gtsam.KeyGroupMap:
        """Return the groups of variables that are eliminated last.

        What is asked for at each key pose is in the root clique then. The very last are poses:
        Cholesky calls a calibration that only its prior determines indeterminate.
        """
        order = gtsam.KeyGroupMap()
        for key in self._observed:
            order.insert2(key, 1)
        order.insert2(X(last), 2 if self._observed else 1)  # no group may be empty
        return order

    def pose(self, number: int) -> gtsam.Pose3:
        """Return a key pose of the section."""
        return self._engine.calculateEstimatePose3(X(number))

    def calibration(self) -> gtsam.Values:
        """Return the calibrations."""
        return self._engine.calculateEstimate(self._calibrations)

    def values(self) -> gtsam.Values:
        """Return the estimates of all variables."""
        return self._engine.calculateEstimate()

    def covariance(self, last: int) -> FloatArray:
        """Return the joint covariance of the last key pose and the calibrations, in this order."""
        keys = [*self._calibrations, X(last)]
        engine, covariance = self._engine, None
        if self._solver == CHOLESKY:
            covariance = unless_indeterminate(
                lambda: engine.jointMarginalCovariance(keys).fullMatrix()
            )
        if covariance is None:
            left = engine.joint(keys, gtsam.EliminateQR)
            net = left.eliminateSequential(gtsam.Ordering(keys), gtsam.EliminateQR)
            covariance = net_covariance(net, keys)
        return np.roll(covariance, POSE, axis=(0, 1))

    def next(self, last: int) -> "Section":
        """Return a section whose prior is this one's marginal of a key pose and calibrations."""
        keys = [*self._calibrations, X(last)]
        # At its linearisation point; what has moved far from it was relinearised.
        at = self._engine.getLinearizationPoint().extract(keys)
        information = None
        if self._solver == CHOLESKY:
            information = unless_indeterminate(lambda: self._engine.joint(keys))
        if information is None:
            information = self._engine.joint(keys, gtsam.EliminateQR)
        prior = gtsam.LinearContainerFactor.ConvertLinearGraph(information, at)
        section = Section(self._calibrations, self._solver)
        section.add(prior, self._engine.calculateEstimate(keys), last, 0)
        return section


def _engine(solver: str) -> gtsam.ISAM2:
    """Return an empty iSAM2."""
    thresholds = gtsam.ISAM2ThresholdMap()
    for symbol, steps in RELINEARISE.items():
        thresholds.insert((symbol, steps))
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(thresholds)
    params.relinearizeSkip = 1
    params.setFactorization(solver)
    return gtsam.ISAM2(params)
