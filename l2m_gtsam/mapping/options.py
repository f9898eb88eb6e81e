"""Options of maps and of the suites that survey them, composed of those of their steps."""

from pydantic import Field

from l2m_gtsam.maps.build import MapOptions
from l2m_gtsam.maps.compare import CompareOptions
from l2m_gtsam.options import Options
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.recording.sync import SyncOptions
from l2m_gtsam.storage.cloud_topic import CloudTopicOptions


class SuiteCalibrationOptions(Options):
    """How the sensors of a mapping suite are calibrated from their own drive."""

    sync: SyncOptions = SyncOptions(thin_distance_m=0.03, thin_angle_deg=5.0)
    """Which readings enter. One place under two headings determines most of the sensors."""
    position_m: float = Field(default=0.3, gt=0)
    """How far a sensor may sit from where it is assumed, along each axis: standard deviation in
    metres. Assumed is the lidar's origin, or the suite that is given to start from."""
    matrix: float = Field(default=0.1, gt=0, lt=1)
    """How far each entry of C may be from what is assumed, the identity if nothing is given."""
    offset_ut: float = Field(default=20.0, gt=0)
    """How far H may be from what is assumed, zero if nothing is given, in microtesla."""
    clock_s: float = Field(default=0.02, gt=0)
    """How far a sensor's clock may be off, in seconds."""
    windows: int = Field(default=4, ge=1)
    """Parts of the survey that are used, spread over it."""
    readings: int = Field(default=3000, ge=100)
    """The most readings of one of them."""
    modes: int = Field(default=300, ge=50)
    """About how many waves describe the field in one of them; time goes with the square."""
    rounds: int = Field(default=20, ge=1)
    """How often strength and depth of the field's sources are learnt anew, at the most. Sensors on
    a planar robot settle slowly (about eight rounds): scale and depth of the field trade."""
    steps: int = Field(default=10, ge=1)
    """The most steps of the solve in one round."""
    searches: int = Field(default=2, ge=0)
    """How often steel beside the path is searched for where waves do not explain the survey, at the
    most: after the rounds, and again with the sensors that this gave. 0 searches nothing."""


class MappingOptions(Options):
    """How a map is built from mapping bags."""

    sync: SyncOptions = SyncOptions(thin_distance_m=0.05, thin_angle_deg=10.0)
    """Which readings enter; a map needs its readings spread in space, not in heading."""
    pose_noise: PoseNoiseOptions = PoseNoiseOptions()
    """How wrong the survey's poses are. Where neither this nor the recording says so, a harmonic
    map looks for it in its readings; with both sigmas 0 poses count as exact. Where only sizes are
    stated, and not how long errors last (`correlation_s`), they count if readings of a pass have
    them in common; else they are noise of each reading, which the map has learnt."""
    model: MapOptions = MapOptions()
    """The kind of map and its options."""
    structure: CloudTopicOptions = CloudTopicOptions(edge=0.05)
    """How a structure cloud is read: from a file, which is in the map frame, only `edge` counts."""
    lidar: CloudTopicOptions = CloudTopicOptions(edge=0.1, max_range=30.0)
    """How scans become the cloud that is saved with the map; their topic is `lidar.topic`."""
    compare: CompareOptions = CompareOptions()
    """How `l2m map compare` holds readings out."""
    suite: SuiteCalibrationOptions = SuiteCalibrationOptions()
    """How `l2m map suite` calibrates the sensors that map."""
