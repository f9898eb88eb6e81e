"""The validation study: ``l2m study validation``."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.sensor import WRONG_MAP
from l2m_gtsam.qa.verdict.validation import judge_validation
from l2m_gtsam.records.validation import CalibrationPart, Displaced, DriveValidation
from l2m_gtsam.records.verdict import Level, Verdict
from l2m_gtsam.studies.study import Study
from l2m_gtsam.studies.validation.drives import (
    CalibratedHall,
    ChangedDrive,
    TrueCause,
    ValidationStudyOptions,
    calibrated_hall,
    changed_drive,
)
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
    verdict = judge_validation(found, None, qa)
    told = [each for each in (*found.doubts, *found.notes) if " changed" in each]
    tied = any(each.startswith(TIE) for each in told)
    return ValidationCell(
        change=change,
        hall=place.seed,
        level=verdict.level.value,
        right=is_right(change, drive, found, verdict) and not tied,
        tied=tied,
        parts=tuple(tuple(each.part.value for each in s.changes) for s in found.sensors),
        away_m=away(drive, found),
        sources=len(found.sources),
        words=told[0] if told else "",
    )


def is_right(
    change: TrueCause, drive: ChangedDrive, found: DriveValidation, verdict: Verdict
) -> bool:
    """Return whether what changed is named, where it is, and nothing else.

    A mount that is turned is one displacement of all sensors; or each of them is named, which it
    moves, too, by as much as may be named or too little to be. Of a map of another place it is said
    that it does not fit, and nothing of steel.
    """
    if change is TrueCause.ELSEWHERE:
        misfits = any(each.text.startswith(WRONG_MAP) for each in verdict.reasons)
        return misfits and not found.sources
    off = away(drive, found)
    if (off is not None and off > NEAR_M) or (off is None) != (drive.steel is None):
        return False
    if drive.steel is None and found.sources:
        return False
    parts = [{each.part for each in sensor.changes} for sensor in found.sensors]
    if found.jumps or found.drifts:
        return False
    if found.displacement is not None:
        of_mount = change is TrueCause.TURNED and Displaced.LIDAR in found.displacement.of
        return of_mount and not any(parts)
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


CASE, UNCHANGED = "case", "unchanged"


@dataclass(frozen=True)
class ChangeRow:
    """What is said of all drives after one change.

    Attributes
    ----------
    change
        What is true.
    drives, right, tied, failed
        How many there are, of how many what changed is named and nothing else, of how many two
        explanations are named, and how many are judged FAIL.
    away_m
        Largest distance from the steel to the source that is named; None without.
    """

    change: TrueCause
    drives: int
    right: int
    tied: int
    failed: int
    away_m: float | None


@dataclass(frozen=True)
class ValidationSummary:
    """The cases change by change, the drives of unchanged ones, and every one that is wrong."""

    options: ValidationStudyOptions
    cases: tuple[ChangeRow, ...]
    unchanged: ChangeRow
    wrong: tuple[ValidationCell, ...]

    @property
    def drives(self) -> int:
        """Number of cases."""
        return sum(row.drives for row in self.cases)

    @property
    def right(self) -> int:
        """Cases of which what is true is said."""
        return sum(row.right for row in self.cases)


class ValidationStudy(Study[ValidationStudyOptions, ValidationCell, ValidationSummary]):
    """Place or vehicle; a cell is one drive."""

    name = "validation"
    title = "Whether the place changed or the vehicle"
    size = frozenset({"halls"})

    def keys(self, options: ValidationStudyOptions) -> tuple[str, ...]:
        """Return the drives, hall by hall: cases first."""
        kinds = [CASE] * options.cases + [UNCHANGED] * options.unchanged
        return tuple(
            f"hall-{hall:03d}-{kind}-{number:02d}"
            for hall in range(options.halls)
            for number, kind in enumerate(kinds, start=1)
        )

    def site(self, options: ValidationStudyOptions, key: str) -> str:
        """Return the number of the hall."""
        return key.split("-")[1]

    def prepare(self, options: ValidationStudyOptions, site: str) -> CalibratedHall:
        """Return a hall with its calibrated vehicle."""
        return calibrated_hall(options, int(site))

    def compute(
        self, options: ValidationStudyOptions, key: str, shared: CalibratedHall
    ) -> ValidationCell:
        """Validate on one drive."""
        return cell_of(options, shared, change_of(options, key), int(key.split("-")[3]))

    def summarise(
        self, options: ValidationStudyOptions, cells: Mapping[str, ValidationCell]
    ) -> ValidationSummary:
        """Count what is right."""
        cases = [cell for key, cell in cells.items() if key.split("-")[2] == CASE]
        rest = [cell for key, cell in cells.items() if key.split("-")[2] == UNCHANGED]
        rows = [row_of(each, [cell for cell in cases if cell.change is each]) for each in TrueCause]
        return ValidationSummary(
            options,
            tuple(row for row in rows if row.drives),
            row_of(TrueCause.NOTHING, rest),
            tuple(cell for cell in (*cases, *rest) if not cell.right),
        )

    def page_context(self, summary: ValidationSummary) -> dict[str, Any]:
        """Return what the text compares with."""
        return {"near": NEAR_M}

    def figures(self, summary: ValidationSummary) -> dict[str, Figure]:
        """Draw how many of each change are right."""
        figure = Figure(figsize=(6.5, 2.8), layout="constrained", dpi=150)
        axes, rows = figure.subplots(), (*summary.cases, summary.unchanged)
        names = [row.change.value for row in summary.cases] + ["unchanged drives"]
        at = np.arange(len(rows))[::-1]
        share = [100 * row.right / max(row.drives, 1) for row in rows]
        axes.barh(at, share, 0.6, color="#009e73")
        axes.set_yticks(at, names)
        axes.set_xlabel("what changed is named, and nothing else (%)")
        axes.set_xlim(0, 100)
        return {"validation": figure}


def change_of(options: ValidationStudyOptions, key: str) -> TrueCause:
    """Return what changes on a drive: all changes take turns over the cases of all halls."""
    _, hall, kind, number = key.split("-")
    if kind == UNCHANGED:
        return TrueCause.NOTHING
    every = list(TrueCause)
    return every[(int(hall) * options.cases + int(number) - 1) % len(every)]


def row_of(change: TrueCause, cells: list[ValidationCell]) -> ChangeRow:
    """Return what is said of the drives after one change."""
    away = [cell.away_m for cell in cells if cell.away_m is not None]
    return ChangeRow(
        change,
        len(cells),
        sum(cell.right for cell in cells),
        sum(cell.tied for cell in cells),
        sum(cell.level == Level.FAIL.value for cell in cells),
        max(away, default=None),
    )


VALIDATION = ValidationStudy()
