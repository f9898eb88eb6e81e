"""Options of a map that is built from recordings."""

from l2m_gtsam.mapping.suite.options import SuiteOptions
from l2m_gtsam.maps.build import MapOptions
from l2m_gtsam.maps.compare import CompareOptions
from l2m_gtsam.options import Options
from l2m_gtsam.recording.sync import SyncOptions
from l2m_gtsam.storage.cloud_topic import CloudTopicOptions


class MappingOptions(Options):
    """How a map is built from mapping bags."""

    sync: SyncOptions = SyncOptions(thin_distance_m=0.05, thin_angle_deg=10.0)
    """Which readings enter; a map needs its readings spread in space, not in heading."""
    model: MapOptions = MapOptions()
    """The kind of map and its options."""
    structure: CloudTopicOptions = CloudTopicOptions(edge=0.05)
    """How a structure cloud is read: from a file, which is in the map frame, only `edge` counts."""
    lidar: CloudTopicOptions = CloudTopicOptions(edge=0.1, max_range=30.0)
    """How scans become the cloud that is saved with the map; their topic is `lidar.topic`."""
    compare: CompareOptions = CompareOptions()
    """How `l2m map compare` holds readings out."""
    suite: SuiteOptions = SuiteOptions()
    """How `l2m map suite` calibrates the sensors that map."""
