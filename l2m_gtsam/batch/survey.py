"""What a map is made of: mapping bags, the suite's calibrations, what a LiDAR saw."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from l2m_gtsam.batch.opening import read_drive
from l2m_gtsam.config import Config
from l2m_gtsam.data import FloatArray, KnownSensor, Recording
from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.storage.cloud import read_cloud
from l2m_gtsam.storage.cloud_topic import CloudTopicOptions, read_cloud_topic
from l2m_gtsam.storage.digest import source_file
from l2m_gtsam.storage.known_sensors import read_known_sensors


@dataclass(frozen=True)
class Structure:
    """A structure cloud in the map frame in metres, shape (M, 3), and where it came from."""

    points: FloatArray
    provenance: dict[str, Any]


@dataclass(frozen=True)
class Survey:
    """Mapping bags and what was given with them.

    Attributes
    ----------
    recordings
        One per bag.
    suite
        Sensors of the mapping suite by name; absent where all are ideal.
    structure
        What a LiDAR saw, if that was given.
    """

    recordings: list[Recording]
    suite: dict[str, KnownSensor] | None
    structure: Structure | None

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
) -> Survey:
    """Return everything that a map is made of; files before bags, which take longer."""
    known = None if suite is None else read_known_sensors(suite)
    options = config.mapping.structure
    is_file = structure is not None and _names_file(structure)
    cloud = _structure_file(Path(structure or ""), options) if is_file else None
    recordings = [read_drive(bag, config, progress) for bag in bags]
    if structure is not None and not is_file:
        cloud = _structure_topic(structure, bags, recordings, config, progress)
    return Survey(recordings, known, cloud)


def _names_file(structure: str) -> bool:
    """Return whether a file is meant: names of topics have no dots."""
    return Path(structure).suffix != "" or Path(structure).is_file()


def _structure_file(path: Path, options: CloudTopicOptions) -> Structure:
    return Structure(read_cloud(path, options.edge), vars(source_file(path)))


def _structure_topic(
    topic: str,
    bags: Sequence[Path],
    recordings: Sequence[Recording],
    config: Config,
    progress: Progress,
) -> Structure:
    """Return what the scans of all bags saw, placed by their poses."""
    clouds = [
        read_cloud_topic(
            bag,
            topic,
            recording.trajectory,
            config.mapping.structure,
            config.bag.stamps,
            counter(f"reading {topic} of {bag.name}", progress),
        )
        for bag, recording in zip(bags, recordings, strict=True)
    ]
    provenance = {
        "topic": topic,
        "scans": sum(cloud.scans for cloud in clouds),
        "scans_without_pose": sum(cloud.without_pose for cloud in clouds),
    }
    return Structure(np.concatenate([cloud.points for cloud in clouds]), provenance)
