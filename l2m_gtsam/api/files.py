"""Files in and out, as the commands read and write them."""

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from l2m_gtsam.api.arguments import WHOLE_MAP, check, options_of, path_of, paths_of
from l2m_gtsam.batch.files import SavedMap, read_drive_and_numbers
from l2m_gtsam.batch.maps import write_map
from l2m_gtsam.config import Config, with_poses
from l2m_gtsam.data import KnownSensor, Recording
from l2m_gtsam.maps.field_map import FieldMap, frame_of
from l2m_gtsam.progress import silent
from l2m_gtsam.recording.joining import joined
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.known_sensors import read_known_sensors
from l2m_gtsam.storage.listed_sensors import read_sensors

Paths = str | Path | Sequence[str | Path]


def read_bag(
    logs: Paths,
    *,
    poses: Paths = (),
    pose_times: str | Path | None = None,
    options: BagOptions | Mapping[str, Any] | None = None,
) -> Recording:
    """Return a drive, or several of one vehicle as one.

    Parameters
    ----------
    logs
        ROS1 .bag, ROS2 folder, .db3, .mcap, .csv or .ulg; one or several.
    poses
        File with the poses of each log, where they are not in it: TUM, KITTI or .csv.
    pose_times
        Times of KITTI's poses.
    options
        What is read, as under `bag` in a configuration.

    Raises
    ------
    L2MError
        Whatever is wrong with a file, in one line.
    """
    drives = paths_of("logs", logs)
    config = Config(bag=options_of(BagOptions, options, "bag"))
    times = None if pose_times is None else path_of("pose_times", pose_times)
    files = [] if isinstance(poses, Sequence) and not poses else paths_of("poses", poses)
    config = with_poses(config, drives, files, times)
    return joined([read_drive_and_numbers(log, config, silent) for log in drives])


def read_calibration(path: str | Path) -> CalibrationResult:
    """Return the calibration in a `calibration.yaml`, or of sensors that are listed.

    Raises
    ------
    CalibrationError
        The file is neither of both.
    """
    return read_sensors(path_of("path", path))


def read_suite(path: str | Path) -> dict[str, KnownSensor]:
    """Return the sensors of a `suite.yaml` by name; a CalibrationError if it is none."""
    return read_known_sensors(path_of("path", path))


def load_map(path: str | Path) -> FieldMap:
    """Return the map in a file; a MapError if it is none."""
    return SavedMap.read(path_of("path", path)).open(silent)


def save_map(
    path: str | Path,
    field_map: FieldMap,
    *,
    frame: str | None = None,
    source: str | Path | None = None,
) -> None:
    """Write a map to a file (`.npz`) that the commands read.

    Parameters
    ----------
    path
        File to write.
    field_map
        The map.
    frame
        Name of the frame that it is in; that of its survey's poses if absent.
    source
        File that the map was loaded from: what that says of bags, dates and suite, and the LiDAR's
        cloud, is written, too.

    Raises
    ------
    InputError
        It is no map.
    MapError
        The source is none.
    OutputError
        The file cannot be written.
    """
    file = path_of("path", path)
    check(WHOLE_MAP, field_map=field_map)
    named = {"frame": frame or frame_of(field_map) or "map"}
    if source is None:
        write_map(file, field_map, {"version": version("l2m-gtsam"), **named}, None)
        return
    before = SavedMap.read(path_of("source", source)).state
    own = field_map.to_state().provenance
    write_map(file, field_map, {**before.provenance, **own, **named}, before.lidar)
