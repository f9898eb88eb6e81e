"""Whether the place changed or the vehicle: the same readings under both, by likelihood.

Steel is looked for with the sensors free, so that nothing that happened to them is taken for steel.
Then the readings are asked for each explanation, with what it needs and no more: sources, parts of
sensors that a test named without sources, parts that it names beside them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive, with_calibration
from l2m_gtsam.calibration.averages import averaged
from l2m_gtsam.calibration.budget.found import NOTHING_FOUND
from l2m_gtsam.calibration.changed_places import ChangesOptions, is_place_of, suspected
from l2m_gtsam.calibration.coverage import NothingShared, UncertainMap
from l2m_gtsam.calibration.drive_sources import DriveSources, changed_sources, drive_sources
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.offset_courses import Course, FoundCourses, courses_of
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.maps.sources.found_sources import FoundSources, price, refined
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.qa.metrics.coordinates import COLUMNS, PARAMETERS, changes_of, columns_of, width
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.validation import EXPECTED_TIMES
from l2m_gtsam.records.places import CLEAR, ChangedSource, WhatChanged
from l2m_gtsam.records.validation import (
    CalibrationPart,
    NotValidated,
    ValidatedSensor,
)

TIE = "The readings do not show which"
Parts = tuple[CalibrationPart, ...]
# Standard deviations of a part that changed, in its own units: anything.
ANYTHING = {
    CalibrationPart.PLACE: 1.0,
    CalibrationPart.ROTATION: 60.0,
    CalibrationPart.GAINS: 1.0,
    CalibrationPart.ANGLES: 60.0,
    CalibrationPart.OFFSET: 100.0,
    CalibrationPart.CLOCK: 1.0,
}


@dataclass(frozen=True)
class PlaceOrVehicle:
    """What explains readings that neither map nor calibration explain.

    Attributes
    ----------
    explanations
        The best first.
    found, sources
        What changed at the place, if it did.
    """

    explanations: tuple[WhatChanged, ...]
    found: FoundSources
    sources: tuple[ChangedSource, ...]

    @property
    def best(self) -> WhatChanged:
        """The explanation with the largest gain."""
        return self.explanations[0]

    @property
    def tied(self) -> bool:
        """Whether another explains the readings about as well."""
        gains = [each.gain for each in self.explanations]
        return len(gains) > 1 and gains[0] - gains[1] < CLEAR

    @property
    def sentence(self) -> str:
        """What the readings say; a tie is called one."""
        figures = ", ".join(f"{each.words}: {each.gain:.0f}" for each in self.explanations)
        head = capitalised(self.best.words)
        if self.tied:
            others = self.explanations[1].words
            head = f"{TIE}: {self.best.words}, or {others}"
        return f"{head}, by the likelihood of the same readings ({figures})."


@dataclass(frozen=True)
class ShownSources:
    """Sources that a drive shows whatever happened to its sensors.

    Attributes
    ----------
    rows, drive
        Averaged readings, the sensors free.
    """

    rows: MarginalRows
    drive: AveragedDrive
    found: FoundSources

    def judged(
        self, covariances: FloatArray, alone: Sequence[Parts], beside: Sequence[Parts]
    ) -> PlaceOrVehicle:
        """Return whether these sources, the vehicle or both explain the readings.

        Parameters
        ----------
        covariances
            The calibration's, of t, C by row, H and time offset, finite, (S, 16, 16).
        alone, beside
            Parts of each sensor that have changed if the place did not, and if it did.
        """
        held = with_calibration(self.rows, covariances)
        before = held.pull(held.residual)[1]
        steel = price(held, self.found.parameters)
        at_place = refined(held, self.found.shapes)
        fits = [at_place]
        explained = [
            WhatChanged("the place changed, not the vehicle", before - at_place.left - steel, True)
        ]
        if any(alone):
            fits.append(refined(self.opened(covariances, alone), ()))
            gain = before - fits[-1].left - self.cost(alone)
            explained.append(WhatChanged(f"{self.who(alone)} changed, not the place", gain, False))
        if any(beside):
            fits.append(refined(self.opened(covariances, beside), self.found.shapes))
            gain = before - fits[-1].left - steel - self.cost(beside)
            explained.append(
                WhatChanged(f"both the place and {self.who(beside)} changed", gain, True)
            )
        order = sorted(range(len(fits)), key=lambda k: -explained[k].gain)
        found = fits[order[0]]
        found = replace(found, gains=self.found.gains) if len(found) else found
        sources = changed_sources(self.rows, self.drive, found)
        return PlaceOrVehicle(tuple(explained[k] for k in order), found, sources)

    def opened(self, covariances: FloatArray, parts: Sequence[Parts]) -> MarginalRows:
        """Return the readings with parts of each sensor free, the others as calibrated."""
        C = self.drive.estimate.C()
        each = zip(covariances, C, parts, strict=True)
        return with_calibration(self.rows, np.array([P + spread(c, own) for P, c, own in each]))

    def cost(self, parts: Sequence[Parts]) -> float:
        """Return what parts of the sensors have to explain."""
        return price(self.rows, sum(width(part) for each in parts for part in each))

    def who(self, parts: Sequence[Parts]) -> str:
        """Return what of the vehicle changed."""
        return who_changed(self.drive.view.readings.sensors, parts)


def who_changed(sensors: Sequence[str], parts: Sequence[Parts]) -> str:
    """Return what of a vehicle changed: one sensor of several, or more."""
    names = [name for name, each in zip(sensors, parts, strict=True) if each]
    return f"sensor {names[0]} alone" if len(names) == 1 < len(parts) else "the vehicle"


def capitalised(words: str) -> str:
    """Return words that begin a sentence."""
    return f"{words[0].upper()}{words[1:]}"


@dataclass(frozen=True)
class AveragedBesideMap:
    """A drive, averaged, beside what map and calibrations predict.

    Attributes
    ----------
    drive
        Averaged readings.
    places
        Where they differ from the map by more than that may err, metres, shape (M, 3).
    field_map, options
        The map, and how sources are looked for.
    """

    drive: AveragedDrive
    places: FloatArray
    field_map: QueryableMap
    options: ChangesOptions

    @classmethod
    def of(
        cls,
        readings: Readings,
        field_map: QueryableMap,
        estimate: Estimate,
        options: ChangesOptions,
    ) -> "AveragedBesideMap":
        """Average a drive.

        Parameters
        ----------
        readings
            Of S sensors, inside the map, at their calibrated time offsets.
        estimate
            The calibration.
        options
            How to look for sources.
        """
        every = np.ones(len(readings), dtype=np.bool_)
        nearest = options.sources.nearest
        averages = averaged(readings, field_map, estimate, every, options.averaging, nearest)
        drive = AveragedDrive.of(averages, field_map, estimate)
        return cls(drive, suspected(drive, field_map, options.averaging), field_map, options)

    @cached_property
    def rows(self) -> MarginalRows:
        """The averaged readings, the sensors free."""
        errors = self.field_map if isinstance(self.field_map, UncertainMap) else NothingShared()
        return self.drive.marginal(self.field_map, errors, NOTHING_FOUND, self.options.averaging)

    @cached_property
    def sources(self) -> DriveSources | None:
        """The sources that it shows; none where steel is not looked for, or no place suspected."""
        if not (len(self.places) and is_searched(self.field_map, self.options)):
            return None
        return drive_sources(
            self.rows, self.drive, self.places, self.field_map, self.options.sources
        )

    @property
    def shown(self) -> ShownSources | None:
        """What changed at the place by them; none where nothing stands out."""
        if self.sources is None:
            return None
        found = self.sources.of_changes()
        return ShownSources(self.sources.rows, self.drive, found) if len(found) else None

    @property
    def courses(self) -> tuple[Course, ...]:
        """Jumps and drifts of H that explain all, or more than sources, or what these leave."""
        return self.found_courses.records(self.drive.view.readings)

    @cached_property
    def found_courses(self) -> FoundCourses:
        """The same as they were found."""
        found = courses_of(self.rows, self.drive)
        if found.each and self.is_suspected_beside(found) and self.sources is not None:
            shown = self.sources
            if shown.gain > found.gain:
                left = self.rows.residual - shown.found.field(self.rows.points)
                found = courses_of(replace(shown.rows, residual=left), self.drive)
        return found

    def is_suspected_beside(self, found: FoundCourses) -> bool:
        """Return whether places are suspected beside jumps and drifts."""
        averages = self.drive.averages
        left = replace(averages, residual=averages.residual - found.field)
        beside = replace(self.drive, averages=left)
        return bool(len(suspected(beside, self.field_map, self.options.averaging)))


def is_elsewhere(
    found: Sequence[ValidatedSensor | NotValidated],
    beside: Sequence[ValidatedSensor | NotValidated],
) -> bool:
    """Return whether the map is of another place, or in another frame.

    It then explains the readings of no sensor, and what is found besides makes up for that in no
    sensor either: these are patches.

    Parameters
    ----------
    found, beside
        Sensors tested in the map, and beside what was found.
    """
    unlike = QaOptions().unexplained.fail
    pairs = [
        (one, other)
        for one, other in zip(found, beside, strict=True)
        if isinstance(one, ValidatedSensor) and isinstance(other, ValidatedSensor)
    ]
    return bool(pairs) and all(
        one.unexplained > unlike and other.refitted > EXPECTED_TIMES * other.expected
        for one, other in pairs
    )


def is_searched(field_map: QueryableMap, options: ChangesOptions) -> bool:
    """Return whether steel is looked for: what a map misses that is wrong everywhere is none."""
    return (
        bool(options.sources.most)
        and isinstance(field_map, UncertainMap)
        and is_place_of(field_map)
    )


def spread(C: FloatArray, parts: Parts) -> FloatArray:
    """Return the covariance of a change of parts by anything, shape (16, 16)."""
    sigma = np.zeros(PARAMETERS)
    for part in parts:
        sigma[COLUMNS[part]] = ANYTHING[part]
    at = columns_of(parts)
    root = changes_of(C)[:, at] * sigma[at]
    return np.asarray(root @ root.T)
