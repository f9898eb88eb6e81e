"""What the scans of a drive say of its poses beside odometry: fixes on a map's cloud, or loops."""

from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from l2m_gtsam.batch.opening import SavedMap
from l2m_gtsam.batch.scan_poses import bag_scans, scan_start
from l2m_gtsam.config import Config
from l2m_gtsam.data import LidarMap, Recording, RigidTransform
from l2m_gtsam.errors import LidarError
from l2m_gtsam.geometry import compose
from l2m_gtsam.lidar.loop_closures import find_loop_closures
from l2m_gtsam.lidar.registration import PoseEstimate
from l2m_gtsam.lidar.scan_localisation import ScanLocalisationOptions, localise_scans, spaced
from l2m_gtsam.lidar.surface import Surface
from l2m_gtsam.progress import Progress
from l2m_gtsam.recording.odometry_jumps import without_jumps
from l2m_gtsam.records.scans import ScanEvidence
from l2m_gtsam.slam.localisation import NO_SCANS, start_pose
from l2m_gtsam.slam.odometry import scan_odometry
from l2m_gtsam.slam.options import Usage
from l2m_gtsam.storage.point_cloud2 import has_clouds

# Along what a scan does not show a fix says nothing, nor do some hundreds of them; more than this
# beside the millimetres of what it shows would drown in rounding.
UNSEEN = {"unseen_m": 100.0, "unseen_deg": 100.0}


@dataclass(frozen=True)
class Scanned:
    """What scans say, and what is worth a warning."""

    evidence: ScanEvidence = NO_SCANS
    notes: tuple[str, ...] = ()


def read_evidence(
    bag: Path, recording: Recording, saved: SavedMap | None, config: Config, progress: Progress
) -> Scanned:
    """Register the scans of a bag: on the cloud of the map if it has one, else on each other.

    Scans that fit nowhere do not stop a localisation: it goes on without, and says so.

    Parameters
    ----------
    bag
        The drive.
    recording
        What was read of it: its poses are odometry.
    saved
        The map, if there is one.
    config
        Configuration.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    BagError
        The bag's clouds are not usable.
    """
    if config.slam.scans is Usage.IGNORED or not has_clouds(bag):
        return Scanned()
    try:
        mapped = None if saved is None else saved.state.lidar
        if mapped is None:
            return Scanned(_loops(bag, recording, config, progress))
        return Scanned(_fixes(bag, recording, mapped, config, progress))
    except LidarError as error:
        return Scanned(notes=(f"{bag}: its point clouds take no part: {error}",))


def _loops(bag: Path, recording: Recording, config: Config, progress: Progress) -> ScanEvidence:
    options, scans = config.lidar.loops, bag_scans(bag, config, progress)
    edge = options.registration.edge
    mended = without_jumps(recording.trajectory, config.slam.jumps)
    steps = scan_odometry(scans, mended, edge, config.slam)
    return ScanEvidence(loops=find_loop_closures(steps, options).loops)


def _fixes(
    bag: Path, recording: Recording, mapped: LidarMap, config: Config, progress: Progress
) -> ScanEvidence:
    options, scans = _localisation(config), bag_scans(bag, config, progress)
    edge = options.registration.edge
    mended = without_jumps(recording.trajectory, config.slam.jumps)
    steps = scan_odometry(scans, mended, edge, config.slam)
    first = next(steps, None)
    if first is None:
        raise LidarError("no scan has points enough, at a time that has odometry")
    cloud = Surface(mapped.points)
    if config.slam.start.anywhere:
        start = scan_start(first, cloud, mapped, config.lidar)
    else:
        known = start_pose(recording.trajectory, config.slam.start)
        T_map_odom = _map_odom(recording, known.T_map_lidar)
        start = PoseEstimate(compose(T_map_odom, first.T_odom_lidar), known.covariance)
    found = localise_scans(chain([first], steps), cloud, start, options)
    return ScanEvidence(fixes=spaced(found.fixes, config.slam.key_poses.distance_m, options))


def _localisation(config: Config) -> ScanLocalisationOptions:
    options = config.lidar.localisation
    return options.model_copy(
        update={"registration": options.registration.model_copy(update=UNSEEN)}
    )


def _map_odom(recording: Recording, T_map_lidar: RigidTransform) -> RigidTransform:
    """Return where the frame of odometry lies in the map if its first pose is this."""
    odometry = recording.trajectory
    return compose(T_map_lidar, RigidTransform(odometry.R[0], odometry.p[0]).inverse())
