"""Drives whose poses come from their point clouds."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

from l2m_gtsam.batch.files import SavedMap, read_drive_and_numbers, read_numbers
from l2m_gtsam.config import Config
from l2m_gtsam.data import LidarMap, Recording
from l2m_gtsam.errors import BagError, LidarError
from l2m_gtsam.lidar.odometry import ScanStep, follow, odometry
from l2m_gtsam.lidar.options import PointCloudOptions, PoseSource
from l2m_gtsam.lidar.registration import PoseEstimate, unseen_covariance
from l2m_gtsam.lidar.scan_localisation import ScanLocalisation, find_start, localise_scans
from l2m_gtsam.lidar.surface import Surface
from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.recording.joining import joined
from l2m_gtsam.storage.bag import has_poses, read_fields
from l2m_gtsam.storage.clocks import check_clocks
from l2m_gtsam.storage.files import source_file
from l2m_gtsam.storage.point_cloud2 import ScanTopic, has_clouds


def read_drives_on(
    saved: SavedMap, bags: Sequence[Path], config: Config, progress: Progress
) -> Recording:
    """Return what one bag or several recorded, with numbers and poses in a map, as one recording.

    Raises
    ------
    L2MError
        Whatever is wrong with a bag or its clouds, in one line.
    """
    return joined([read_drive_on(saved, bag, config, progress) for bag in bags])


def read_drive_on(saved: SavedMap, bag: Path, config: Config, progress: Progress) -> Recording:
    """Return what a bag recorded, with numbers and poses in a map: its own, or by its clouds."""
    if not _by_clouds(bag, config):
        return read_drive_and_numbers(bag, config, progress)
    series = read_fields(bag, config.bag)
    found = _localised(saved, bag, config, progress)
    check_clocks(bag, found.trajectory, series)
    note = (
        f"{bag}: poses are those of its point clouds, {len(found.fixes)} of {found.scans} scans "
        f"fit the cloud of {saved.path}"
    )
    scalars = read_numbers(bag, config, progress)
    return Recording(found.trajectory, series, source_file(bag), scalars, notes=(note,))


def read_drive_or_follow(bag: Path, config: Config, progress: Progress) -> Recording:
    """Return what a bag recorded; where it has no poses, with odometry by its clouds.

    Odometry is in the frame of the first scan.

    Raises
    ------
    L2MError
        Whatever is wrong with the bag or its clouds, in one line.
    """
    if not _by_clouds(bag, config):
        return read_drive_and_numbers(bag, config, progress)
    series = read_fields(bag, config.bag)
    scalars = read_numbers(bag, config, progress)
    poses = odometry(bag_scans(bag, config, progress), config.lidar.odometry)
    if len(poses) < 2:
        raise LidarError(f"{bag}: fewer than two scans have points enough for odometry")
    poses = replace(poses, frame=config.bag.frame or poses.frame)
    check_clocks(bag, poses, series)
    note = f"{bag}: poses are odometry by its point clouds, which drifts"
    return Recording(poses, series, source_file(bag), scalars, notes=(note,))


def bag_scans(bag: Path, config: Config, progress: Progress) -> ScanTopic:
    """Return the scans of a bag, to be read one by one."""
    count = counter(f"following scans of {bag.name}", progress)
    return ScanTopic(bag, config.lidar.topic, config.lidar.scan, config.bag.stamps, count)


def _by_clouds(bag: Path, config: Config) -> bool:
    """Return whether a drive's poses come from its clouds."""
    asked = config.lidar.poses is PoseSource.CLOUDS
    return asked or (not has_poses(bag, config.bag) and has_clouds(bag))


def _localised(saved: SavedMap, bag: Path, config: Config, progress: Progress) -> ScanLocalisation:
    mapped, options = saved.state.lidar, config.lidar
    if mapped is None:
        raise BagError(
            f"{bag}: its poses must come from its point clouds, but {saved.path} has no cloud to "
            "localise them on; build it with `l2m map build --lidar`"
        )
    steps = iter(follow(bag_scans(bag, config, progress), options.odometry))
    try:
        first = next(steps, None)
        if first is None:
            raise LidarError("no scan has points enough to be localised")
        cloud = Surface(mapped.points)
        start = scan_start(first, cloud, mapped, options)
        frame = str(saved.state.provenance.get("frame") or "map")
        return localise_scans(chain([first], steps), cloud, start, options.localisation, frame)
    except LidarError as error:
        raise LidarError(f"{bag} on {saved.path}: {error}") from error


def scan_start(
    first: ScanStep, cloud: Surface, mapped: LidarMap, options: PointCloudOptions
) -> PoseEstimate:
    """Return where a drive begins: as it is said, else as the first scan fits."""
    registration = options.localisation.registration
    if options.start is not None:
        T = options.start.rigid()
    else:
        T = find_start(first.surface, cloud, mapped, options.search, registration)
    return PoseEstimate(T, unseen_covariance(registration))
