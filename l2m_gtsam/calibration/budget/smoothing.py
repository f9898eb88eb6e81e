r"""A sensor that smooths its readings, by a low-pass filter or a mean over some time.

With h(s) how much of a reading is of the field s seconds ago, m the mean of s and v its variance,

.. math::
    \int h(s)\, b(\tau - s)\, ds = b(\tau - m) + \tfrac{v}{2}\, \ddot b(\tau - m) + \dots

The mean is a time offset, a variable of the graph; the variance is the weight of one mode. A filter
of first order with a time constant of T has a mean of T and a variance of T^2, a mean over a time W
has W / 2 and W^2 / 12.
"""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.budget.processes import Process
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.records.error_budget import DisturbanceKind

LAGGING_S = 0.015  # a filter that delays by less smooths by less, which does not show


@dataclass(frozen=True)
class Smoothing(Process):
    """Readings of a sensor are means over some time."""

    sensor: int
    kind = DisturbanceKind.SMOOTHING

    @property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of a variance in s^2, whose own is one."""
        return (np.ones((1, 1)),)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what a variance does to the field, uT/s^2 in the lidar frame, shape (n, 3, 1)."""
        if self.places.bend is None:
            return np.zeros((len(rows), 3, 1))
        return np.asarray(0.5 * self.places.bend[rows, :, None])

    def named(self, form: int, sizes: FloatArray) -> dict[str, float]:
        """Return over how long readings are means: the standard deviation of the time."""
        return {"smoothing_s": float(sizes[0] ** 0.25)}
