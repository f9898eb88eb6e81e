r"""What errors of the sensors that surveyed do to the readings of a map.

A sensor's errors are those of ``(t, C row by row, H, time offset)``, 16 numbers. They move a
reading, ``dx``, and change it, ``dy``. What the map is given is then wrong by
``dy - G dx``, G the field's gradient there. All readings of a sensor share its errors, at every
place and in every pass: more readings do not average them out (Schmidt 1966 calls such numbers
"considered").
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from l2m_gtsam.data import BoolArray, FloatArray, IntArray

SIZE = 16  # errors of a sensor: t, C row by row, H, time offset
SHIFT = 6  # of a reading: its position, then its field


@dataclass(frozen=True)
class FoundErrors:
    """What the errors of S sensors were found to be by the survey itself.

    Attributes
    ----------
    mean
        By so much readings are corrected, shape (16 S,); of positions and clocks zero.
    stated
        Covariance before the survey was asked, shape (16 S, 16 S).
    """

    mean: FloatArray
    stated: FloatArray

    def followed_by(self, other: "FoundErrors") -> "FoundErrors":
        """Return the same of these sensors and of others."""
        mean = np.concatenate([self.mean, other.mean])
        return FoundErrors(mean, block_diag(self.stated, other.stated))


@dataclass(frozen=True)
class SuiteErrors:
    """How readings of S sensors hang on the sensors' errors.

    A reading of a map may be an average over several sensors: P pairs of a reading and a sensor
    that has a share in it.

    Attributes
    ----------
    sensors
        Names, S of them.
    covariance
        Of all sensors' errors in m, 1, uT and s, shape (16 S, 16 S).
    reading, sensor
        Of each pair, shapes (P,).
    shift
        What a unit of each error does to position and field of the reading, both in the map frame,
        m and uT, shape (P, 6, 16).
    found
        What the errors were found to be; the covariance is that of what is left beside it. Absent
        where readings are as they were taken.
    """

    sensors: tuple[str, ...]
    covariance: FloatArray
    reading: IntArray
    sensor: IntArray
    shift: FloatArray
    found: FoundErrors | None = None

    @property
    def stated(self) -> bool:
        """Whether any error is."""
        return bool(self.covariance.any())

    @property
    def calibrated_together(self) -> bool:
        """Whether sensors have errors in common, as those that a survey has calibrated.

        If it was this very survey it fits them better than their sigmas, which are right
        nevertheless: it must not be asked twice.
        """
        own = np.kron(np.eye(len(self.sensors)), np.ones((SIZE, SIZE)))
        return bool(self.covariance[own == 0].any())

    def averaged(self, owner: IntArray, weight: FloatArray) -> "SuiteErrors":
        """Return the errors of averages over readings.

        Parameters
        ----------
        owner
            Average that each reading goes into, shape (N,).
        weight
            Of each reading, shape (N,).
        """
        share = (weight / np.bincount(owner, weight)[owner])[self.reading]
        pair = owner[self.reading] * len(self.sensors) + self.sensor
        pairs, at = np.unique(pair, return_inverse=True)
        shift = np.zeros((len(pairs), SHIFT, SIZE))
        np.add.at(shift, at, self.shift * share[:, None, None])
        reading, sensor = np.divmod(pairs, len(self.sensors))
        return replace(self, reading=reading, sensor=sensor, shift=shift)

    def only(self, keep: BoolArray) -> "SuiteErrors":
        """Return the errors of some of N readings, (N,)."""
        number, own = np.cumsum(keep) - 1, keep[self.reading]
        return replace(
            self,
            reading=number[self.reading[own]],
            sensor=self.sensor[own],
            shift=self.shift[own],
        )

    def as_sure_as(self, other: "SuiteErrors") -> "SuiteErrors | None":
        """Return the same with the covariance of others; None unless they are the same sensors.

        It is the one that was stated: nothing that was found is taken off these readings yet.
        """
        stated = other.covariance if other.found is None else other.found.stated
        return replace(self, covariance=stated) if self.sensors == other.sensors else None

    def as_found_by(self, other: "SuiteErrors | None") -> "SuiteErrors":
        """Return the same with what others found of the same sensors, stated to be as accurate."""
        if other is None or other.found is None or self.sensors != other.sensors:
            return self
        if not np.array_equal(self.covariance, other.found.stated):
            return self
        return replace(self, covariance=other.covariance, found=other.found)

    def corrected(self, field: FloatArray) -> FloatArray:
        """Return what N readings as they were taken, (N, 3) in uT, are without what was found."""
        if self.found is None:
            return field
        own = self.found.mean.reshape(-1, SIZE)[self.sensor]
        change = np.zeros_like(field)
        np.add.at(change, self.reading, np.einsum("pij,pj->pi", self.shift[:, 3:], own))
        return np.asarray(field - change)

    def followed_by(self, other: "SuiteErrors", first: int) -> "SuiteErrors":
        """Return the errors of these readings and of others that are numbered from ``first`` on.

        The same sensors with the same covariance have the same errors in both; others have none
        in common.
        """
        same = self.sensors == other.sensors
        if same and np.array_equal(self.covariance, other.covariance):
            sensors, covariance, shifted = self.sensors, self.covariance, other.sensor
            found = self.found
        else:
            found = None
            if self.found is not None or other.found is not None:
                found = self._as_found().followed_by(other._as_found())
            sensors = (*self.sensors, *other.sensors)
            covariance = block_diag(self.covariance, other.covariance)
            shifted = other.sensor + len(self.sensors)
        return SuiteErrors(
            sensors,
            covariance,
            np.concatenate([self.reading, other.reading + first]),
            np.concatenate([self.sensor, shifted]),
            np.concatenate([self.shift, other.shift]),
            found,
        )

    def _as_found(self) -> FoundErrors:
        """Return what was found of the sensors: nothing, where readings are as they were taken."""
        return self.found or FoundErrors(np.zeros(len(self.covariance)), self.covariance)

    def mean_shift(self, weight: FloatArray) -> FloatArray:
        """Return how far a unit of each error moves readings of these weights, (N,), on average.

        In the map frame in metres, shape (3, 16 S).
        """
        shift = np.zeros((len(self.sensors), 3, SIZE))
        np.add.at(shift, self.sensor, self.shift[:, :3] * weight[self.reading, None, None])
        return np.asarray(shift.transpose(1, 0, 2).reshape(3, -1) / weight.sum())

    def of_field(self, rows: IntArray, gradient: FloatArray) -> FloatArray:
        """Return what a unit of each error does to the field that readings stand for.

        Parameters
        ----------
        rows
            Which readings, sorted, shape (n,).
        gradient
            G there in uT/m, shape (n, 3, 3).

        Returns
        -------
        FloatArray
            uT, shape (n, 3, 16 S).
        """
        at = np.searchsorted(rows, self.reading)
        known = np.flatnonzero(rows[np.minimum(at, len(rows) - 1)] == self.reading)
        n, at = len(rows), at[known]
        # A reading that was taken elsewhere stands for the field here less what lies between: G dx.
        change = self.shift[known, 3:] - gradient[at] @ self.shift[known, :3]
        effect = np.zeros((n, len(self.sensors), 3, SIZE))
        effect[at, self.sensor[known]] = change  # each pair is there once
        return np.asarray(effect.transpose(0, 2, 1, 3).reshape(n, 3, -1))
