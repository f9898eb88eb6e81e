"""How commands end when they do not end well: one last line, and an exit code."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

import pytest

from l2m_gtsam.cli import app
from tests.support.command_line import ended
from tests.support.slow_command import SLOW

RUN = [sys.executable, "-c", "from l2m_gtsam.cli.app import main; main()"]


def test_a_fault_of_the_program_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("\x1b[31mred\nand more")

    monkeypatch.setattr(app, "app", broken)
    run = ended("inspect", "x")
    assert run.code == app.FAULT
    assert run.err == (
        "l2m: a fault of this program, please report it with what --debug shows: "
        "ZeroDivisionError: \\x1b[31mred and more\n"
    )


def test_debug_shows_where(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("why")

    monkeypatch.setattr(app, "app", broken)
    monkeypatch.setattr(sys, "argv", ["l2m", "inspect", "--debug"])
    with pytest.raises(ZeroDivisionError):
        app.main()


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (MemoryError(), "l2m: not enough memory"),
        (OSError(28, "No space left on device", "/a/b"), "l2m: /a/b: No space left on device"),
        (RecursionError("deep"), "l2m: a fault of this program"),
    ],
)
def test_what_the_system_refuses(
    monkeypatch: pytest.MonkeyPatch, error: Exception, told: str
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(app, "app", broken)
    run = ended("inspect", "x")
    assert run.err.startswith(told)
    assert run.err.count("\n") == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no full device")
def test_output_that_does_not_arrive() -> None:
    with Path("/dev/full").open("wb") as full:
        run = subprocess.run(
            [*RUN, "--version"], stdout=full, stderr=subprocess.PIPE, check=False, text=True
        )
    assert run.returncode == app.USER
    assert run.stderr == "l2m: standard output: cannot be written: No space left on device\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals(tmp_path: Path, number: signal.Signals) -> None:
    ready = tmp_path / "ready"
    run = subprocess.Popen(
        [sys.executable, "-c", SLOW, str(ready)], stderr=subprocess.PIPE, text=True
    )
    late = monotonic() + 60
    while not ready.exists() and monotonic() < late:
        sleep(0.02)  # between looks: the process shows by a file that it writes
    os.kill(run.pid, number)
    _, err = run.communicate(timeout=60)
    assert run.returncode == app.SIGNAL + number
    told = f"l2m: stopped by {number.name}; results that were not complete are not written\n"
    assert err == told
    assert sorted(each.name for each in tmp_path.iterdir()) == ["ready"]
