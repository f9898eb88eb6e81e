"""What is said of a displacement that all sensors share, and of those that need not have shown."""

import numpy as np

from l2m_gtsam.qa.metrics.changes import change_of
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.changed_parts import amount, limits_of, size_and_parts
from l2m_gtsam.qa.verdict.reasons import warning
from l2m_gtsam.records.validation import (
    CalibrationChange,
    CalibrationPart,
    Displaced,
    Displacement,
    DriveValidation,
)
from l2m_gtsam.records.verdict import Level, Reason, worst


def displaced(drive: DriveValidation, options: QaOptions) -> list[Reason]:
    """Return the displacement that all sensors share, and what it is likely of."""
    found = drive.displacement
    if found is None:
        return _blind_to_shifts(drive, options)
    level, count = _displaced_level(found, options), len(drive.sensors)
    if Displaced.LIDAR not in found.of:
        what = f"all {count} sensors read" if count > 1 else "is read"
        text = (
            f"What {what} fits if the poses are {_moved_by(found, 'map')}: their frame is not that "
            "of the map. Take poses on the map's point cloud. The sensors were tested with poses "
            "that were moved so."
        )
        return [Reason(min(level, Level.WARN, key=lambda each: each.rank), text)]
    tied = ", or the poses are in another frame than the map's" if len(found.of) > 1 else ""
    text = (
        f"All {count} sensors together {_moved_by(found, 'lidar')}: the mount of the lidar, or of "
        f"what carries them all, gave way or was changed{tied}. What is said of single sensors is "
        "beside it."
    )
    return [Reason(level, text)]


def _blind_to_shifts(drive: DriveValidation, options: QaOptions) -> list[Reason]:
    """Return which shifts of all sensors together, as large as fails, need not have shown."""
    limit = options.validation.place_m.fail
    what = {Displaced.LIDAR: "of all sensors together", Displaced.FRAME: "of the poses' frame"}
    hidden = " and ".join(
        f"{what[each.of]} (it shows {amount(CalibrationPart.PLACE, each.size)} and more)"
        if np.isfinite(each.size)
        else f"{what[each.of]} (it shows none)"
        for each in drive.detectable_shifts
        if each.size > limit
    )
    if not hidden:
        return []
    text = f"This drive cannot rule out a shift by {amount(CalibrationPart.PLACE, limit)} {hidden}."
    return warning(text)


def moved_with_all(drive: DriveValidation, options: QaOptions) -> list[Reason]:
    """Return of one sensor that it moved as all did."""
    found = drive.displacement
    if found is None or Displaced.LIDAR not in found.of:
        return []
    text = "It moved with all others (see above): its t and its rotation are not what they were."
    return [Reason(_displaced_level(found, options), text)]


def _displaced_level(found: Displacement, options: QaOptions) -> Level:
    limits = limits_of(options.validation)
    return worst(limits[each.part].level(each.size) for each in _displacements(found))


def _displacements(found: Displacement) -> list[CalibrationChange]:
    """Return the parts of a displacement that there are."""
    each = (
        (CalibrationPart.PLACE, found.shift, found.shift_sigma),
        (CalibrationPart.ROTATION, found.turn, found.turn_sigma),
    )
    return [change_of(part, np.array(v), np.array(s), 0.0) for part, v, s in each if any(s)]


def _moved_by(found: Displacement, axes: str) -> str:
    """Return a displacement along the axes of a frame as a phrase."""
    verbs = {CalibrationPart.PLACE: "moved", CalibrationPart.ROTATION: "turned"}
    relations = {CalibrationPart.PLACE: "along", CalibrationPart.ROTATION: "about"}
    return " and ".join(
        f"{verbs[each.part]} by {size_and_parts(each)} {relations[each.part]} the {axes}'s x, y, z"
        for each in _displacements(found)
    )
