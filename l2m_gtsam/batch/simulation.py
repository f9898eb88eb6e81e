"""Simulated drives as files, with the truth beside them."""

from collections.abc import Sequence
from pathlib import Path

from l2m_gtsam.batch.outputs import ensure_folder
from l2m_gtsam.progress import Progress
from l2m_gtsam.simulate.bag_writer import BagKind, BagOptions, write_bag
from l2m_gtsam.simulate.scenario import Scenario, ScenarioOptions, simulate
from l2m_gtsam.storage.cloud import write_cloud
from l2m_gtsam.storage.known_sensors import write_known_sensors

SUITE_FILE, TRUTH_FILE, STRUCTURE_FILE = "suite.yaml", "truth.yaml", "structure.ply"


def simulate_bags(
    out: Path, options: ScenarioOptions, kinds: Sequence[BagKind], progress: Progress
) -> Scenario:
    """Simulate a mapping and a calibration drive and write them as bags, with the truth.

    Parameters
    ----------
    out
        Folder for `mapping_*` and `calibration_*` bags, `suite.yaml`, `truth.yaml` and
        `structure.ply`, what a LiDAR sees of the steel.
    options
        The world and the drives.
    kinds
        Kinds of bag to write.
    progress
        Called with a stage and the fraction of it that is done.
    """
    scenario = simulate(options, progress)
    ensure_folder(out)
    for index, kind in enumerate(kinds):
        progress("writing bags", index / len(kinds))
        for name, drive in (("mapping", scenario.mapping), ("calibration", scenario.calibration)):
            path = out / bag_name(name, kind)
            write_bag(path, kind, drive.recording, BagOptions(noise=options.noise))
    progress("writing bags", 1.0)
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


def bag_name(drive: str, kind: BagKind) -> str:
    """Return the file or folder name of a simulated bag."""
    suffix = {BagKind.ROS1: "_ros1.bag", BagKind.SQLITE3: "_sqlite3", BagKind.MCAP: "_mcap"}
    return drive + suffix[kind]
