"""A verdict with its reasons: on a calibration, a localisation or a validation."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from pydantic import AliasChoices, Field

from l2m_gtsam.records.metrics import Record


class Level(StrEnum):
    """Outcome of a verdict, from good to bad."""

    PASS = "pass"  # noqa: S105 - a verdict
    WARN = "warn"
    FAIL = "fail"

    @property
    def rank(self) -> int:
        """0 for the best."""
        return list(Level).index(self)


def worst(levels: Iterable[Level]) -> Level:
    """Return the worst of some levels; PASS if there are none."""
    return max(levels, key=lambda each: each.rank, default=Level.PASS)


@dataclass(frozen=True)
class Reason(Record):
    """A plain sentence and the level that it justifies; PASS is a note."""

    level: Level
    text: str


# `validation.json` has always called them remarks.
Reasons = Annotated[
    tuple[Reason, ...],
    Field(validation_alias=AliasChoices("remarks", "reasons"), serialization_alias="remarks"),
]


@dataclass(frozen=True)
class SensorVerdict(Record):
    """The verdict on one sensor, and its reasons, the worst first."""

    sensor: str
    level: Level
    reasons: Reasons

    @classmethod
    def of(cls, sensor: str, reasons: Iterable[Reason]) -> "SensorVerdict":
        """Return the verdict that reasons in any order lead to."""
        ordered = _worst_first(reasons)
        return cls(sensor, worst(each.level for each in ordered), ordered)


@dataclass(frozen=True)
class Verdict(Record):
    """The verdict on a whole.

    Attributes
    ----------
    level
        The worst of the reasons and of all sensors.
    reasons
        What concerns all sensors, the worst first.
    sensors
        One verdict each.
    """

    level: Level
    reasons: Reasons
    sensors: tuple[SensorVerdict, ...]

    @classmethod
    def of(
        cls,
        reasons: Iterable[Reason],
        sensors: Sequence[SensorVerdict],
        worst_of_sensors: Level = Level.FAIL,
    ) -> "Verdict":
        """Return the verdict on a whole.

        Parameters
        ----------
        reasons
            What concerns all sensors, in any order.
        sensors
            Verdicts on them.
        worst_of_sensors
            What a sensor counts as in the whole, at worst.
        """
        ordered = _worst_first(reasons)
        own = worst(each.level for each in sensors)
        counted = min(own, worst_of_sensors, key=lambda each: each.rank)
        level = worst([counted, *(each.level for each in ordered)])
        return cls(level, ordered, tuple(sensors))

    def __getitem__(self, sensor: str) -> SensorVerdict:
        return next(each for each in self.sensors if each.sensor == sensor)

    def count(self, level: Level) -> int:
        """Return the number of sensors with this verdict."""
        return sum(each.level == level for each in self.sensors)

    def lines(self, least: Level = Level.WARN) -> list[str]:
        """Return the whole with its reasons, then sensors and their reasons of at least a level."""
        lines = [f"verdict: {self.level.upper()}"]
        lines += [f"  {each.level.upper()}: {each.text}" for each in self.reasons]
        for sensor in self.sensors:
            if sensor.level.rank >= least.rank:
                texts = [each.text for each in sensor.reasons if each.level.rank >= least.rank]
                head = f"  {sensor.level.upper()} {sensor.sensor}"
                lines.append(": ".join([head, *([" ".join(texts)] if texts else [])]))
        return lines


@dataclass(frozen=True)
class Threshold(Record):
    """Where a verdict changes: name under `qa`, warning, failure, and the option's description."""

    name: str
    warn: float
    fail: float
    text: str


def _worst_first(reasons: Iterable[Reason]) -> tuple[Reason, ...]:
    return tuple(sorted(reasons, key=lambda each: -each.level.rank))
