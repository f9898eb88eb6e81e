"""A bag with the readings of its magnetometers corrected by a calibration."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from l2m_gtsam.config import load_config
from l2m_gtsam.data import CorrectedField, FloatArray
from l2m_gtsam.errors import BagError, CalibrationError
from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.results import CalibrationResult, SensorCalibration
from l2m_gtsam.solve.correction import corrected
from l2m_gtsam.storage.bag_copy import bag_copy, check_copy
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.calibrated_topics import (
    CalibratedTopic,
    Calibrator,
    Correct,
    Key,
    SensorTopic,
    check_units,
    sensor_topics,
)
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.exports.export import (
    UsableSensors,
    check_lidar_frame,
    not_correctable,
    usable_sensors,
)
from l2m_gtsam.storage.open_bag import Bag, open_bag
from l2m_gtsam.storage.units import MICROTESLA_PER


@dataclass(frozen=True)
class Application:
    """What is asked for.

    Attributes
    ----------
    bag
        Bag with the readings.
    calibration
        A `calibration.yaml`.
    out
        Bag to write, of the same kind.
    config
        Configuration whose `bag` says how readings are read; that of the calibration if absent.
    lidar_frame
        Name of the frame that the corrected readings are in.
    replace
        Whether the topics that are corrected are left out.
    """

    bag: Path
    calibration: Path
    out: Path
    config: Path | None = None
    lidar_frame: str = "lidar"
    replace: bool = False


@dataclass(frozen=True)
class Applied:
    """What was done.

    Attributes
    ----------
    topics
        Topics of the corrected readings by the names of the sensors.
    notes
        What is worth a warning, a sentence each.
    """

    topics: Mapping[str, str]
    notes: tuple[str, ...]


def apply_calibration(wanted: Application, progress: Progress) -> Applied:
    """Write a copy of a bag with corrected readings, along the axes of the lidar.

    Parameters
    ----------
    wanted
        What to write, and from what.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line; nothing is written then.
    """
    result = read_calibration(wanted.calibration)
    options = _bag_options(wanted, result)
    usable = usable_sensors(result, _not_applicable)
    check_lidar_frame(wanted.lidar_frame)
    with open_bag(wanted.bag) as bag:
        check_copy(bag, wanted.out)
        name = wanted.bag.name
        found = sensor_topics(bag, options, counter(f"reading {name}", progress))
        topics = _calibrated_topics(bag, found, usable, options)
        left_out = frozenset(topic for topic, _ in topics) if wanted.replace else frozenset()
        unit = MICROTESLA_PER[options.units]
        calibrator = Calibrator(bag, topics, unit, wanted.lidar_frame, left_out)
        with bag_copy(bag, wanted.out) as copy:
            calibrator.copy(copy, counter(f"copying {name}", progress))
    names = {found[key].sensor: new.topic for key, new in topics.items()}
    return Applied(names, (*usable.notes, *_unmatched(result, found)))


def _not_applicable(sensor: SensorCalibration) -> str | None:
    """Return why the readings of a sensor cannot be corrected by C and H alone."""
    if (reason := not_correctable(sensor)) is not None or not sensor.moving:
        return reason
    numbers = ", ".join(moving.name for moving in sensor.moving)
    return f"a part of its readings follows recorded numbers ({numbers}), which is not undone here"


def _bag_options(wanted: Application, result: CalibrationResult) -> BagOptions:
    """Return how readings are read: as for the calibration, unless a configuration says how."""
    if wanted.config is not None:
        return load_config(wanted.config).bag
    try:
        return BagOptions.model_validate(result.options.get("bag", {}))
    except ValidationError as error:
        fault = error.errors()[0]
        key = ".".join(str(part) for part in ("options", "bag", *fault["loc"]))
        raise CalibrationError(f"{wanted.calibration}: {key}: {fault['msg']}") from error


def _calibrated_topics(
    bag: Bag, found: Mapping[Key, SensorTopic], usable: UsableSensors, options: BagOptions
) -> dict[Key, CalibratedTopic]:
    """Return what is added for each sensor of the bag that is calibrated."""
    calibrated = {sensor.sensor: sensor for sensor in usable.sensors}
    keys = [key for key in found if found[key].sensor in calibrated]
    if not keys:
        there = ", ".join(sorted(each.sensor for each in found.values()))
        raise BagError(
            f"{bag.path}: none of its sensors ({there or 'no readings'}) is one that the "
            f"calibration can correct ({', '.join(calibrated)})"
        )
    taken = {connection.topic for connection in bag.connections}
    for key in keys:
        if found[key].topic in taken:
            raise BagError(f"{bag.path}: has a topic {found[key].topic} already")
        check_units(bag, key, found[key], options)
    return {
        key: CalibratedTopic(found[key].topic, _correction(calibrated[found[key].sensor]))
        for key in keys
    }


def _correction(sensor: SensorCalibration) -> Correct:
    covariance = np.array(sensor.covariance[3:, 3:])

    def correct(readings: FloatArray) -> CorrectedField:
        return corrected(readings, sensor.distortion, covariance, sensor.noise)

    return correct


def _unmatched(result: CalibrationResult, found: Mapping[Key, SensorTopic]) -> tuple[str, ...]:
    """Return which sensors stand in the calibration alone or in the bag alone, a sentence each."""
    calibrated = [sensor.sensor for sensor in result.sensors]
    there = [each.sensor for each in found.values()]
    return (
        *(f"{name} is not in the bag" for name in calibrated if name not in there),
        *(f"{name} is not in the calibration" for name in sorted(there) if name not in calibrated),
    )
