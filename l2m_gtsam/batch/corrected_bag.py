"""A bag with the readings of its magnetometers corrected by a calibration."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from l2m_gtsam.batch.corrections import Reading, corrections_of, not_applicable
from l2m_gtsam.errors import BagError
from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.records.calibration import CalibrationResult
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
from l2m_gtsam.storage.exports.export import check_lidar_frame, usable_sensors
from l2m_gtsam.storage.open_bag import Bag, open_bag


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
    if wanted.config is None:
        reading = Reading.of(result, wanted.calibration)
    else:
        reading = Reading.from_config(wanted.config)
    usable = usable_sensors(result, not_applicable)
    check_lidar_frame(wanted.lidar_frame)
    with open_bag(wanted.bag) as bag:
        check_copy(bag, wanted.out)
        name = wanted.bag.name
        found = sensor_topics(bag, reading.bag, counter(f"reading {name}", progress))
        names = {each.sensor for each in found.values()}
        here = [sensor for sensor in usable.sensors if sensor.sensor in names]
        corrections = corrections_of(wanted.bag, here, reading, progress)
        topics = _calibrated_topics(bag, found, corrections, reading.bag)
        left_out = frozenset(topic for topic, _ in topics) if wanted.replace else frozenset()
        calibrator = Calibrator(bag, topics, reading.bag, wanted.lidar_frame, left_out)
        with bag_copy(bag, wanted.out) as copy:
            calibrator.copy(copy, counter(f"copying {name}", progress))
    added = {found[key].sensor: new.topic for key, new in topics.items()}
    return Applied(added, (*usable.notes, *_unmatched(result, found)))


def _calibrated_topics(
    bag: Bag,
    found: Mapping[Key, SensorTopic],
    corrections: Mapping[str, Correct],
    options: BagOptions,
) -> dict[Key, CalibratedTopic]:
    """Return what is added for each sensor of the bag that is calibrated."""
    keys = [key for key in found if found[key].sensor in corrections]
    if not keys:
        there = ", ".join(sorted(each.sensor for each in found.values()))
        raise BagError(
            f"{bag.path}: the calibration can correct none of its sensors "
            f"({there or 'no readings'})"
        )
    taken = {connection.topic for connection in bag.connections}
    for key in keys:
        if found[key].topic in taken:
            raise BagError(f"{bag.path}: has a topic {found[key].topic} already")
        check_units(bag, key, found[key], options)
    return {key: CalibratedTopic(found[key].topic, corrections[found[key].sensor]) for key in keys}


def _unmatched(result: CalibrationResult, found: Mapping[Key, SensorTopic]) -> tuple[str, ...]:
    """Return which sensors stand in the calibration alone or in the bag alone, a sentence each."""
    calibrated = [sensor.sensor for sensor in result.sensors]
    there = [each.sensor for each in found.values()]
    return (
        *(f"{name} is not in the bag" for name in calibrated if name not in there),
        *(f"{name} is not in the calibration" for name in sorted(there) if name not in calibrated),
    )
