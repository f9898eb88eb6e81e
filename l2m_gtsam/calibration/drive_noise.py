r"""The noise of a sensor on each of several drives.

A motor that runs, or a filter that was set otherwise, makes readings of one drive noisier than
those of another. One noise for both gives the better drive too little weight, and rejects readings
of the other one.

Of residuals e that follow each other in time the differences have what changes between neighbours
alone: neither the map's errors nor those of poses, nor H that drifts. A median of their squares is
that of noise while fewer than half are wrong:

.. math:: \sigma^2 = \text{median}(|e_{n+1} - e_n|^2) / (2 \cdot 2.37)
"""

from dataclasses import replace

import numpy as np

from l2m_gtsam.calibration.alternation import Alternated
from l2m_gtsam.calibration.trust import residuals
from l2m_gtsam.calibration.view import QueryableMap, StandIns, glimpse
from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.solve.robust import MEDIAN

FEWEST = 30  # readings of a drive that its noise is estimated from
# Of the logarithm of such a noise, times the root of the readings: by a median that of three
# squares is 0.56, neighbours have a reading in common.
SCATTER = 0.65
SURE_SIGMAS = 4.0  # by which two drives differ, of that


def with_drive_noise(
    readings: Readings, stand_ins: StandIns, field_map: QueryableMap, near: Alternated
) -> Readings:
    """Return readings with the noise of their drives, where these differ.

    Parameters
    ----------
    readings
        Of S sensors.
    stand_ins
        Those at which the map is asked for its variance.
    field_map, near
        What they are compared with: the map, and where sensors are, about.
    """
    if readings.drive is None or readings.relative_noise is not None:
        return readings
    view = glimpse(readings, stand_ins, field_map, near.estimate, near.asked, FEWEST)
    e, drives = residuals(view.readings, field_map, near.estimate), int(readings.drive.max()) + 1
    ratio = np.ones((len(readings.sensors), drives))
    for sensor in view.sensors:
        own = view.readings.rows_of(sensor)
        ratio[sensor] = noise_ratios(e[own], view.readings.of_drive[own], drives)
    if (ratio == 1).all():
        return readings
    return replace(readings, relative_noise=ratio[readings.sensor, readings.drive])


def noise_ratios(residual: FloatArray, drive: IntArray, drives: int) -> FloatArray:
    """Return how large a sensor's noise is on each of K drives beside that of all, shape (K,).

    Parameters
    ----------
    residual
        Of N readings, of each drive in order of time, in uT, shape (N, 3).
    drive
        Which each is of, ascending, shape (N,).
    drives
        How many there are. One with too few readings has the noise of all.

    Returns
    -------
    FloatArray
        Ones if chance explains how drives differ. The mean square over all readings is one.
    """
    count, squared, ratio = np.bincount(drive, minlength=drives), np.zeros(drives), np.ones(drives)
    step = np.sum(np.diff(residual, axis=0) ** 2, axis=1)
    of_step = np.where(np.diff(drive) == 0, drive[1:], -1)
    enough = np.flatnonzero(count >= FEWEST)
    for each in enough:
        squared[each] = np.median(step[of_step == each]) / (2 * MEDIAN)
    if len(enough) < 2 or not squared[enough].all():
        return ratio
    size, sigma = np.log(squared[enough]) / 2, SCATTER / np.sqrt(count[enough])
    apart = np.abs(size[:, None] - size) / np.hypot(sigma[:, None], sigma)
    if apart.max() < SURE_SIGMAS:
        return ratio
    ratio[enough] = np.sqrt(squared[enough] / np.average(squared[enough], weights=count[enough]))
    return ratio
