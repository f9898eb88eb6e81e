"""The verdict on a calibration: PASS, WARN or FAIL, with reasons in plain sentences."""

from dataclasses import dataclass

from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.reasons.ending import ending
from l2m_gtsam.qa.reasons.fit import clock, fit, misfit
from l2m_gtsam.qa.reasons.mounting import mounting
from l2m_gtsam.qa.reasons.precision import precision
from l2m_gtsam.qa.reasons.reason import Case, Level, Reason, worst
from l2m_gtsam.qa.reasons.repeat import repeat
from l2m_gtsam.qa.reasons.whole import own_stretches, whole
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.metrics import Metrics

# In the order in which a person would ask; the gravest stand first in the end.
RULES = (repeat, ending, mounting, fit, own_stretches, clock, precision)
RULES_OF_A_MISFIT = (fit, ending)


@dataclass(frozen=True)
class SensorVerdict:
    """The verdict on one sensor, and its reasons from the gravest to what is worth knowing."""

    sensor: str
    level: Level
    reasons: tuple[Reason, ...]


@dataclass(frozen=True)
class Verdict:
    """The verdict on a calibration.

    Attributes
    ----------
    level
        The worst of map, drive and all sensors.
    reasons
        What concerns all sensors.
    sensors
        One verdict each, in the order of the calibration.
    """

    level: Level
    reasons: tuple[Reason, ...]
    sensors: tuple[SensorVerdict, ...]

    def __getitem__(self, sensor: str) -> SensorVerdict:
        return next(each for each in self.sensors if each.sensor == sensor)

    def count(self, level: Level) -> int:
        """Return the number of sensors with this verdict."""
        return sum(each.level == level for each in self.sensors)


def judge(result: CalibrationResult, metrics: Metrics, options: QaOptions) -> Verdict:
    """Return the verdict on a calibration.

    Parameters
    ----------
    result
        The calibration.
    metrics
        Its figures.
    options
        Thresholds.
    """
    cases = tuple(
        Case(sensor, metrics.get(sensor.sensor), result, metrics, options)
        for sensor in result.sensors
    )
    sensors = tuple(_on_sensor(case) for case in cases)
    shared = _ordered(whole(cases, result))
    level = max([worst(shared), *(each.level for each in sensors)], key=lambda each: each.rank)
    return Verdict(level, shared, sensors)


def _on_sensor(case: Case) -> SensorVerdict:
    rules = RULES_OF_A_MISFIT if misfit(case) else RULES
    reasons = _ordered([reason for rule in rules for reason in rule(case)])
    return SensorVerdict(case.sensor.sensor, worst(reasons), reasons)


def _ordered(reasons: list[Reason]) -> tuple[Reason, ...]:
    return tuple(sorted(reasons, key=lambda each: -each.level.rank))
