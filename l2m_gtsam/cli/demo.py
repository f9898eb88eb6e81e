"""The demonstration: a simulated warehouse, mapped and calibrated, against its truth."""

from dataclasses import dataclass
from pathlib import Path

from l2m_gtsam.batch.drives import OVERVIEW_FILE, calibrate_bag
from l2m_gtsam.batch.maps import build_map_file
from l2m_gtsam.batch.reports import REPORT_FILE, report_folder
from l2m_gtsam.batch.simulation import STRUCTURE_FILE, SUITE_FILE, bag_name, simulate_bags
from l2m_gtsam.config import Config
from l2m_gtsam.data import KnownSensor
from l2m_gtsam.progress import Progress
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.simulate.bag_writer import BagKind
from l2m_gtsam.simulate.scenario import ScenarioOptions


@dataclass(frozen=True)
class Demonstration:
    """What the demonstration found, what is true, and where picture and report are."""

    result: CalibrationResult
    truth: tuple[KnownSensor, ...]
    picture: Path
    report: Path


def run_demo(out: Path, options: ScenarioOptions, progress: Progress) -> Demonstration:
    """Simulate two drives, build the map, calibrate, and draw the outcome beside the truth.

    Parameters
    ----------
    out
        Folder for everything that is made, the way a user's own files would lie.
    options
        The world and the drives.
    progress
        Called with a stage and the fraction of it that is done.
    """
    config, map_path = Config(), out / "map.npz"
    mapping, drive = (out / bag_name(name, BagKind.MCAP) for name in ("mapping", "calibration"))
    scenario = simulate_bags(out, options, [BagKind.MCAP], progress)
    cloud = str(out / STRUCTURE_FILE)
    build_map_file([mapping], map_path, config, out / SUITE_FILE, progress, cloud)
    result = calibrate_bag(drive, map_path, config, out, progress, scenario.truth)
    report_folder(out, None, progress)
    return Demonstration(result, scenario.truth, out / OVERVIEW_FILE, out / REPORT_FILE)
