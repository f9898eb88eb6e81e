"""Two calibrations of one sensor beside each other: what has changed beyond both uncertainties."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import BoolArray, FloatArray, same_content
from l2m_gtsam.geometry import propagated
from l2m_gtsam.qa.metrics.coordinates import COLUMNS, changes_of
from l2m_gtsam.qa.metrics.mounting import PAIRS, gains, sensor_axes, skews_deg
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.recording.drive_trace import same_drive
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.validation import (
    CalibrationChange,
    CalibrationComparison,
    CalibrationPart,
    ChangeTest,
    ComparedSensor,
    MinimumDetectableChange,
    NotValidated,
)
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.solve.chi_square import chance_beyond, noticed_sigmas
from l2m_gtsam.solve.linear_algebra import sound_information_root

MISSED = 0.01  # of changes that are called detectable
INDEPENDENT = (
    "The errors of both calibrations count as independent: the covariance of their difference is "
    "the sum of both."
)
SHARED_MAP = (
    " Both rest on one map. Its errors, where both drives passed, are alike in both and cancel, so "
    "that true sigmas of the difference are smaller than these: what is called a change is one, "
    "but a small change may be missed."
)
SHARED_BAG = (
    " A drive took part in both: their errors are not independent, and no vehicle changes on it."
)


@dataclass(frozen=True)
class CalibrationDifference:
    """A difference of two vectors and its covariance; infinite variances for what is open."""

    value: FloatArray
    covariance: FloatArray

    @property
    def known(self) -> BoolArray:
        """Which entries both determine."""
        finite = np.isfinite(np.diag(self.covariance)) & np.isfinite(self.value)
        return np.asarray(finite)

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations; infinite for what is open."""
        sigma = np.sqrt(np.diag(self.covariance))
        return np.asarray(np.where(self.known, sigma, np.inf))

    def detectable(self, chance: float) -> float:
        """Return the smallest difference that shows, whatever its direction; infinite if none.

        Parameters
        ----------
        chance
            Of the test of all entries.
        """
        if not self.known.all():
            return float("inf")
        sigmas = noticed_sigmas(len(self.value), chance, MISSED)
        return float(sigmas * np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))

    def detectable_by_whole(self, basis: FloatArray, chance: float) -> float:
        """Return the smallest change of a part that the test of all entries shows.

        Parameters
        ----------
        basis
            What a unit of each of its coordinates does to the entries, shape (P, Q), with all that
            is known or open as it is.
        chance
            Of that test.
        """
        known = self.known
        touched = np.abs(basis).max(axis=1) > 0
        if not known[touched].all():
            return float("inf")
        seen = sound_information_root(self.covariance[np.ix_(known, known)]) @ basis[known]
        least = float(np.linalg.eigvalsh(seen.T @ seen)[0])
        sigmas = noticed_sigmas(int(known.sum()), chance, MISSED)
        return sigmas / least**0.5 if least > 0 else float("inf")

    def part(self, at: slice) -> "CalibrationDifference":
        """Return some of its entries."""
        return CalibrationDifference(self.value[at], self.covariance[at, at])

    def tested(self, name: str) -> ChangeTest:
        """Return the chi-square test of all entries that are known."""
        known = self.known
        if not known.any():
            return ChangeTest(name, 0.0, 0, 1.0)
        sigma = self.sigma[known]
        if not sigma.all():
            same = not self.value[known][sigma == 0].any()
            return ChangeTest(name, 0.0, 0, 1.0) if same else ChangeTest(name, np.inf, 1, 0.0)
        # Wald's test; directions that both share exactly carry no information.
        W = sound_information_root(self.covariance[np.ix_(known, known)])
        squared = float(np.sum((W @ self.value[known]) ** 2))
        return ChangeTest(name, squared, len(W), float(chance_beyond(squared, len(W))))


def compare_calibrations(
    new: CalibrationResult, old: CalibrationResult, chance: float
) -> CalibrationComparison:
    """Return what has changed from an old calibration to a new one.

    Parameters
    ----------
    chance
        A change is named where chance alone makes as much in a smaller share of all sensors.
    """
    before = {each.sensor: each for each in old.sensors}
    sensors, missing = [], []
    for sensor in new.sensors:
        reason = _why_not(sensor, before.get(sensor.sensor))
        if reason:
            missing.append(NotValidated(sensor.sensor, reason, faulty=False))
        else:
            sensors.append(compare_sensor(sensor, before[sensor.sensor], chance))
    names = {each.sensor for each in new.sensors}
    missing += [
        NotValidated(each.sensor, "It is in the old calibration only.", faulty=False)
        for each in old.sensors
        if each.sensor not in names
    ]
    same_bag = any(same_content(one, other) for one, other in product(new.drives, old.drives))
    same_bag |= any(same_drive(one, other) for one, other in product(new.traces, old.traces))
    assumption = INDEPENDENT + (SHARED_BAG if same_bag else "")
    if same_content(new.map, old.map) and not same_bag:
        assumption += SHARED_MAP
    both = {"new": new.judgement, "old": old.judgement}
    failed = [name for name, each in both.items() if each is not None and each.level is Level.FAIL]
    return CalibrationComparison(
        tuple(sensors), tuple(missing), assumption, same_bag, tuple(failed)
    )


def _why_not(new: SensorCalibration, old: SensorCalibration | None) -> str:
    if old is None:
        return "It is in the new calibration only."
    for name, each in (("new", new), ("old", old)):
        if not is_calibrated(each):
            return f"The {name} calibration does not know it: {each.message}."
    return ""


def is_calibrated(sensor: SensorCalibration) -> bool:
    """Return whether anything is known of a sensor."""
    values = sensor.vector()
    return bool(np.isfinite(values).all() and np.isfinite(np.diag(sensor.covariance)).any())


def compare_sensor(new: SensorCalibration, old: SensorCalibration, chance: float) -> ComparedSensor:
    """Return what has changed of one sensor."""
    whole = CalibrationDifference(new.vector() - old.vector(), new.covariance + old.covariance)
    parts = differences(new, old, whole)
    least = chance / (len(parts) + 1)  # Bonferroni: all parts and the whole are tested
    tests = {part.value: each.tested(part.value) for part, each in parts.items()}
    tests["C"] = whole.part(slice(3, 12)).tested("C")
    tests["all"] = whole.tested("all")
    # A change of a part by itself shows in its own test, or in that of all.
    basis = changes_of(old.distortion.C)[: len(whole.value)]
    return ComparedSensor(
        sensor=new.sensor,
        difference=row(np.where(whole.known, whole.value, np.nan), 9),
        sigma=row(whole.sigma, 9),
        tests=tuple(tests.values()),
        changes=_changes(parts, tests, least),
        detectable=tuple(
            MinimumDetectableChange(
                part,
                min(
                    each.detectable(least),
                    whole.detectable_by_whole(basis[:, COLUMNS[part]], least),
                ),
            )
            for part, each in parts.items()
        ),
    )


def differences(
    new: SensorCalibration, old: SensorCalibration, whole: CalibrationDifference
) -> dict[CalibrationPart, CalibrationDifference]:
    """Return the differences of a calibration's parts, in the units of ``CalibrationChange``."""
    shapes = [
        np.concatenate([gains(s.distortion.C), skews_deg(s.distortion.C)]) for s in (new, old)
    ]
    spreads = [
        propagated(shape_derivatives(s.distortion.C), s.covariance[3:12, 3:12]) for s in (new, old)
    ]
    shape = CalibrationDifference(shapes[0] - shapes[1], spreads[0] + spreads[1])
    return {
        CalibrationPart.PLACE: whole.part(slice(0, 3)),
        CalibrationPart.ROTATION: rotation_difference(new, old),
        CalibrationPart.GAINS: shape.part(slice(0, 3)),
        CalibrationPart.ANGLES: shape.part(slice(3, 6)),
        CalibrationPart.OFFSET: whole.part(slice(12, 15)),
    }


def rotation_difference(new: SensorCalibration, old: SensorCalibration) -> CalibrationDifference:
    """Return the d by which a sensor has turned about its own axes, in degrees.

    R_lidar_mag = R_lidar_mag_old exp(d). With true R_mag_lidar = exp(error) @ estimate, d is off by
    exp(-d) error_old - error_new to first order, along the axes of the new one.
    """
    turn = old.R_lidar_mag.T @ new.R_lidar_mag
    if not np.isfinite(turn).all():
        return CalibrationDifference(np.full(3, np.nan), np.diag(np.full(3, np.inf)))
    d = Rotation.from_matrix(turn).as_rotvec()
    spread = new.rotation_covariance + propagated(turn.T, old.rotation_covariance)
    degree = np.rad2deg(1.0)
    return CalibrationDifference(degree * d, degree**2 * spread)


def shape_derivatives(C: FloatArray) -> FloatArray:
    """Return derivatives of gains and of angles short of 90 degrees by C row by row, (6, 9)."""
    length, axes = gains(C), sensor_axes(C)
    J = np.zeros((6, 9))
    if not length.all():
        return J  # a dead axis has no direction
    for k in range(3):
        J[k, 3 * k : 3 * k + 3] = axes[k]
    for k, (i, j) in enumerate(PAIRS):
        cosine = float(axes[i] @ axes[j])
        # d asin(c) = dc / sqrt(1 - c^2), and c depends on the direction of each row alone.
        steep = np.rad2deg(1 / np.sqrt(max(1 - cosine**2, 1e-12)))
        J[3 + k, 3 * i : 3 * i + 3] = steep * (axes[j] - cosine * axes[i]) / length[i]
        J[3 + k, 3 * j : 3 * j + 3] = steep * (axes[i] - cosine * axes[j]) / length[j]
    return J


def _changes(
    parts: Mapping[CalibrationPart, CalibrationDifference],
    tests: Mapping[str, ChangeTest],
    chance: float,
) -> tuple[CalibrationChange, ...]:
    """Return the parts that chance does not explain, the surest first."""
    named = [part for part in parts if tests[part.value].chance < chance]
    named.sort(key=lambda part: -tests[part.value].chi_square / max(tests[part.value].freedom, 1))
    return tuple(
        change_of(part, parts[part].value, parts[part].sigma, tests[part.value].chance)
        for part in named
    )


def change_of(
    part: CalibrationPart, value: FloatArray, sigma: FloatArray, chance: float
) -> CalibrationChange:
    """Return a change of a part; entries that are open do not count for its size."""
    known = np.isfinite(sigma) & np.isfinite(value)
    seen = np.abs(value[known])
    longest = part in (CalibrationPart.GAINS, CalibrationPart.ANGLES)
    size = seen.max(initial=0.0) if longest else np.linalg.norm(seen)
    shown = np.where(known, value, np.nan)
    return CalibrationChange(part, row(shown), row(sigma), float(size), chance)
