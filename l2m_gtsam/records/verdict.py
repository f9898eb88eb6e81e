"""A verdict with its reasons: on a calibration, a localisation or a validation."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any

from pydantic import AliasChoices, Field

from l2m_gtsam.records.by_sensor import BySensor
from l2m_gtsam.records.record import Record


class Level(StrEnum):
    """Outcome of a verdict, from good to bad."""

    PASS = "pass"  # noqa: S105 - a verdict
    WARN = "warn"
    FAIL = "fail"

    @property
    def rank(self) -> int:
        """0 for the best."""
        return list(Level).index(self)

    @property
    def of_reason(self) -> str:
        """How a reason of this level begins where people read it: what passes is a note."""
        return "note" if self is Level.PASS else self.upper()


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
class Verdict(Record, BySensor[SensorVerdict]):
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

    @property
    def follows(self) -> bool:
        """Whether the levels are those of all reasons, as of a calibration's verdict."""
        own = worst(each.level for each in self.reasons)
        each_follows = (
            each.level is worst(reason.level for reason in each.reasons) for each in self.sensors
        )
        return self.level is worst([own, *(s.level for s in self.sensors)]) and all(each_follows)

    def count(self, level: Level) -> int:
        """Return the number of sensors with this verdict."""
        return sum(each.level == level for each in self.sensors)

    @property
    def warnings(self) -> "tuple[SaidReason, ...]":
        """All reasons of at least WARN, those of all sensors first."""
        whole = [("", each) for each in self.reasons]
        own = [(of.sensor, each) for of in self.sensors for each in of.reasons]
        return tuple(
            SaidReason(sensor, each.level, each.text)
            for sensor, each in (*whole, *own)
            if each.level is not Level.PASS
        )

    def lines(self, least: Level = Level.WARN) -> list[str]:
        """Return the whole with its reasons, then sensors and their reasons of at least a level."""
        lines = [f"verdict: {self.level.upper()}"]
        lines += [f"  {each.level.of_reason}: {each.text}" for each in self.reasons]
        for sensor in self.sensors:
            if sensor.level.rank >= least.rank:
                texts = [each.text for each in sensor.reasons if each.level.rank >= least.rank]
                head = f"  {sensor.level.upper()} {sensor.sensor}"
                lines.append(": ".join([head, *([" ".join(texts)] if texts else [])]))
        return lines


@dataclass(frozen=True)
class SaidReason(Record):
    """A reason and the sensor that it is of; no name where it is of all."""

    sensor: str
    level: Level
    text: str

    def __str__(self) -> str:
        return f"{self.level.upper()}{f' {self.sensor}' if self.sensor else ''}: {self.text}"


@dataclass(frozen=True)
class EarlierVerdict(Record):
    """What the same numbers were judged before.

    Attributes
    ----------
    level
        The verdict then.
    changed
        Thresholds that were changed after it, "name: old -> new"; empty if none was.
    reasons
        Of at least WARN; empty in files of before.
    """

    level: Level
    changed: tuple[str, ...]
    reasons: tuple[SaidReason, ...] = ()

    def __str__(self) -> str:
        if not self.changed:
            return f"the verdict was {self.level.upper()} before, by the same thresholds"
        changed = ", ".join(self.changed)
        return f"the verdict was {self.level.upper()} before, by other thresholds ({changed})"


@dataclass(frozen=True)
class Judgement(Record):
    """A verdict and the thresholds that it was reached by, which travel together.

    Attributes
    ----------
    thresholds
        The options `qa` that it was judged by, plain values.
    earlier
        What the same numbers were judged before, the oldest first.
    """

    verdict: Verdict
    thresholds: dict[str, Any]
    earlier: tuple[EarlierVerdict, ...] = ()

    @classmethod
    def of(
        cls, verdict: Verdict, thresholds: dict[str, Any], before: "Judgement | None"
    ) -> "Judgement":
        """Return a judgement, the first on its numbers or one after another."""
        return cls(verdict, thresholds) if before is None else before.again(verdict, thresholds)

    def again(self, verdict: Verdict, thresholds: dict[str, Any]) -> "Judgement":
        """Return the judgement on the same numbers by thresholds that may be others."""
        changed = _changed(self.thresholds, thresholds)
        if not changed and verdict.level is self.verdict.level:
            return Judgement(verdict, thresholds, self.earlier)
        before = EarlierVerdict(self.verdict.level, changed, self.verdict.warnings)
        return Judgement(verdict, thresholds, (*self.earlier, before))

    @property
    def level(self) -> Level:
        """Of the verdict."""
        return self.verdict.level

    def gone(self, earlier: EarlierVerdict) -> tuple[SaidReason, ...]:
        """Return the reasons of an earlier verdict that are none now, or of a lower level."""
        now: dict[tuple[str, str], int] = {}
        for each in self.verdict.warnings:
            now[each.sensor, each.text] = each.level.rank
        return tuple(
            each
            for each in earlier.reasons
            if now.get((each.sensor, each.text), -1) < each.level.rank
        )

    def before(self) -> list[str]:
        """Return what was judged before, and which of its reasons are gone, a line each."""
        return [
            line
            for each in self.earlier
            for line in (
                str(each),
                *(f"no longer a reason: {reason}" for reason in self.gone(each)),
            )
        ]

    def lines(self) -> list[str]:
        """Return verdict, reasons from WARN on, what was judged before, and thresholds."""
        thresholds = json.dumps(self.thresholds, ensure_ascii=False)
        earlier = [f"  {each}" for each in self.before()]
        return [*self.verdict.lines(), *earlier, f"judged by qa: {thresholds}"]


NOT_JUDGED = "not judged"


def judged_lines(judgement: Judgement | None) -> list[str]:
    """Return a judgement as lines; one where there is none."""
    return [f"verdict: {NOT_JUDGED}"] if judgement is None else judgement.lines()


def _changed(old: dict[str, Any], new: dict[str, Any]) -> tuple[str, ...]:
    before, after = _flat(old), _flat(new)
    return tuple(
        f"{name}: {_value(before.get(name))} -> {_value(after.get(name))}"
        for name in {**before, **after}
        if before.get(name) != after.get(name)
    )


def _value(value: Any) -> str:
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _flat(options: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested options with dotted names."""
    flat: dict[str, Any] = {}
    for name, value in options.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


@dataclass(frozen=True)
class Threshold(Record):
    """Where a verdict changes: name under `qa`, warning, failure, and the option's description."""

    name: str
    warn: float
    fail: float
    text: str


def _worst_first(reasons: Iterable[Reason]) -> tuple[Reason, ...]:
    return tuple(sorted(reasons, key=lambda each: -each.level.rank))
