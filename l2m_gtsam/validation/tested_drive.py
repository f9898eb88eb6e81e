"""A drive on which all sensors were tested, and what the tests found."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import compress

import numpy as np

from l2m_gtsam.data import BoolArray, Readings
from l2m_gtsam.progress import Progress, silent
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.validation import CalibrationPart, NotValidated, ValidatedSensor
from l2m_gtsam.validation.drive_test import DriveTest, tested
from l2m_gtsam.validation.innovation import estimate_of, together
from l2m_gtsam.validation.places import AveragedBesideMap, is_searched


@dataclass(frozen=True)
class TestedDrive:
    """A drive on which all sensors were tested.

    Attributes
    ----------
    test
        What they were tested on.
    known
        Their calibrations.
    found
        What was found of each.
    """

    test: DriveTest
    known: tuple[SensorCalibration, ...]
    found: tuple[ValidatedSensor | NotValidated, ...]

    @classmethod
    def of(
        cls, test: DriveTest, known: Sequence[SensorCalibration], progress: Progress = silent
    ) -> "TestedDrive":
        """Test all sensors."""
        found = []
        for index, sensor in enumerate(known):
            progress("validating", index / len(known))
            found.append(tested(test, sensor))
        return cls(test, tuple(known), tuple(found))

    def beside(self, test: DriveTest) -> "TestedDrive":
        """Return the same sensors tested beside something else."""
        return TestedDrive.of(test, self.known)

    @property
    def sensors(self) -> list[ValidatedSensor]:
        """What was found of sensors that could be tested."""
        return [each for each in self.found if isinstance(each, ValidatedSensor)]

    @property
    def untested(self) -> list[NotValidated]:
        """Sensors that could not be."""
        return [each for each in self.found if isinstance(each, NotValidated)]

    @property
    def is_tested(self) -> list[bool]:
        """Whether each sensor could be."""
        return [isinstance(each, ValidatedSensor) for each in self.found]

    @property
    def calibrations(self) -> list[SensorCalibration]:
        """Calibrations of sensors that could be tested."""
        return list(compress(self.known, self.is_tested))

    @property
    def parts(self) -> list[tuple[CalibrationPart, ...]]:
        """Parts of each sensor that have changed."""
        return [parts_of(each) for each in self.found]

    @property
    def changed(self) -> bool:
        """Whether any has."""
        return any(self.parts)

    @cached_property
    def averages(self) -> AveragedBesideMap | None:
        """The averaged drive if places are suspected on it, or sensors changed."""
        if not self.sensors:
            return None
        estimate = estimate_of([self.test.known(each) for each in self.calibrations])
        given = self.test.field_map, estimate, self.test.options.changes
        averages = AveragedBesideMap.of(self._readings, *given)
        return averages if len(averages.places) or self.changed else None

    @property
    def _readings(self) -> Readings:
        """Readings of sensors inside the map.

        Where steel is not looked for, without those that it may explain: it would look like jumps.
        """
        at_stamps, counts = zip(*self._counted(), strict=True)
        return together(at_stamps).select(np.concatenate(counts))

    def _counted(self) -> Iterator[tuple[Readings, BoolArray]]:
        """Yield the readings of each sensor that could be tested, and which of them count."""
        searched = is_searched(self.test.field_map, self.test.options.changes)
        for each in self.calibrations:
            drive = self.test.drive_of(each)
            yield drive.timed, drive.inside() if searched else drive.usable()


def parts_of(found: ValidatedSensor | NotValidated) -> tuple[CalibrationPart, ...]:
    """Return the parts of a sensor that have changed."""
    return tuple(e.part for e in found.changes) if isinstance(found, ValidatedSensor) else ()
