"""The processes of a drive as variables of the last graph: ``W(i)``, ``K(i)`` and so on.

Weights have unit variance there. Errors of poses become those of ``pose_errors``, which know how
they go on between the knots, as if they had been stated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from l2m_factors import A, B, F, K, L, SharedError, W
from l2m_gtsam.calibration.budget.processes import (
    LASTING_S,
    POSE_PARTS,
    WANDER_MODES,
    ReadingPlaces,
)
from l2m_gtsam.calibration.budget.search import FoundProcess
from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.records.error_budget import Disturbance, DisturbanceKind

AXES = 3
OF_A_SENSOR = {
    DisturbanceKind.WANDER: W,
    DisturbanceKind.CLOCK: K,
    DisturbanceKind.SMOOTHING: L,
    DisturbanceKind.MOVING_PARTS: A,
}


@dataclass(frozen=True)
class Budget:
    """The processes that were found, each at most once for all readings or for a sensor."""

    found: tuple[FoundProcess, ...] = ()

    @cached_property
    def variables(self) -> dict[int, FoundProcess]:
        """Those that are variables of their own, by key; the graph knows errors of poses."""
        others = [each for each in self.found if each.process.kind is not DisturbanceKind.POSES]
        return {_key(each): each for each in others}

    @property
    def sizes(self) -> dict[int, int]:
        """Number of weights of each key of the graph."""
        return {key: len(each.variances) for key, each in self.variables.items()}

    @property
    def poses(self) -> FoundProcess | None:
        """Errors of poses, if there are any."""
        own = [each for each in self.found if each.process.kind is DisturbanceKind.POSES]
        return own[0] if own else None

    @property
    def warp(self) -> FoundProcess | None:
        """The bend of the frame, if there is one."""
        return self.variables.get(F())

    def lasting(self, stated_s: float) -> float:
        """Return how long errors of poses last: as found, or else as stated."""
        return stated_s if self.poses is None else LASTING_S[self.poses.form]

    def on(self, readings: Readings) -> Readings:
        """Return readings whose poses are as wrong as was found."""
        if self.poses is None:
            return readings
        root = np.diag(np.sqrt(self.poses.sizes @ np.array(list(POSE_PARTS.values()))))
        return replace(readings, pose_root=np.broadcast_to(root, (len(readings), 6, 6)))

    def at(self, places: ReadingPlaces) -> "Budget":
        """Return the same processes in other readings of the same drive."""
        moved = (replace(each, process=each.process.on(places)) for each in self.found)
        return Budget(tuple(moved))

    def errors(self, sensor: int, rows: IntArray) -> tuple[SharedError, ...]:
        """Return what some readings of a sensor share."""
        return tuple(
            SharedError(key, each.process.features(rows) * np.sqrt(each.variances))
            for key, each in self.variables.items()
            if each.process.sensor in (None, sensor)
        )

    def wander(self, sensor: int) -> FoundProcess | None:
        """Return how H of a sensor wanders, if it does."""
        return self.variables.get(W(sensor))

    def named(self, sensors: Sequence[str]) -> tuple[Disturbance, ...]:
        """Return what was found as records, with the names of all sensors."""
        return tuple(_record(each, sensors) for each in self.found)


def spread_of_H(found: FoundProcess, weights: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the mean square of H at any moment of a drive about H as reported, uT^2, (3, 3).

    Parameters
    ----------
    found
        How H wanders.
    weights, covariance
        Of unit variance by the prior, shapes (m,) and (m, m).
    """
    # Modes have a mean square of one over a drive, and are orthogonal to each other.
    drives = len(weights) // (AXES * WANDER_MODES)
    root = np.sqrt(found.variances)
    moments = (covariance + np.outer(weights, weights)) * np.outer(root, root)
    blocks = moments.reshape(len(root) // AXES, AXES, -1, AXES)
    each = np.arange(len(blocks))
    return np.asarray(blocks[each, :, each].sum(axis=0) / drives)


def _key(found: FoundProcess) -> int:
    sensor, kind = found.process.sensor, found.process.kind
    if sensor is not None:
        return OF_A_SENSOR[kind](sensor)
    return B() if kind is DisturbanceKind.FIELD else F()


def _record(found: FoundProcess, sensors: Sequence[str]) -> Disturbance:
    process = found.process
    whose = None if process.sensor is None else sensors[process.sensor]
    named = process.named(found.form, found.sizes)
    return Disturbance(process.kind, named, found.gain, whose)


NOTHING_FOUND = Budget()
