"""Files whose commands take long also when the file is sound: what reads them, alone."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from l2m_gtsam.config import load_options
from l2m_gtsam.data import Trajectory
from l2m_gtsam.simulate.scenario import ScenarioOptions
from l2m_gtsam.storage.cloud import read_cloud
from l2m_gtsam.storage.cloud_topic import CloudTopicOptions, read_cloud_topic
from l2m_gtsam.storage.drive_lists import read_manifest
from l2m_gtsam.storage.listed_sensors import read_sensors
from l2m_gtsam.storage.record_files import read_outcome
from l2m_gtsam.studies.registry import STUDIES


def _scans(path: Path) -> None:
    """Read the cloud of a bag's scans, taken where the map has its origin."""
    stamps = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(60)
    still = Trajectory(stamps, np.array([np.eye(3)] * 60), np.zeros((60, 3)), "map", "lidar")
    read_cloud_topic(path, "/points", still, CloudTopicOptions())


READERS: dict[str, Callable[[Path], Any]] = {
    "cloud": lambda path: read_cloud(path, 0.1),
    "manifest": read_manifest,
    "sensors": read_sensors,
    "scans": _scans,
    "outcome": read_outcome,
    **{
        f"study {name}": partial(load_options, model=study.options)
        for name, study in STUDIES.items()
    },
    "scenario": lambda path: load_options(path, ScenarioOptions),
}
