"""What priors say of places before any is looked at: bounds, and groups that move as one."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import shift

from l2m_gtsam.calibration.priors import Coordinate, Difference, Priors
from l2m_gtsam.data import FloatArray

SIGMAS = 3.0
TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class Bounds:
    """Where sensors can be: lowest and highest coordinates in metres, shapes (S, 3)."""

    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, priors: Priors, count: int) -> "Bounds":
        """Return three sigmas about what was measured, and no bounds elsewhere."""
        bounds = cls(np.full((count, 3), -np.inf), np.full((count, 3), np.inf))
        for each in priors.each:
            if isinstance(each, Coordinate):
                at = each.sensors[0], each.axis
                bounds.low[at] = each.value - SIGMAS * each.sigma
                bounds.high[at] = each.value + SIGMAS * each.sigma
        return bounds


@dataclass(frozen=True)
class Rigid:
    """Sensors whose places follow from that of the first.

    Attributes
    ----------
    sensors
        Which.
    offset
        Where each is from the first, in the lidar frame in metres, shape (n, 3).
    """

    sensors: tuple[int, ...]
    offset: FloatArray


def rigid_groups(priors: Priors, sensors: Collection[int]) -> list[Rigid]:
    """Return those of some sensors that baselines with a vector connect; none alone."""
    links: dict[int, list[tuple[int, FloatArray]]] = {sensor: [] for sensor in sensors}
    for each in priors.among(sensors):
        if isinstance(each, Difference) and each.rigid:
            first, second = each.sensors
            links[first].append((second, each.vector))
            links[second].append((first, -each.vector))
    groups, placed = [], set[int]()
    for sensor in sensors:
        if sensor not in placed and links[sensor]:
            places = reached(sensor, links)
            placed |= set(places)
            groups.append(Rigid(tuple(places), np.array(list(places.values()))))
    return groups


def reached(start: int, links: dict[int, list[tuple[int, FloatArray]]]) -> dict[int, FloatArray]:
    """Return places by sensor from a start along links, the start's first, in metres, (3,) each.

    Links are vectors in the lidar frame from a sensor to others, metres, shape (3,).
    """
    places = {start: np.zeros(3)}
    waiting = [start]
    while waiting:
        here = waiting.pop()
        for other, vector in links[here]:
            if other not in places:
                places[other] = places[here] + vector
                waiting.append(other)
    return places


def placed(t: FloatArray, given: Collection[int], priors: Priors) -> FloatArray:
    """Return places in metres, shape (S, 3), that agree with what is known.

    Parameters
    ----------
    t
        Places to begin with, shape (S, 3).
    given
        Sensors that stay there; the others go where they were measured or where vectors put them.
    priors
        What is known.
    """
    t = t.copy()
    measured = [each for each in priors.each if isinstance(each, Coordinate)]
    for each in measured:
        if each.sensors[0] not in given:
            t[each.sensors[0], each.axis] = each.value
    for group in rigid_groups(priors, range(len(t))):
        counts = [sum(each.sensors[0] == sensor for each in measured) for sensor in group.sensors]
        first = max(range(len(counts)), key=lambda row: (group.sensors[row] in given, counts[row]))
        base = t[group.sensors[first]] - group.offset[first]
        for sensor, offset in zip(group.sensors, group.offset, strict=True):
            if sensor not in given:
                t[sensor] = base + offset
    return t


def bounded(left: FloatArray, nodes: Sequence[FloatArray], bounds: Bounds) -> FloatArray:
    """Return misfits (nx, ny, nz, S), infinite where a sensor cannot be.

    ``nodes`` are the coordinates of the lattice along each axis in metres.
    """
    left = left.copy()
    for axis, along in enumerate(nodes):
        step = along[1] - along[0] if len(along) > 1 else 0.0
        low, high = bounds.low[:, axis] - step, bounds.high[:, axis] + step
        out = (along[:, None] < low) | (along[:, None] > high)
        shape = [1, 1, 1, len(low)]
        shape[axis] = len(along)
        left[np.broadcast_to(out.reshape(shape), left.shape)] = np.inf
    return left


def pooled(left: FloatArray, groups: Sequence[Rigid], step: float) -> FloatArray:
    """Return misfits (nx, ny, nz, S) in which those of a group are one and the same.

    That is the geometric mean over its sensors, each at its own place: what the noise of each is
    does not matter. A sensor that is nowhere to be found has no part in it.
    """
    left = left.copy()
    for group in groups:
        shifts = np.round(group.offset / step).astype(int)
        parts = [
            np.log(np.maximum(moved(left[..., sensor], by), TINY))
            for sensor, by in zip(group.sensors, shifts, strict=True)
            if np.isfinite(left[..., sensor]).any()
        ]
        if parts:
            # Profile likelihoods multiply; of n readings each goes as rms^-3n, any noise.
            mean = np.exp(np.mean(parts, axis=0))
            for sensor, by in zip(group.sensors, shifts, strict=True):
                left[..., sensor] = moved(mean, -by)
    return left


def moved(values: FloatArray, by: FloatArray) -> FloatArray:
    """Return values (nx, ny, nz) of the nodes so many steps on; infinite beyond the last."""
    return np.asarray(shift(values, -by, order=0, cval=np.inf))
