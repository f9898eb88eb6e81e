"""The verdict on a localisation: PASS, WARN or FAIL, with reasons in plain sentences."""

from l2m_gtsam.qa.judge import SensorVerdict, Verdict
from l2m_gtsam.qa.options import Limit, QaOptions
from l2m_gtsam.qa.reasons.reason import Level, Reason, worst
from l2m_gtsam.qa.slam.sensor_reasons import on_sensor
from l2m_gtsam.qa.slam.whole_reasons import on_whole
from l2m_gtsam.records.localisation_file import LocalisationRecord, RefinedSensor, SensorRecord
from l2m_gtsam.records.validation import Threshold

SHARED_LIMITS = ("rejected", "outside_map", "chi_square")


def judge_localisation(record: LocalisationRecord, options: QaOptions) -> Verdict:
    """Return the verdict with its reasons.

    A sensor that fails beside others that serve is a warning for the whole: the poses rest on the
    others.

    Parameters
    ----------
    record
        The localisation.
    options
        Thresholds.
    """
    shared = _ordered(on_whole(record, options.slam))
    refined = {each.sensor: each for each in record.refined}
    sensors = tuple(
        _verdict(each, refined.get(each.use.sensor), options) for each in record.sensors
    )
    return Verdict(_whole(shared, sensors), shared, sensors)


def slam_thresholds(options: QaOptions) -> tuple[Threshold, ...]:
    """Return where the verdict changes."""
    shared = [(name, options, name) for name in SHARED_LIMITS]
    own = [(f"slam.{name}", options.slam, name) for name, _ in options.slam]
    return tuple(
        Threshold(shown, limit.warn, limit.fail, type(model).model_fields[name].description or "")
        for shown, model, name in (*shared, *own)
        if isinstance(limit := getattr(model, name), Limit)
    )


def _whole(shared: tuple[Reason, ...], sensors: tuple[SensorVerdict, ...]) -> Level:
    levels = [each.level for each in sensors]
    if any(each is not Level.FAIL for each in levels):
        levels = [min(each, Level.WARN, key=lambda level: level.rank) for each in levels]
    return max([worst(shared), *levels], key=lambda each: each.rank)


def _ordered(reasons: list[Reason]) -> tuple[Reason, ...]:
    return tuple(sorted(reasons, key=lambda each: -each.level.rank))


def _verdict(
    sensor: SensorRecord, refined: RefinedSensor | None, options: QaOptions
) -> SensorVerdict:
    reasons = _ordered(on_sensor(sensor, refined, options))
    return SensorVerdict(sensor.use.sensor, worst(reasons), reasons)
