"""What undoes the distortion of each sensor's readings, out of a calibration."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from l2m_gtsam.config import load_config
from l2m_gtsam.data import CorrectedField, FloatArray, IntArray, ScalarSeries
from l2m_gtsam.errors import CalibrationError, ConfigError
from l2m_gtsam.options import Options
from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.recording.regressors import ResampleOptions, resampled
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.solve.correction import corrected, moving_variance, without_moving
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.calibrated_topics import Correct
from l2m_gtsam.storage.exports.export import not_correctable
from l2m_gtsam.storage.regressors import read_scalars

Part = TypeVar("Part", bound=Options)


@dataclass(frozen=True)
class Reading:
    """How readings, and numbers that they follow, get out of a bag."""

    bag: BagOptions
    resampling: ResampleOptions

    @classmethod
    def from_config(cls, path: Path) -> "Reading":
        """Return what a configuration says."""
        config = load_config(path)
        return cls(config.bag, config.calibration.regressors)

    @classmethod
    def of(cls, result: CalibrationResult, path: Path) -> "Reading":
        """Return how the drive of a calibration was read.

        Parameters
        ----------
        result
            The calibration.
        path
            Its file, for messages.

        Raises
        ------
        CalibrationError
            It does not say it in a way that is understood.
        """
        return cls(
            saved_options(path, result.options, BagOptions, "bag"),
            saved_options(path, result.options, ResampleOptions, "calibration", "regressors"),
        )


def saved_options(path: Path, options: Any, model: type[Part], *names: str) -> Part:
    """Return the options under some names of those that a calibration was made with."""
    for name in names:
        options = options.get(name, {}) if isinstance(options, dict) else options
    try:
        return model.model_validate(options)
    except ValidationError as error:
        fault = error.errors()[0]
        key = ".".join(str(part) for part in ("options", *names, *fault["loc"]))
        raise CalibrationError(f"{path}: {key}: {fault['msg']}") from error


def not_applicable(sensor: SensorCalibration) -> str | None:
    """Return why the readings of a sensor cannot be corrected."""
    if (reason := not_correctable(sensor)) is not None:
        return reason
    unknown = [m.name for m in sensor.moving if not np.isfinite([m.h, m.sigma]).all()]
    return f"what follows {unknown[0]} is not determined" if unknown else None


def corrections_of(
    bag: Path, sensors: Sequence[SensorCalibration], reading: Reading, progress: Progress
) -> dict[str, Correct]:
    """Return what corrects sensors of a bag, by their names.

    Parameters
    ----------
    bag
        The bag; numbers that readings follow are read out of it.
    sensors
        Sensors whose readings can be corrected.
    reading
        How the bag is read.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    ConfigError
        A number that readings follow is not named.
    BagError
        It is not in the bag.
    """
    names = sorted({moving.name for sensor in sensors for moving in sensor.moving})
    if missing := [name for name in names if name not in reading.bag.regressors]:
        raise ConfigError(
            f"a part of the readings follows {missing[0]!r}, which `bag.regressors` does not name; "
            "say in --config where it is recorded"
        )
    topics = {name: reading.bag.regressors[name] for name in names}
    told = counter(f"reading numbers of {bag.name}", progress)
    scalars = read_scalars(bag, topics, reading.bag.stamps, told)
    series = {each.name: each for each in scalars}
    return {
        sensor.sensor: _correction(sensor, [series[m.name] for m in sensor.moving], reading)
        for sensor in sensors
    }


def _correction(
    sensor: SensorCalibration, numbers: Sequence[ScalarSeries], reading: Reading
) -> Correct:
    """Return what takes a sensor's moving fields out of its readings, and then C and H."""
    covariance = np.array(sensor.covariance[3:, 3:])
    h = np.array([moving.h for moving in sensor.moving]).reshape(-1, 3)
    h_sigma = np.array([moving.sigma for moving in sensor.moving]).reshape(-1, 3)

    def correct(readings: FloatArray, stamp_ns: IntArray) -> CorrectedField:
        at = resampled(numbers, stamp_ns, reading.resampling)
        still = without_moving(readings, at.values, h)
        still[~at.known] = np.nan
        variance = sensor.noise**2 + moving_variance(at.values, h_sigma)
        return corrected(still, sensor.distortion, covariance, variance)

    return correct
