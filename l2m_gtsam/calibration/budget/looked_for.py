"""All processes that are looked for on a drive."""

from collections.abc import Sequence

import numpy as np

from l2m_gtsam.calibration.budget.processes import (
    WANDER_MODES,
    FieldProcess,
    PoseProcess,
    Process,
    ReadingPlaces,
    TimeModes,
    Wander,
    Warp,
)
from l2m_gtsam.calibration.budget.sensor_processes import (
    CLOCK_MODES,
    ClockDrift,
    MotionUnits,
    MovingParts,
    Smoothing,
)

# Of each of six errors of poses, and of fields: what lasts a second is half a wave of 1.75 s and
# more. With fewer modes than that, errors of poses look like fields.
FINEST_S = 1.75
FAST_MODES = (48, 96)  # at least and at most: a thousand weights take seconds


def processes(
    places: ReadingPlaces, sensors: Sequence[int], lagging: Sequence[int] = ()
) -> tuple[Process, ...]:
    """Return all that is looked for; errors of poses only where none are stated.

    Parameters
    ----------
    places
        What readings are taken at.
    sensors
        Whose readings they are.
    lagging
        Sensors that may have a filter: one delays by as much as it smooths. Noise of poses that
        is new with each looks like one, too: their mean over a moment is better than each.
    """
    readings = places.readings
    slow = TimeModes.over(readings, WANDER_MODES)
    found: list[Process] = [Wander(places, sensor, slow) for sensor in sensors]
    if readings.motion is not None:
        slowest = TimeModes.over(readings, CLOCK_MODES)
        found += [ClockDrift(places, sensor, slowest) for sensor in sensors]
        filtered = lagging if readings.pose_root is None else ()
        found += [Smoothing(places, sensor) for sensor in filtered]
        vehicle = MotionUnits.over(readings, readings.motion)
        found += [MovingParts(places, sensor, vehicle) for sensor in sensors]
    count = int(np.clip(np.ceil(slow.duration.max() / FINEST_S), *FAST_MODES))
    fast = TimeModes.over(readings, count)
    if len(sensors) > 1:  # of one sensor's wander it cannot be told
        found.append(FieldProcess(places, fast))
    if readings.pose_root is None:
        found.append(PoseProcess(places, fast))
    return (*found, Warp.of(places))
