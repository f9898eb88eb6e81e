"""Whether a map explains a drive better than a decoy does: the null hypothesis of the misfit test.

Poses bend a little to fit any field, and some readings always do. Their share alone decides
nothing: a map may be rough, or a place changed here and there. The same drive in the same map
turned by 180 degrees, a decoy that is certainly wrong, shows what chance explains.
"""

from collections.abc import Sequence

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FieldSample, FloatArray
from l2m_gtsam.slam.drive import Drive, stacked
from l2m_gtsam.slam.solution import DriveSolution

HALF_TURN = np.diag([-1.0, -1.0, 1.0])
AXES = 3
LARGEST = 21.0  # limit of a whitened residual's square: by noise 1 of 10,000 is larger
LEAST_PATH_M = 10.0  # over shorter drives, poses bend to the right map and to decoys alike
DOUBTFUL = 1.25  # times the variance of noise, above which the test is made
# Mean square of the whitened components by which the first pose differs from the start. Measured:
# maps of other places 14 to 49, with one sensor or over 15 m 3 to 52; the right one up to 1, 7 with
# a calibration that was off by 3 %, and 16 where new steel had led the poses astray by a metre.
FAR_START = 10.0
# Of what the decoy leaves. Measured: maps of other places 0.8 to 1.3, the right one 0.3.
MUCH = 0.7
LEAST_INSIDE = 0.5  # share of the readings inside the map that must be inside the decoy, too


class DecoyMap:
    """A map turned by 180 degrees about a vertical axis: the null hypothesis of the misfit test.

    Strength, gradients and uncertainty of the field stay about the same; the field's vectors are
    those of the other side of the axis, in the map's own axes.

    Parameters
    ----------
    field_map
        The map that is tested.
    middle
        A point on the axis in metres, shape (3,).
    """

    def __init__(self, field_map: QueryableMap, middle: FloatArray) -> None:
        self._map, self._middle = field_map, middle

    def query(self, points: FloatArray) -> FieldSample:
        """Return field, gradient and variance at points in metres, shape (N, 3)."""
        there = self._map.query(self._turned(points))
        # Chain rule: positions are turned, the field's vectors are not.
        return FieldSample(there.field, there.gradient @ HALF_TURN, there.variance, there.inside)

    def field_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m, extended as the map's are.

        A query has NaN where the map has no data, with which no solver goes on.
        """
        field, gradient = self._map.field_and_gradient(self._turned(points))
        return field, gradient @ HALF_TURN

    def _turned(self, points: FloatArray) -> FloatArray:
        return np.asarray((points - self._middle) @ HALF_TURN + self._middle)


def misfits(solution: DriveSolution) -> FloatArray:
    """Return each sensor's mean square of whitened residuals, rejected ones included, (S,).

    Squares are limited to ``LARGEST``; readings near a change of the field are left out. Infinite
    where a sensor has no reading.
    """
    return _misfits(solution, solution.prediction.inside & ~solution.near_changes)


def _misfits(solution: DriveSolution, judged: BoolArray) -> FloatArray:
    """Return the same by some of the N readings."""
    left = np.full(len(solution.drive.sensors.names), np.inf)
    for sensor in range(len(left)):
        own = judged & (solution.drive.readings.sensor == sensor)
        if own.any():
            left[sensor] = np.minimum(solution.squared[own], LARGEST).mean() / AXES
    return left


def needs_misfit_test(solution: DriveSolution) -> bool:
    """Return whether a drive is long enough for the test, and no sensor fits down to its noise."""
    # With those near changes: in the map of another place half of the readings may seem to be.
    least = _misfits(solution, solution.prediction.inside).min()
    path = np.linalg.norm(solution.drive.steps.p, axis=1).sum()
    return bool(path >= LEAST_PATH_M and np.isfinite(least) and least > DOUBTFUL)


def begins_elsewhere(solution: DriveSolution) -> bool:
    """Return whether a drive that the map does not explain begins far from its start, too.

    Each alone has harmless causes: a map that is rough or has changed, a start that was given
    inexactly. In the map of another place poses are moved to wherever some of the readings fit.
    """
    return solution.start_chi2 > FAR_START and needs_misfit_test(solution)


def decoy_maps(drive: Drive, field_map: QueryableMap) -> tuple[DecoyMap, ...]:
    """Return decoys turned about the centre of a drive, and about a point beside it."""
    _, p = stacked(drive.dead_reckoning())
    middle, extent = p.mean(axis=0), np.ptp(p, axis=0)
    beside = np.where(np.arange(AXES) == np.argmax(extent[:2]), extent / 6, 0.0)
    return DecoyMap(field_map, middle), DecoyMap(field_map, middle + beside)


def fits_decoy_as_well(solution: DriveSolution, decoys: Sequence[DriveSolution]) -> bool:
    """Return whether a drive fits its map hardly better than one of the decoys."""
    inside, best = solution.prediction.inside.sum(), int(np.argmin(misfits(solution)))
    tested = [each for each in decoys if each.prediction.inside.sum() >= LEAST_INSIDE * inside]
    return any(_fits_as_well(solution, each, best) for each in tested)


def _fits_as_well(solution: DriveSolution, decoy: DriveSolution, sensor: int) -> bool:
    """Return whether a sensor's readings fit a decoy nearly as well as the map.

    Readings that neither explains, as beside a door, do not discriminate between the two.
    """
    explained = solution.used | decoy.used
    left, other = (
        _misfits(each, each.prediction.inside & ~each.near_changes & explained)[sensor]
        for each in (solution, decoy)
    )
    return bool(left > MUCH * other)
