"""The demonstration on disk, made once for all tests of the command line."""

import io
import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from l2m_gtsam.cli import main


@dataclass(frozen=True)
class Finished:
    """How a run of the command line ended."""

    code: int
    out: str
    err: str


def l2m(*arguments: str | Path, fails: bool = False, timeout: float = 600) -> Finished:
    """Run ``l2m`` as a user would, in a process of its own."""
    command = [sys.executable, "-c", "from l2m_gtsam.cli import main; main()"]
    environment = {**os.environ, "COLUMNS": "200", "NO_COLOR": "1"}
    run = subprocess.run(
        [*command, *map(str, arguments)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
        timeout=timeout,
    )
    if bool(run.returncode) != fails:
        pytest.fail(f"l2m {' '.join(map(str, arguments))}:\n{run.stdout}\n{run.stderr}")
    return Finished(run.returncode, run.stdout, run.stderr)


def complaint(*arguments: str | Path) -> str:
    """Run ``l2m`` on bad input and return its one line; anything else fails the test."""
    return one_line(l2m(*arguments, fails=True))


def complaint_here(*arguments: str | Path) -> str:
    """As ``complaint``, but in this process: an answer in no time to many bad inputs."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", ["l2m", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
    assert isinstance(end.value.code, int)
    return one_line(Finished(end.value.code, out.getvalue(), err.getvalue()))


def one_line(run: Finished) -> str:
    """Return the one line that a run on bad input ended with."""
    # progress bars of stages that went well may stand above the line
    lines = [line for line in run.err.splitlines() if line.startswith("l2m: ")]
    assert run.code == 2
    assert len(lines) == 1
    assert run.err.splitlines()[-1] == lines[0]
    assert "Traceback" not in run.err
    return lines[0]


@dataclass(frozen=True)
class Demo:
    """What ``l2m demo`` made and printed."""

    folder: Path
    out: str

    @property
    def drive(self) -> Path:
        """The calibration bag."""
        return self.folder / "calibration_mcap"

    @property
    def map(self) -> Path:
        """The map file."""
        return self.folder / "map.npz"


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    """Run the demonstration with its defaults."""
    folder = tmp_path_factory.mktemp("demo")
    return Demo(folder, l2m("demo", "--out", folder).out)
