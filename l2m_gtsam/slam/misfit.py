"""Whether a map explains a drive better than a decoy does: the null hypothesis of the misfit test.

Poses bend a little to fit any field, and some readings always do. Their share alone decides
nothing: a map may be rough, or a place changed here and there. The same drive in the same map
turned by 180 degrees, a decoy that is certainly wrong, shows what chance explains.
"""

from collections.abc import Sequence

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FieldSample, FloatArray
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.solution import DriveSolution

HALF_TURN = np.diag([-1.0, -1.0, 1.0])


class DecoyMap:
    """The field of a map as it is on the other side of a vertical axis, in the map's own axes.

    How strong it is, how it changes along a way and how well it is known stay about the same.

    Parameters
    ----------
    field_map
        The map.
    middle
        A point on the axis in metres, shape (3,).
    """

    def __init__(self, field_map: QueryableMap, middle: FloatArray) -> None:
        self._map, self._middle = field_map, middle

    def query(self, points: FloatArray) -> FieldSample:
        """Return the field there, points in metres of shape (N, 3)."""
        there = self._map.query((points - self._middle) @ HALF_TURN + self._middle)
        return FieldSample(there.field, there.gradient @ HALF_TURN, there.variance, there.inside)

    def field_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m there."""
        sample = self.query(points)
        return sample.field, sample.gradient


LARGEST = 21.0  # squared length of a whitened residual, of 10,000 with noise alone one is larger
AXES = 3
LEAST_WAY_M = 10.0  # over less, poses bend to the right map and to wrong ones alike
DOUBTFUL = 1.25  # times the variance of noise, above which a map is held against a wrong one
# Of what the wrong map leaves. Measured: maps of other places 0.8 to 1.3, the right one 0.3.
MUCH = 0.7
LEAST = 0.5  # of the readings inside the map have to be inside the wrong one, too


def misfits(solution: DriveSolution) -> FloatArray:
    """Return mean squares of the sensors' whitened residuals, those rejected among them, (S,).

    What is far off counts as the least that is rejected, what was read near a change not at all.
    Infinite where a sensor has no reading.
    """
    return _misfits(solution, solution.prediction.inside & ~solution.near_changes)


def _misfits(solution: DriveSolution, judged: BoolArray) -> FloatArray:
    """Return those by some of the readings, (N,)."""
    left = np.full(len(solution.drive.sensors.names), np.inf)
    for sensor in range(len(left)):
        own = judged & (solution.drive.readings.sensor == sensor)
        if own.any():
            left[sensor] = np.minimum(solution.squared[own], LARGEST).mean() / AXES
    return left


def needs_misfit_test(solution: DriveSolution) -> bool:
    """Return whether a drive is long enough to tell, and no sensor is explained down to noise."""
    least, way = misfits(solution).min(), np.linalg.norm(solution.drive.steps.p, axis=1).sum()
    return bool(way >= LEAST_WAY_M and np.isfinite(least) and least > DOUBTFUL)


def decoy_maps(drive: Drive, field_map: QueryableMap) -> tuple[DecoyMap, ...]:
    """Return the map half turned about the middle of a drive, and about a place beside it."""
    p = np.stack([pose.translation() for pose in drive.dead_reckoning()])
    middle, extent = p.mean(axis=0), np.ptp(p, axis=0)
    beside = np.where(np.arange(AXES) == np.argmax(extent[:2]), extent / 6, 0.0)
    return DecoyMap(field_map, middle), DecoyMap(field_map, middle + beside)


def fits_decoy_as_well(solution: DriveSolution, wrong: Sequence[DriveSolution]) -> bool:
    """Return whether a drive fits a map hardly better than one of some that are wrong."""
    inside, best = solution.prediction.inside.sum(), int(np.argmin(misfits(solution)))
    others = [each for each in wrong if each.prediction.inside.sum() >= LEAST * inside]
    return any(_fits_no_better(solution, each, best) for each in others)


def _fits_no_better(solution: DriveSolution, wrong: DriveSolution, sensor: int) -> bool:
    """Return whether the readings of a sensor fit hardly better than in a wrong map.

    Those that neither map explains, as beside a door, tell nothing of which of them is right.
    """
    told = solution.used | wrong.used
    left, other = (
        _misfits(each, each.prediction.inside & ~each.near_changes & told)[sensor]
        for each in (solution, wrong)
    )
    return bool(left > MUCH * other)
