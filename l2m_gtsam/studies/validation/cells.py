"""What a validation says of one drive, beside what is true."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.validation import judge_validation
from l2m_gtsam.records.validation import CalibrationPart, DriveValidation
from l2m_gtsam.studies.validation.drives import CalibratedHall, ChangedDrive, changed_drive
from l2m_gtsam.studies.validation.options import TrueCause, ValidationStudyOptions
from l2m_gtsam.validation.places import TIE
from l2m_gtsam.validation.validate import validate

NEAR_M = 0.3  # of the steel that was brought: so near it has to be found
# What has to be named of every sensor that changed, and nothing of the others.
PARTS = {
    TrueCause.TURNED: CalibrationPart.ROTATION,
    TrueCause.IRON: CalibrationPart.OFFSET,
    TrueCause.BOTH: CalibrationPart.OFFSET,
    TrueCause.SENSOR: CalibrationPart.ROTATION,
}


@dataclass(frozen=True)
class ValidationCell:
    """What is said of a drive.

    Attributes
    ----------
    change
        What is true.
    hall
        Seed of its hall.
    level
        Verdict.
    right
        Whether what changed is named, and nothing else.
    tied
        Whether two explanations are named of which one cannot be told from the other.
    parts
        Of each sensor, that are said to have changed.
    away_m
        From the steel that was brought to the nearest source; None without either.
    sources
        How many are named.
    words
        What is said of place and vehicle, empty for nothing.
    """

    change: TrueCause
    hall: int
    level: str
    right: bool
    tied: bool
    parts: tuple[tuple[str, ...], ...]
    away_m: float | None
    sources: int
    words: str


def cell_of(
    options: ValidationStudyOptions, place: CalibratedHall, change: TrueCause, number: int
) -> ValidationCell:
    """Validate the calibration of a hall's vehicle on one drive."""
    drive = changed_drive(options, place, change, number)
    chosen, qa = CalibrationOptions(), QaOptions()
    found = validate(
        drive.recording, place.field_map, place.calibration, chosen, qa.validation.chance
    )
    told = [each for each in (*found.doubts, *found.notes) if " changed" in each]
    tied = any(each.startswith(TIE) for each in told)
    return ValidationCell(
        change=change,
        hall=place.seed,
        level=judge_validation(found, None, qa).level.value,
        right=is_right(change, drive, found) and not tied,
        tied=tied,
        parts=tuple(tuple(each.part.value for each in s.changes) for s in found.sensors),
        away_m=away(drive, found),
        sources=len(found.sources),
        words=told[0] if told else "",
    )


def is_right(change: TrueCause, drive: ChangedDrive, found: DriveValidation) -> bool:
    """Return whether what changed is named, where it is, and nothing else.

    A mount that is turned moves its sensors, too, which may be named or too little to be.
    """
    off = away(drive, found)
    if (off is not None and off > NEAR_M) or (off is None) != (drive.steel is None):
        return False
    if drive.steel is None and found.sources:
        return False
    parts = [{each.part for each in sensor.changes} for sensor in found.sensors]
    if change in (TrueCause.NOTHING, TrueCause.PLACE):
        return not any(parts)
    wanted = {PARTS[change]}
    also = {CalibrationPart.PLACE} if change is TrueCause.TURNED else set[CalibrationPart]()
    if change is TrueCause.SENSOR:
        return not any(parts[:-1]) and parts[-1] == wanted
    return all(wanted <= each <= wanted | also for each in parts)


def away(drive: ChangedDrive, found: DriveValidation) -> float | None:
    """Return how far the nearest source is from the steel, metres; None without either."""
    if drive.steel is None or not found.sources:
        return None
    return float(min(np.linalg.norm(each.position - drive.steel) for each in found.sources))
