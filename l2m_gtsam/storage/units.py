"""Units of readings, named or as a number, and whether numbers fit them.

Anywhere on Earth, also near steel, a field is 10 to 200 uT strong. Drivers publish gauss,
microtesla, raw counts or bare directions under the name of tesla; the strength reveals it. Other
numbers no pose and no reading has: those of a damaged message, or in another unit.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from l2m_gtsam.data import FloatArray

PLAUSIBLE_UT = (10.0, 200.0)
EARTH_UT = 50.0
UNDISTURBED_UT = (20.0, 80.0)  # away from steel
OPTION = "bag.units"  # that names the unit of a log
NORMALISED = (0.7, 1.4)  # lengths of directions before a calibration
# A strength that is constant to this, relative, over many readings was normalised.
CONSTANT = 1e-6
ENOUGH_READINGS = 20
# Readings that differ by less, relative, are a sensor at rest, whatever its rounding.
TURNED = 1e-3
# Drivers round quaternions, in single precision or to a few digits; none is off by more than this.
QUATERNION_LENGTH = (0.5, 2.0)
# Further than any place of the Earth from another one: the unit is wrong, or the number is.
MOST_METRES = 1e8


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

Units = Unit | float
"""A named unit, or microtesla per count."""


def microtesla_per(units: Units, own: Unit | None) -> float:
    """Return the factor that makes microtesla of readings as they are written.

    Parameters
    ----------
    units
        What the options say.
    own
        Unit that the type of the message prescribes, if it does.
    """
    if not isinstance(units, Unit):
        return float(units)
    return MICROTESLA_PER[own or units] if units is Unit.AUTO else MICROTESLA_PER[units]


@dataclass(frozen=True)
class Strength:
    """Smallest, median and largest |B| of a sensor in uT as read; NaN without a finite reading."""

    low: float
    median: float
    high: float
    readings: int

    @property
    def is_constant(self) -> bool:
        """Whether all readings are equally strong."""
        return self.high - self.low <= CONSTANT * self.median


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


def are_counts(written: FloatArray) -> bool:
    """Return whether readings as they are written, shape (N, 3), are whole numbers."""
    finite = written[np.isfinite(written).all(axis=1)]
    return len(finite) >= ENOUGH_READINGS and bool((finite == np.round(finite)).all())


def field_fault(
    written: FloatArray, units: Units, own: Unit | None, option: str = OPTION
) -> str | None:
    """Return what is wrong with readings as they are written, as half a sentence, or None.

    Parameters
    ----------
    written
        Readings as they are in the messages, shape (N, 3).
    units, own
        As in ``microtesla_per``; only `AUTO` is judged by strength.
    option
        What names the unit, for advice.
    """
    found, turning = strength(written), is_turning(written)
    if not found.readings or (found.is_constant and not turning):
        return None  # dead or stuck, not in a wrong unit: the calibration says so of it alone
    if found.is_constant and found.readings >= ENOUGH_READINGS:
        return (
            f"every reading is {found.median:.4g} long, as written: directions without a "
            "strength (no unit at all), which cannot be calibrated; record the raw field"
        )
    return strength_fault(written, units, own, option)


def strength_fault(
    written: FloatArray, units: Units, own: Unit | None, option: str = OPTION
) -> str | None:
    """Return what is wrong with the strength of readings alone; see ``field_fault``.

    Readings that are all the same are judged, too; not those of a dead sensor, which are zeros.
    """
    found, (low, high) = strength(written), PLAUSIBLE_UT
    if units is not Unit.AUTO or not found.high > 0:
        return None
    if own is not None and low <= found.median * MICROTESLA_PER[own] <= high:
        return None
    if are_counts(written):
        return (
            f"every reading is a whole number, a typical |B| {found.median:.4g}: raw counts; find "
            "the microtesla per count in the sensor's data sheet and set them as a number, as "
            f"`{option}: 0.15`, or name the unit if it was rounded"
        )
    if own is None:
        return (
            f"a typical |B| of {found.median:.4g} is in a unit that the log does not state; "
            f"{_suspicion(found.median, option)}"
        )
    return (
        f"a typical |B| of {found.median * MICROTESLA_PER[own]:.4g} uT, as read in {own.value}, is "
        f"not the {low:g} to {high:g} uT found on Earth; {_suspicion(found.median, option)}"
    )


def likely_units(written: FloatArray, units: Units, own: Unit | None) -> Units | None:
    """Return what readings as they are written are likely in, where that is not what they say.

    Of raw counts a number of one digit's worth: it makes the field of the Earth of a typical one.
    """
    found = strength(written)
    if found.is_constant or field_fault(written, units, own) is None:
        return None
    typical = found.median
    if are_counts(written) and typical > 0:
        return EARTH_UT / typical
    return next(iter(_suspects(typical)), None)


def _suspects(as_written: float) -> list[Unit]:
    """Return the units that a strength as written may be in, the most likely first."""
    low, high = PLAUSIBLE_UT
    fitting = [u for u in (*SUSPECTS, Unit.TESLA) if low <= as_written * MICROTESLA_PER[u] <= high]
    return sorted(fitting, key=lambda u: _distance(as_written * MICROTESLA_PER[u]))


def _suspicion(as_written: float, option: str) -> str:
    """Return the likely unit of a strength as written in the message."""
    suspects = _suspects(as_written)
    if not suspects:
        return (
            f"{as_written:.4g} fits no unit of field; name it with `{option}`, or give the "
            "microtesla per unit as a number"
        )
    likely = suspects[0]
    fields = {each: as_written * MICROTESLA_PER[each] for each in suspects}
    low, high = UNDISTURBED_UT
    if low <= fields[likely] <= high:
        return f"it is likely {likely.value}: set `{option}: {likely.value}`"
    may_be = [f"{unit.value} ({field:.3g} uT)" for unit, field in fields.items()]
    if NORMALISED[0] <= as_written <= NORMALISED[1]:
        may_be.append("a direction without a strength, which cannot be calibrated")
    return f"it may be {' or '.join(may_be)}: set `{option}`, as `{option}: {likely.value}`"


def _distance(field_ut: float) -> float:
    return float(abs(np.log(field_ut / EARTH_UT)))


def odd_orientation(quaternion: FloatArray) -> str:
    """Return what is wrong with quaternions, shape (N, 4); nothing if all are rotations."""
    if np.any(~quaternion.any(axis=1)):
        return "an orientation is all zero, it must be a unit quaternion"
    # Of large numbers the squares are infinite: the largest component bounds the length, too.
    largest = np.abs(quaternion).max(axis=1)
    sound = (largest > QUATERNION_LENGTH[0] / 2) & (largest <= QUATERNION_LENGTH[1])
    length = np.linalg.norm(quaternion[sound], axis=1)
    inside = (length >= QUATERNION_LENGTH[0]) & (length <= QUATERNION_LENGTH[1])
    if sound.all() and inside.all():
        return ""
    worst = quaternion[~sound][0] if not sound.all() else quaternion[sound][~inside][0]
    return (
        f"an orientation is ({', '.join(f'{each:.3g}' for each in worst)}), it must be a unit "
        "quaternion"
    )


def odd_position(p: FloatArray) -> str:
    """Return what is wrong with positions in metres, shape (N, 3); nothing if all can be."""
    furthest = float(np.abs(p).max(initial=0.0))
    if furthest <= MOST_METRES:
        return ""
    return f"a position has a coordinate of {furthest:.3g} m, at most {MOST_METRES:g} m can be"


def odd_poses(p: FloatArray, quaternion: FloatArray) -> str:
    """Return what is wrong with poses, shapes (N, 3) and (N, 4); nothing if all can be."""
    return odd_orientation(quaternion) or odd_position(p)


# No sensor reads as much in any unit, counts included; squares of what is left are finite.
MOST_WRITTEN = 1e18


def readable(written: FloatArray) -> FloatArray:
    """Return readings as written with NaN in place of numbers that no sensor reads, (N, 3)."""
    return np.where(np.abs(written) <= MOST_WRITTEN, written, np.nan)
