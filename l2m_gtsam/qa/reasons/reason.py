"""One reason, how grave it is, and the case that it is about."""

from dataclasses import dataclass
from enum import StrEnum

from l2m_gtsam.qa.options import Limit, QaOptions
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.metrics import Metrics, SensorMetrics


class Level(StrEnum):
    """How a verdict ends, from good to bad."""

    PASS = "pass"  # noqa: S105 - a verdict
    WARN = "warn"
    FAIL = "fail"

    @property
    def rank(self) -> int:
        """0 for the best."""
        return list(Level).index(self)


@dataclass(frozen=True)
class Reason:
    """A plain sentence and what it makes of the verdict; PASS is worth knowing, no more."""

    level: Level
    text: str


@dataclass(frozen=True)
class Case:
    """One sensor to be judged.

    Attributes
    ----------
    sensor
        Its calibration.
    metrics
        Its figures; absent where it was not solved.
    result, all
        The whole calibration and the figures of all sensors.
    options
        Thresholds.
    """

    sensor: SensorCalibration
    metrics: SensorMetrics | None
    result: CalibrationResult
    all: Metrics
    options: QaOptions

    @property
    def others(self) -> tuple[SensorMetrics, ...]:
        """Figures of the other solved sensors."""
        return tuple(each for each in self.all.sensors if each.sensor != self.sensor.sensor)


def level_of(value: float, limit: Limit) -> Level:
    """Return what a figure makes of the verdict; a figure that does not exist passes."""
    if value > limit.fail:
        return Level.FAIL
    return Level.WARN if value > limit.warn else Level.PASS


def worst(reasons: tuple[Reason, ...]) -> Level:
    """Return the gravest level of reasons; PASS if there are none."""
    return max((each.level for each in reasons), key=lambda each: each.rank, default=Level.PASS)


def against(value: float, limit: Limit, text: str) -> list[Reason]:
    """Return a reason if a figure is above its limits."""
    level = level_of(value, limit)
    return [] if level is Level.PASS else [Reason(level, text)]
