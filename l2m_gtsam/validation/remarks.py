"""What is said of a validation beside its figures: sensors left out, doubts and notes."""

from collections.abc import Sequence

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import Recording, SourceFile, same_content
from l2m_gtsam.maps.field_map import Summarised
from l2m_gtsam.qa.metrics.changes import is_calibrated
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration, Uncertainty
from l2m_gtsam.records.validation import NotValidated
from l2m_gtsam.validation.innovation import knows_its_errors

SAME_BAG = (
    "This is the drive that the calibration was computed from: it agrees with itself. Take another."
)
SAME_MAP = (
    "This is the map that it was calibrated with: errors of the map that the calibration took over "
    "do not show. A map of another survey would show them."
)
NOT_CORRELATED = (
    "This kind of map does not know how its errors are correlated; each reading's counts as its "
    "own, so that chance is taken to do less than it does."
)
LOWER_BOUNDS = (
    "The calibration's sigmas are lower bounds (`uncertainty: independent`): small changes may be "
    "named that are none."
)


def is_sound(sensor: SensorCalibration) -> bool:
    """Return whether readings can be predicted and corrected with a calibration of a sensor."""
    C = sensor.distortion.C
    return bool(
        is_calibrated(sensor) and sensor.noise > 0 and np.linalg.cond(C) < 1e6
    )  # gains a million apart are no magnetometer's


def missing_sensors(recording: Recording, calibration: CalibrationResult) -> list[NotValidated]:
    """Return sensors of the drive or the calibration that cannot be compared."""
    here, missing = [each.sensor for each in recording.series], []
    known = {each.sensor: each for each in calibration.sensors}
    for name in here:
        if name not in known:
            reason = "It is on the drive, but not in the calibration: nothing is known of it."
            missing.append(NotValidated(name, reason, faulty=False))
        elif not is_sound(known[name]):
            reason = f"The calibration does not know it: {known[name].message}."
            missing.append(NotValidated(name, reason, faulty=True))
    missing += [
        NotValidated(name, "It is in the calibration, but not on the drive.", faulty=False)
        for name in known
        if name not in here
    ]
    return missing


def nothing_shared(
    recording: Recording, calibration: CalibrationResult, missing: Sequence[NotValidated]
) -> str:
    """Return why no sensor can be compared, with what to do about it."""
    faulty = [each for each in missing if each.faulty]
    if faulty:
        return f"nothing to validate: {faulty[0].sensor}: {faulty[0].reason}"
    there = ", ".join(each.sensor for each in calibration.sensors) or "none"
    here = ", ".join(each.sensor for each in recording.series) or "none"
    return (
        f"{recording.source.path}: none of its sensors ({here}) is in the calibration ({there}); "
        "names come from topics or from `bag.fields` in --config"
    )


def remarks(
    recording: Recording,
    field_map: QueryableMap,
    calibration: CalibrationResult,
    map_source: SourceFile | None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what speaks against the outcome, and what is worth knowing."""
    of_map = field_map.summary.doubts if isinstance(field_map, Summarised) else ()
    doubts, notes = [f"Of the map: {each}." for each in of_map], list[str]()
    if any(same_content(drive, recording.source) for drive in calibration.drives):
        doubts.append(SAME_BAG)
    elif same_content(calibration.map, map_source):
        notes.append(SAME_MAP)
    if not knows_its_errors(field_map):
        notes.append(NOT_CORRELATED)
    if calibration.uncertainty is Uncertainty.INDEPENDENT:
        notes.append(LOWER_BOUNDS)
    return tuple(doubts), tuple(notes)
