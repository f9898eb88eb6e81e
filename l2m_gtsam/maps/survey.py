"""What is wrong with a survey as far as its readings show it, whatever map is made of them."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.training import TrainingSet

NARROW = 0.1  # metres; a drive this close to one line does not determine the field beside it
SAME_PLACE = 0.05  # metres; edge of a cube in which all readings should agree
# In microtesla; a gradient of 200 uT/m would be needed, which is found at steel only.
DISAGREE = 10.0
# Twice the strongest field of the Earth, in microtesla.
STRONG = 130.0
FEW = 0.01  # of the readings; single spikes are no reason to doubt a survey


def survey_doubts(readings: TrainingSet) -> tuple[str, ...]:
    """Return what speaks against readings, a sentence each.

    Parameters
    ----------
    readings
        As they were taken, in the map frame.
    """
    return tuple(each for each in (disagreement(readings), strong(readings.field)) if each)


def narrow(points: FloatArray) -> str:
    """Return a sentence if all readings of a map lie on one line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    if len(spread) > 1 and spread[1] > NARROW:
        return ""
    return (
        "the survey lies on one line: what the field does beside it is known from physics alone; "
        "drive more than one lane"
    )


def disagreement(readings: TrainingSet) -> str:
    """Return a sentence if readings of one place differ by more than a field can."""
    cubes = np.floor(readings.points / SAME_PLACE).astype(np.int64)
    _, cube = np.unique(cubes, axis=0, return_inverse=True)
    high = np.full((cube.max() + 1, 3), -np.inf)
    low = -high
    np.maximum.at(high, cube, readings.field)
    np.minimum.at(low, cube, readings.field)
    differ = (high - low).max(axis=1)
    count = int(np.count_nonzero(differ > DISAGREE))
    if not count:
        return ""
    worst = int(np.argmax(differ))
    x, y, z = readings.points[cube == worst][0]
    return (
        f"readings of one place differ at {count} of {len(differ)} places, by {differ[worst]:.0f} "
        f"uT at ({x:.1f}, {y:.1f}, {z:.1f}) m: check the suite's calibration, clocks and poses"
    )


def strong(field: FloatArray) -> str:
    """Return a sentence if the field is stronger than that of the Earth and a building can be."""
    strength = np.linalg.norm(field, axis=1)
    share = float(np.mean(strength > STRONG))
    if share <= FEW:
        return ""
    return (
        f"{share:.0%} of the readings exceed {STRONG:g} uT, the strongest is {strength.max():.0f}: "
        "twice the Earth's field; check the unit, the suite's calibration, and for magnets"
    )
