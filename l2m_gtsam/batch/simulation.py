"""Simulated drives as files, with the truth beside them."""

from collections.abc import Sequence
from pathlib import Path

from l2m_gtsam.progress import Progress
from l2m_gtsam.simulate.bag_writer import BagKind, WriterOptions, write_bag
from l2m_gtsam.simulate.scenario import Scenario, ScenarioOptions, simulate
from l2m_gtsam.storage.cloud import write_cloud
from l2m_gtsam.storage.files import ensure_folder
from l2m_gtsam.storage.known_sensors import write_known_sensors
from l2m_gtsam.storage.trajectory_files import write_tum

SUITE_FILE, TRUTH_FILE, STRUCTURE_FILE = "suite.yaml", "truth.yaml", "structure.ply"
GROUND_TRUTH_FILE = "ground_truth.tum"


def simulate_bags(
    out: Path, options: ScenarioOptions, kinds: Sequence[BagKind], progress: Progress
) -> Scenario:
    """Simulate a mapping and a calibration drive and write them as bags, with the truth.

    Parameters
    ----------
    out
        Folder for `mapping_*` and `calibration_*` bags, `suite.yaml`, `truth.yaml` and
        `structure.ply`, what a LiDAR sees of the steel; where odometry drifts, `ground_truth.tum`
        of the calibration drive, too.
    options
        The world and the drives.
    kinds
        Kinds of bag to write.
    progress
        Called with a stage and the fraction of it that is done.
    """
    scenario = simulate(options, progress)
    ensure_folder(out)
    _write_bags(out, scenario, kinds, progress)
    (out / GROUND_TRUTH_FILE).unlink(missing_ok=True)  # of an earlier run with drift
    if options.odometry is not None:
        write_tum(out / GROUND_TRUTH_FILE, scenario.calibration.truth())
    write_cloud(out / STRUCTURE_FILE, scenario.cloud)
    facts = {"simulation": options.model_dump(mode="json")}
    write_known_sensors(
        out / SUITE_FILE,
        scenario.suite,
        facts,
        "The mapping suite's own calibrations: what `l2m map build --suite` needs.",
    )
    write_known_sensors(
        out / TRUTH_FILE,
        scenario.truth,
        facts,
        "The true positions and distortions of the sensors in the calibration drive.",
    )
    return scenario


def _write_bags(
    out: Path, scenario: Scenario, kinds: Sequence[BagKind], progress: Progress
) -> None:
    """Write both drives as bags of every kind."""
    options = WriterOptions(noise=scenario.options.noise)
    true = None if scenario.options.odometry is None else scenario.calibration.truth()
    drives = {"mapping": (scenario.mapping, None), "calibration": (scenario.calibration, true)}
    written = 0
    for kind in kinds:
        for name, (drive, truth) in drives.items():
            progress("writing bags", written / (len(kinds) * len(drives)))
            path = out / bag_name(name, kind)
            write_bag(path, kind, drive.recording, options, scans=drive.scans, truth=truth)
            written += 1
    progress("writing bags", 1.0)


def bag_name(drive: str, kind: BagKind) -> str:
    """Return the file or folder name of a simulated bag."""
    suffix = {BagKind.ROS1: "_ros1.bag", BagKind.SQLITE3: "_sqlite3", BagKind.MCAP: "_mcap"}
    return drive + suffix[kind]
