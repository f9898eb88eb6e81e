"""Judge whether a field strength is in the unit that it is said to be in.

Anywhere on Earth, also near steel, a field is 10 to 200 uT strong. Drivers publish gauss,
microtesla or bare directions under the name of tesla; the strength tells.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from l2m_gtsam.data import FloatArray

PLAUSIBLE_UT = (10.0, 200.0)
EARTH_UT = 50.0
# A strength that is constant to this, relative, over many readings was normalised.
CONSTANT = 1e-6
ENOUGH_READINGS = 20
# Readings that differ by less, relative, are a sensor that stands still, whatever its rounding.
TURNED = 1e-3


class Unit(StrEnum):
    """Unit of the readings in a bag."""

    AUTO = "auto"
    TESLA = "tesla"
    MILLITESLA = "millitesla"
    MICROTESLA = "microtesla"
    NANOTESLA = "nanotesla"
    GAUSS = "gauss"
    MILLIGAUSS = "milligauss"


MICROTESLA_PER = {
    Unit.AUTO: 1e6,  # what ROS prescribes; the strength is judged
    Unit.TESLA: 1e6,
    Unit.MILLITESLA: 1e3,
    Unit.MICROTESLA: 1.0,
    Unit.NANOTESLA: 1e-3,
    Unit.GAUSS: 100.0,
    Unit.MILLIGAUSS: 0.1,
}
# In order of how often drivers publish them; 1 mG is 0.1 uT, so that some strengths fit two.
SUSPECTS = (Unit.GAUSS, Unit.MICROTESLA, Unit.NANOTESLA, Unit.MILLIGAUSS, Unit.MILLITESLA)


@dataclass(frozen=True)
class Strength:
    """Smallest, median and largest |B| of a sensor in uT as read; NaN without a finite reading."""

    low: float
    median: float
    high: float
    readings: int


def strength(field: FloatArray) -> Strength:
    """Summarise |B| of readings in uT, shape (N, 3); readings with a NaN axis do not count."""
    norm = np.linalg.norm(field[np.isfinite(field).all(axis=1)], axis=1)
    if not len(norm):
        return Strength(float("nan"), float("nan"), float("nan"), 0)
    return Strength(float(norm.min()), float(np.median(norm)), float(norm.max()), len(norm))


def is_turning(field: FloatArray) -> bool:
    """Return whether readings, shape (N, 3), turn: a stuck sensor is not a direction."""
    finite = field[np.isfinite(field).all(axis=1)]
    if not len(finite):
        return False
    return bool(np.ptp(finite, axis=0).max() > TURNED * np.abs(finite).max())


def fault(found: Strength, turning: bool, unit: Unit) -> str | None:
    """Return what is wrong with a strength, as half a sentence; None where nothing is.

    Parameters
    ----------
    found
        Strength in uT after conversion from ``unit``.
    turning
        Whether the direction of the readings changes.
    unit
        The unit that was assumed; only `AUTO` is judged by strength.
    """
    constant = found.high - found.low <= CONSTANT * found.median
    if not found.readings or (constant and not turning):
        return None  # dead or stuck, not in a wrong unit: the calibration says so of it alone
    if constant and found.readings >= ENOUGH_READINGS:
        return (
            f"every reading is {found.median * 1e-6:.4g} long, as read in tesla: directions "
            "without a strength (no unit at all), which cannot be calibrated; record the raw field"
        )
    if unit is not Unit.AUTO or PLAUSIBLE_UT[0] <= found.median <= PLAUSIBLE_UT[1]:
        return None
    low, high = PLAUSIBLE_UT
    return (
        f"a typical |B| of {found.median:.4g} uT, as read in tesla, is not the {low:g} to "
        f"{high:g} uT found on Earth; {_suspicion(found.median * 1e-6)}"
    )


def _suspicion(as_written: float) -> str:
    """Return the likely unit of a strength as it stands in the message."""
    fitting = [
        unit
        for unit in SUSPECTS
        if PLAUSIBLE_UT[0] <= as_written * MICROTESLA_PER[unit] <= PLAUSIBLE_UT[1]
    ]
    if not fitting:
        return f"{as_written:.4g} fits no unit of field; name it with the option `units:`"
    likely = min(fitting, key=lambda unit: _distance(as_written * MICROTESLA_PER[unit]))
    return f"it is likely {likely.value}: set the option `units: {likely.value}`"


def _distance(field_ut: float) -> float:
    return float(abs(np.log(field_ut / EARTH_UT)))
