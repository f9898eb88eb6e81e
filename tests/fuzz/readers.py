"""Files whose commands take long also when the file is sound: what reads them, alone."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from l2m_gtsam.config import load_options
from l2m_gtsam.simulate.scenario import ScenarioOptions
from l2m_gtsam.storage.cloud import read_cloud
from l2m_gtsam.storage.drive_lists import read_manifest
from l2m_gtsam.storage.listed_sensors import read_sensors

READERS: dict[str, Callable[[Path], Any]] = {
    "cloud": lambda path: read_cloud(path, 0.1),
    "manifest": read_manifest,
    "sensors": read_sensors,
    "scenario": lambda path: load_options(path, ScenarioOptions),
}
