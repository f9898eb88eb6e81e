"""A small simulated warehouse on disk, made once for all tests of the command line."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest


@dataclass(frozen=True)
class Finished:
    """How a run of the command line ended."""

    code: int
    out: str
    err: str


def l2m(*arguments: str | Path, check: bool = True) -> Finished:
    """Run ``l2m`` as a user would, in a process of its own."""
    command = [sys.executable, "-c", "from l2m_gtsam.cli import main; main()"]
    environment = {**os.environ, "COLUMNS": "200", "NO_COLOR": "1"}
    run = subprocess.run(
        [*command, *map(str, arguments)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
        timeout=300,
    )
    if check and run.returncode:
        pytest.fail(f"l2m {' '.join(map(str, arguments))} failed:\n{run.stdout}\n{run.stderr}")
    return Finished(run.returncode, run.stdout, run.stderr)


@dataclass(frozen=True)
class Warehouse:
    """Where the simulated files are."""

    folder: Path
    map: Path


@pytest.fixture(scope="session")
def warehouse(tmp_path_factory: pytest.TempPathFactory) -> Warehouse:
    """Simulated bags of all three kinds and the map of the mapping drive."""
    folder = tmp_path_factory.mktemp("warehouse")
    l2m("simulate", "--out", folder)
    map_path = folder / "map.npz"
    l2m(
        "map", "build", folder / "mapping_mcap", "--suite", folder / "suite.yaml", "--out", map_path
    )
    return Warehouse(folder, map_path)
