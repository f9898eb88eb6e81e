"""What was measured of a sensor beside its limits: the figures that a verdict is made of."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.options import Limit, QaOptions
from l2m_gtsam.qa.verdict.repeatability import furthest
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.metrics import SensorMetrics
from l2m_gtsam.records.verdict import Level


@dataclass(frozen=True)
class Measured:
    """A figure beside its limit.

    Attributes
    ----------
    name, unit
        What it is of, and in which unit all three numbers are.
    value
        As it was measured; infinite where it is not determined.
    warn, fail
        Where the verdict changes.
    """

    name: str
    unit: str
    value: float
    warn: float
    fail: float

    @property
    def level(self) -> Level:
        """What it leads to by itself."""
        return Limit(warn=self.warn, fail=self.fail).level(self.value)


def measured(
    sensor: SensorCalibration, found: SensorMetrics, options: QaOptions
) -> tuple[Measured, ...]:
    """Return the figures of a sensor that was solved, sigmas first.

    Parameters
    ----------
    sensor, found
        Its calibration and its figures.
    options
        Thresholds.
    """
    used = 0 if sensor.residuals is None else sensor.residuals.readings
    inside = used + sensor.rejected
    turned = np.rad2deg(np.sqrt(np.diag(sensor.rotation_covariance)))
    chi2 = np.nan if sensor.residuals is None else sensor.residuals.chi2_per_dof
    every = (
        _in("sigma of t", "mm", _largest(sensor.t_sigma), options.position_sigma_m, 1e3),
        _in("sigma of rotation", "°", _largest(turned), options.rotation_sigma_deg),
        _in("sigma of H", "µT", _largest(sensor.H_sigma), options.hard_iron_sigma_ut),
        _in("unexplained by the map", "", found.fit.unexplained, options.unexplained),
        _in("chi-square", "", chi2, options.chi_square),
        _in("halves apart", "", furthest(found.halves, options), options.halves_apart),
        _in("rejected", "%", _share(sensor.rejected, inside), options.rejected, 100),
        _in(
            "outside the map",
            "%",
            _share(sensor.outside_map, inside + sensor.outside_map),
            options.outside_map,
            100,
        ),
    )
    return tuple(each for each in every if not np.isnan(each.value))


def _in(name: str, unit: str, value: float, limit: Limit, factor: float = 1.0) -> Measured:
    return Measured(name, unit, factor * value, factor * limit.warn, factor * limit.fail)


def _largest(sigmas: FloatArray) -> float:
    return float(sigmas.max())


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
