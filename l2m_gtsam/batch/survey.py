"""Mapping bags: what a map is made of, and the calibration of the mapping suite itself."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from l2m_gtsam.batch.files import check_bags, check_outputs, read_drive, used_file
from l2m_gtsam.batch.scan_poses import read_drive_or_follow
from l2m_gtsam.batch.software import versions
from l2m_gtsam.config import Config
from l2m_gtsam.data import FloatArray, IntArray, KnownSensor, LidarMap, Recording, Trajectory
from l2m_gtsam.errors import CalibrationError, MapError
from l2m_gtsam.lidar.surface import smoothed
from l2m_gtsam.mapping.suite_calibration import calibrate_suite
from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.records.calibration import CalibrationResult, SensorStatus
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.calibration_file import write_calibration
from l2m_gtsam.storage.cloud import read_cloud, thinned_cloud
from l2m_gtsam.storage.cloud_topic import CloudTopicOptions, TopicCloud, read_cloud_topic
from l2m_gtsam.storage.files import ensure_folder, source_file
from l2m_gtsam.storage.known_sensors import level_of, read_known_sensors
from l2m_gtsam.storage.point_cloud2 import cloud_topic

# What a map file takes: 120 MB.
MAX_LIDAR_POINTS = 5_000_000
# Poses of the mapping drives that are kept: where the start of another drive is looked for.
PLACES_M = 2.0
MAX_PLACES = 1000


@dataclass(frozen=True)
class StructureCloud:
    """A structure cloud in the map frame in metres, shape (M, 3), and where it came from."""

    points: FloatArray
    provenance: dict[str, Any]


@dataclass(frozen=True)
class ScannedPlace:
    """What scans are localised on, and where it came from."""

    lidar: LidarMap
    provenance: dict[str, Any]


@dataclass(frozen=True)
class MappingDrives:
    """Mapping bags and what was given with them.

    Attributes
    ----------
    recordings
        One per bag.
    suite
        Sensors of the mapping suite by name; absent where all are ideal.
    structure
        What a LiDAR saw, if that was given.
    suite_file
        What a map's file says of the file of the suite, if there is one.
    """

    recordings: list[Recording]
    suite: dict[str, KnownSensor] | None
    structure: StructureCloud | None
    suite_file: dict[str, Any] | None

    @property
    def cloud(self) -> FloatArray | None:
        """Points of the structure in metres, shape (M, 3), if there is one."""
        return None if self.structure is None else self.structure.points


def read_survey(
    bags: Sequence[Path],
    config: Config,
    suite: Path | None,
    structure: str | None,
    progress: Progress,
) -> MappingDrives:
    """Return everything that a map is made of; files before bags, which take longer."""
    known = None if suite is None else read_known_sensors(suite)
    used = None if suite is None else used_file(suite, level_of(suite))
    options = config.mapping.structure
    is_file = structure is not None and _names_file(structure)
    cloud = _structure_file(Path(structure or ""), options) if is_file else None
    recordings = [read_drive_or_follow(bag, config, progress) for bag in bags]
    if structure is not None and not is_file:
        cloud = _structure_topic(structure, bags, recordings, config, progress)
    return MappingDrives(recordings, known, cloud, used)


def _names_file(structure: str) -> bool:
    """Return whether a file is meant: names of topics have no dots."""
    return Path(structure).suffix != "" or Path(structure).is_file()


def _structure_file(path: Path, options: CloudTopicOptions) -> StructureCloud:
    return StructureCloud(read_cloud(path, options.edge), vars(source_file(path)))


def _structure_topic(
    topic: str,
    bags: Sequence[Path],
    recordings: Sequence[Recording],
    config: Config,
    progress: Progress,
) -> StructureCloud:
    """Return what the scans of all bags saw, placed by their poses."""
    topics = [topic] * len(bags)
    cloud = _cloud(topics, bags, recordings, config.mapping.structure, config, progress)
    return StructureCloud(cloud.points, {"topic": topic, **_counts(cloud)})


def scanned_place(
    bags: Sequence[Path], recordings: Sequence[Recording], config: Config, progress: Progress
) -> ScannedPlace:
    """Return what the scans of mapping bags saw, to localise other scans on.

    Raises
    ------
    BagError
        A bag has no usable clouds.
    MapError
        The cloud would be too large.
    """
    options = config.mapping.lidar
    topics = [cloud_topic(bag, config.lidar.topic) for bag in bags]
    cloud = _cloud(topics, bags, recordings, options, config, progress)
    points = thinned_cloud(cloud.points, options.edge)
    if len(points) > MAX_LIDAR_POINTS:
        raise MapError(
            f"the cloud has {len(points):,} points, a map takes {MAX_LIDAR_POINTS:,} at most; "
            "choose a larger `mapping.lidar.edge` or a smaller `mapping.lidar.max_range`"
        )
    points = smoothed(points)
    R, p = _along([each.trajectory for each in recordings])
    notes = [note for each in recordings for note in each.notes]
    provenance = {"topics": topics, "points": len(points), "edge": options.edge, **_counts(cloud)}
    provenance |= {"notes": notes} if notes else {}
    return ScannedPlace(LidarMap(points, R, p), provenance)


def _cloud(
    topics: Sequence[str],
    bags: Sequence[Path],
    recordings: Sequence[Recording],
    options: CloudTopicOptions,
    config: Config,
    progress: Progress,
) -> TopicCloud:
    """Return what the scans of all bags saw, each placed by the poses of its own."""
    clouds = [
        read_cloud_topic(
            bag,
            topic,
            recording.trajectory,
            options,
            config.bag.stamps,
            counter(f"reading {topic} of {bag.name}", progress),
        )
        for topic, bag, recording in zip(topics, bags, recordings, strict=True)
    ]
    return TopicCloud(
        np.concatenate([each.points for each in clouds]),
        sum(each.scans for each in clouds),
        sum(each.without_pose for each in clouds),
    )


def _counts(cloud: TopicCloud) -> dict[str, int]:
    return {"scans": cloud.scans, "scans_without_pose": cloud.without_pose}


def _along(trajectories: Sequence[Trajectory]) -> tuple[FloatArray, FloatArray]:
    """Return rotations (K, 3, 3) and positions (K, 3) of drives, some distance apart."""
    poses = [each[_spaced(each.p)] for each in trajectories]
    R, p = np.concatenate([each.R for each in poses]), np.concatenate([each.p for each in poses])
    step = -(-len(p) // MAX_PLACES)
    return R[::step], p[::step]


def _spaced(p: FloatArray) -> IntArray:
    """Return the rows of positions, shape (N, 3), after each `PLACES_M` of path."""
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    _, rows = np.unique(np.floor(path / PLACES_M), return_index=True)
    return np.asarray(rows)


def calibrate_suite_file(
    bags: Sequence[Path], out: Path, config: Config, known: Path | None, progress: Progress
) -> CalibrationResult:
    """Calibrate the sensors of mapping bags and write the calibration.

    Parameters
    ----------
    bags
        One or several mapping bags of one suite.
    out
        Calibration to write (`.yaml`).
    known
        File with what is known of the sensors, if there is one.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line; nothing is written then.
    """
    check_bags(bags)
    check_outputs(out, suffix=".yaml")
    assumed = None if known is None else read_known_sensors(known)
    recordings = [read_drive(bag, config, progress) for bag in bags]
    found = calibrate_suite(
        recordings, assumed, config.mapping.suite, progress, config.mapping.pose_noise
    )
    _check_solved(found, bags)
    if known is not None and level_of(known) is Level.FAIL:
        doubt = f"what was known of the sensors is {known}, whose verdict is FAIL"
        found = replace(found, doubts=(*found.doubts, doubt))
    options = config.model_dump(mode="json", include={"bag", "mapping"})
    result = replace(found, options=options, versions=versions())
    ensure_folder(out.parent)
    write_calibration(out, result)
    return result


def _check_solved(found: CalibrationResult, bags: Sequence[Path]) -> None:
    """Refuse a calibration that no command would take."""
    if any(each.status is SensorStatus.SOLVED for each in found.sensors):
        return
    first = found.sensors[0]
    raise CalibrationError(
        f"{', '.join(map(str, bags))}: no sensor of the suite is solved, nothing is written: "
        f"{'; '.join([first.message, *found.doubts[:1]])}"
    )
