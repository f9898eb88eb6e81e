"""The command line as tests run it, in this process or in one of its own."""

import io
import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from l2m_gtsam.cli.app import main

TERMINAL = {"COLUMNS": "200", "NO_COLOR": "1"}


@dataclass(frozen=True)
class Finished:
    """How a run of the command line ended."""

    code: int
    out: str
    err: str


def l2m(*arguments: str | Path) -> Finished:
    """Run ``l2m`` in this process, which spares seconds of imports; it must end well."""
    run = ended(*arguments)
    if run.code:
        pytest.fail(f"l2m {' '.join(map(str, arguments))}:\n{run.out}\n{run.err}")
    return run


def complaint_here(*arguments: str | Path) -> str:
    """Run ``l2m`` on bad input in this process and return its one line."""
    return one_line(ended(*arguments))


def ended(*arguments: str | Path) -> Finished:
    """Run ``l2m`` in this process, and return how it ended."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", ["l2m", *map(str, arguments)])
        for name, value in TERMINAL.items():
            patch.setenv(name, value)
        with pytest.raises(SystemExit) as end:
            main()
    code = end.value.code
    assert code is None or isinstance(code, int)
    return Finished(code or 0, out.getvalue(), err.getvalue())


def l2m_process(*arguments: str | Path, fails: bool = False, timeout: float = 600) -> Finished:
    """Run ``l2m`` as a user would, in a process of its own."""
    command = [sys.executable, "-c", "from l2m_gtsam.cli.app import main; main()"]
    run = subprocess.run(
        [*command, *map(str, arguments)],
        capture_output=True,
        text=True,
        env={**os.environ, **TERMINAL},
        check=False,
        timeout=timeout,
    )
    if bool(run.returncode) != fails:
        pytest.fail(f"l2m {' '.join(map(str, arguments))}:\n{run.stdout}\n{run.stderr}")
    return Finished(run.returncode, run.stdout, run.stderr)


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
