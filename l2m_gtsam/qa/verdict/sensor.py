"""Rules on one sensor: how its solve ended, how its readings fit, how exact its calibration is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, SaturatedAxis
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.reasons import failure, warning
from l2m_gtsam.qa.verdict.uncertainty import moves
from l2m_gtsam.recording.saturation import saturation_sentence
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    SensorCalibration,
    SensorStatus,
    Uncertainty,
)
from l2m_gtsam.records.metrics import Measures, SensorMetrics
from l2m_gtsam.records.verdict import Level, Reason
from l2m_gtsam.solve.noise import is_chance
from l2m_gtsam.text import by_sigma, sigma_alone, significant

OPEN_HEAD = "Not everything can be known"
HEADS = {
    SensorStatus.NO_READINGS: "There is nothing to calibrate on",
    SensorStatus.OUTSIDE_MAP: "The map does not cover the drive",
    SensorStatus.DEAD_AXIS: "An axis is dead",
    SensorStatus.AMBIGUOUS: "Its place is not certain",
    SensorStatus.CONTRADICTED: "What is known contradicts the readings",
    SensorStatus.FLIPPED_AXIS: "An axis is reversed",
}
WORSE = 1.5  # of what a uniform field leaves of the readings: the map contradicts them
WRONG_MAP = (
    "The map does not fit this drive: a field that is the same everywhere explains the readings as "
    "well. Is it the map of this place, and are the poses in its frame? (Or the field here is too "
    "uniform, beside the sensors' noise, to test the map.)"
)


OF_MOTION = "The likely cause: its H follows how the vehicle moves."
OF_OTHERS = (
    "Errors of poses that the bag does not state, a map frame that is warped, an offset H that "
    "drifts or a mapping suite that is not calibrated do that."
)


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
    all: Measures
    options: QaOptions

    @property
    def others(self) -> tuple[SensorMetrics, ...]:
        """Figures of the other solved sensors."""
        return tuple(each for each in self.all.sensors if each.sensor != self.sensor.sensor)


def saturation(case: Case) -> list[Reason]:
    """Return that readings are beyond the range of the sensor."""
    return beyond_range(case.sensor.sync.limits, case.options)


def beyond_range(limits: Sequence[SaturatedAxis], options: QaOptions) -> list[Reason]:
    """Return that readings are beyond limits of a sensor's range, if there are any."""
    if not limits:
        return []
    share = max(each.share for each in limits)
    return options.saturated.reasons(share, f"{saturation_sentence(limits)}.")


def unconverged(case: Case) -> list[Reason]:
    """Return that the solve did not converge, if it did not."""
    sensor = case.sensor
    if sensor.status is not SensorStatus.NOT_CONVERGED:
        return []
    head = OPEN_HEAD if sensor.undetermined else "The solve did not converge"
    return failure(_sentence(head, sensor.message))


def ending(case: Case) -> list[Reason]:
    """Return how the solve ended, where it did not end well; not if it did not converge."""
    sensor = case.sensor
    if sensor.status in (SensorStatus.SOLVED, SensorStatus.NOT_CONVERGED):
        return []
    if sensor.status is SensorStatus.UNDETERMINED:
        # Without a place or a rotation a sensor is useless; without an offset it is not.
        known = np.isfinite(np.diag(sensor.covariance)[:3]).all()
        turned = np.isfinite(np.diag(sensor.rotation_covariance)).all()
        level = Level.WARN if known and turned else Level.FAIL
        return [Reason(level, _sentence(OPEN_HEAD, sensor.message))]
    if sensor.status is SensorStatus.FLIPPED_AXIS and (swapped := _swapped_axes(case)):
        return swapped
    if sensor.status is SensorStatus.CONTRADICTED:
        if fits_elsewhere(case.others, case.options):
            return failure(
                f"{sensor.rejected} of its readings fit no calibration that explains the others, "
                "while other sensors fit the map: something about this sensor changed on the drive."
            )
        if sensor.rejected:
            head = "Its readings contradict the map or what is known"
            return failure(_sentence(head, sensor.message))
    return failure(_sentence(HEADS[sensor.status], sensor.message))


def fits_elsewhere(others: Sequence[SensorMetrics], options: QaOptions) -> bool:
    """Return whether there are other sensors and the map explains the readings of most."""
    fit = [each.fit.unexplained <= options.unexplained.warn for each in others]
    return sum(fit) > len(fit) / 2


def _sentence(head: str, message: str) -> str:
    return f"{head}: {message}" + ("" if message.endswith((".", "?")) else ".")


def _swapped_axes(case: Case) -> list[Reason]:
    """Return which two axes are swapped, where two are; a single reversed one has its message."""
    found = None if case.metrics is None else case.metrics.mounting.axes
    if found is None or not found.mirrored:
        return []
    moved = [k for k in range(3) if found.along[k][1] != "xyz"[k]]
    if len(moved) != 2 or any(found.along[k][0] == "-" for k in moved):
        return []
    one, two = ("xyz"[k] for k in moved)
    return failure(
        f"Axes {one} and {two} are swapped: {one} reads along the lidar's {found.along[moved[0]]}, "
        f"{two} along its {found.along[moved[1]]}, which no mounting does; exchange them in the "
        f"driver, or with `bag.axes: {{{case.sensor.sensor}: {found.in_order}}}`."
    )


def fit(case: Case) -> list[Reason]:
    """Return what of the readings is not explained, and how many there are."""
    sensor, options = case.sensor, case.options
    reasons = [*_explained(case), *_consistent(case)]
    if inside := sensor.inside:
        share = sensor.rejected / inside
        text = f"{share:.0%} of its readings fit neither map nor distortion and do not count."
        reasons += options.rejected.reasons(share, text)
        reasons += outside_map(sensor.outside_map / (inside + sensor.outside_map), options)
    return reasons


def outside_map(share: float, options: QaOptions) -> list[Reason]:
    """Return that a share of a sensor's readings lies outside the map, if it is large."""
    text = f"{share:.0%} of its readings lie outside the map and do not count."
    return options.outside_map.reasons(share, text)


def misfit(case: Case) -> bool:
    """Whether the map explains nothing: what else is found of the sensor means nothing then."""
    return any(each.level is Level.FAIL for each in _explained(case))


def _explained(case: Case) -> list[Reason]:
    if case.metrics is None:
        return []
    found = case.metrics.fit
    # Where the place is open, the field is too uniform to test the map, unless that is worse. So
    # it is where what the map leaves is noise, from one reading to the next: of a map that is
    # wrong neighbours have much the same left.
    even = not np.isfinite(case.sensor.t_sigma).all() or is_chance(
        case.metrics.autocorrelation.next, case.metrics.fit.readings
    )
    if even and not found.unexplained > WORSE:
        return []
    text = (
        f"The map leaves {significant(found.left, 2)} µT of its readings unexplained, a field that "
        f"is the same everywhere {significant(found.without_map, 2)} µT: "
    )
    if fits_elsewhere(case.others, case.options):
        text += (
            "the map explains those of other sensors. Something about this sensor changed on the "
            "drive, or its readings are those of another device."
        )
    elif found.unexplained > case.options.unexplained.fail:
        text += (
            "the map does not fit this drive. Is it of this place, and are the poses in its frame? "
            "(Or the field here is too uniform to test the map.)"
        )
    else:
        text += "it explains less than a map of this place should."
    return case.options.unexplained.reasons(found.unexplained, text)


def _consistent(case: Case) -> list[Reason]:
    if case.metrics is None or case.sensor.residuals is None:
        return []
    chi2 = case.sensor.residuals.chi2_per_dof
    text = (
        f"Residuals are {chi2**0.5:.1f} times as large as the noise that was assumed: sigmas are "
        "too small."
    )
    return case.options.chi_square.reasons(chi2, text)


def clock(case: Case) -> list[Reason]:
    """Return the time offset, where one was found that is worth mending."""
    offset, limit = case.sensor.time_offset, case.options.time_offset_s
    if offset is None or not offset.estimated or abs(offset.seconds) < 3 * offset.sigma:
        return []
    ms, sigma_ms = 1e3 * offset.seconds, 1e3 * offset.sigma
    text = (
        f"Its clock is off by {by_sigma(ms, sigma_ms)} ± {sigma_alone(sigma_ms)} ms against the "
        "lidar's. That is taken into account here; correct its stamps before its readings are used."
    )
    size = abs(offset.seconds)
    return limit.reasons(size, text) or [Reason(Level.PASS, text)] * (size > limit.warn / 5)


def precision(case: Case) -> list[Reason]:
    """Return sigmas that are too large, and reasons to think that they are too small."""
    sensor, options = case.sensor, case.options
    t, angle = _largest(sensor.t_sigma), _largest(sensor.turn_sigma_deg)
    H = _largest(sensor.H_sigma)
    place = f"Its position is only known to ± {sigma_alone(1e3 * t)} mm (1 sigma)."
    offset = f"Its offset H is only known to ± {sigma_alone(H)} µT."
    rotation = f"Its rotation is only known to ± {sigma_alone(angle)}°."
    return [
        *options.position_sigma_m.reasons(t, place),
        *options.rotation_sigma_deg.reasons(angle, rotation),
        *options.hard_iron_sigma_ut.reasons(H, offset),
        *(_unmodelled(case) or _correlated(case)),
        *(
            Reason(Level.PASS, f"Not from this drive but from what was known beforehand: {each}.")
            for each in sensor.from_priors
        ),
    ]


def _largest(sigmas: FloatArray) -> float:
    """Return the largest finite sigma; undetermined parameters are reported by ``ending``."""
    return float(max(sigmas[np.isfinite(sigmas)], default=0.0))


def _unmodelled(case: Case) -> list[Reason]:
    excess = case.sensor.unmodelled
    times = {"t": excess.t, "C": excess.C, "H": excess.H, "the clock": excess.offset}
    named = [f"of {name} {ratio**0.5:.1f} times" for name, ratio in times.items() if ratio > 1]
    if not named:
        return []
    cause = OF_MOTION if moves(case.result, case.sensor.sensor) else OF_OTHERS
    return warning(
        "Parts of the drive disagree by more than noise, map and poses explain: its sigmas are "
        f"larger by what is unmodelled ({', '.join(named)}). {cause}"
    )


def _correlated(case: Case) -> list[Reason]:
    if case.metrics is None or case.result.uncertainty is Uncertainty.FULL:
        return []
    found = case.metrics.autocorrelation
    if found.next <= case.options.autocorrelation:
        return []
    # N correlated readings carry the information of N_eff independent ones: sigmas that count N
    # are too small by sqrt(N / N_eff).
    times = (case.metrics.fit.readings / found.independent) ** 0.5
    return warning(
        f"Errors of neighbouring readings are correlated ({found.next:.2f}), but its sigmas count "
        f"each by itself: they are too small, by about {times:.1f} times."
    )
