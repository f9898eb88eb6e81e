"""What is said of one sensor of a localisation, a plain sentence each."""

from l2m_gtsam.qa.options import QaOptions, SlamQaOptions
from l2m_gtsam.qa.reasons.reason import Level, Reason, against
from l2m_gtsam.records.localisation_file import RefinedSensor, SensorRecord
from l2m_gtsam.solve.chi_square import chance_beyond


def on_sensor(
    sensor: SensorRecord, refined: RefinedSensor | None, options: QaOptions
) -> list[Reason]:
    """Return what concerns one sensor: its readings, and its calibration if that was refined."""
    return [*_counted(sensor, options), *_refined(refined, options.slam)]


def _counted(sensor: SensorRecord, options: QaOptions) -> list[Reason]:
    use = sensor.use
    if not use.used:
        return [Reason(Level.FAIL, f"None of its {use.readings:,} readings counts.")]
    inside = use.readings - use.outside_map
    wrong, lost = use.rejected / inside, use.outside_map / use.readings
    return [
        *against(
            wrong,
            options.rejected,
            f"{wrong:.0%} of its readings inside the map do not fit it where the others say that "
            "the vehicle was, and do not count: the place has changed since it was mapped, "
            "something passed by, or the sensor is no longer as calibrated.",
        ),
        *against(
            lost,
            options.outside_map,
            f"{lost:.0%} of its readings lie outside the map and do not count.",
        ),
        *against(
            use.chi2_per_dof,
            options.chi_square,
            f"Its residuals are {use.chi2_per_dof**0.5:.1f} times as large as noise and map lead "
            "to expect: it is noisier or no longer as calibrated, or the map is less exact than "
            "it states.",
        ),
    ]


def _refined(refined: RefinedSensor | None, options: SlamQaOptions) -> list[Reason]:
    """Return that a calibration was not as sure as it said."""
    if refined is None:
        return []
    change = refined.change
    if chance_beyond(change.value, change.freedom) >= options.chance:
        return []
    text = (
        f"Refining it changed it by more than its standard deviations allow ({change.value:.0f} "
        f"for {change.freedom} parameters, normalised and squared): it has changed since it was "
        "calibrated, or its covariance was too small."
    )
    return [Reason(Level.WARN, text)]
