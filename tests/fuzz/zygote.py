"""A process that imports all commands and does nothing else, from which commands are forked.

What a test process has used before, such as a pool of threads that reads compressed clouds, does
not outlive a fork: a child that waits for it waits for ever. The caller adopts the commands: as a
subreaper (``PR_SET_CHILD_SUBREAPER``, Linux) it is the parent of those whose own has ended, and may
wait for them.
"""

import atexit
import contextlib
import ctypes
import importlib
import json
import os
import pkgutil
import resource
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from l2m_gtsam.cli import app
from tests.fuzz.readers import READERS
from tests.support.repository import REPOSITORY

SUBREAPER = 36  # of prctl
MORE_ADDRESSES = 6 << 30  # keeps the machine from harm when a case takes all memory


@dataclass(frozen=True)
class Request:
    """A command to be started.

    Attributes
    ----------
    words
        Of the command, or ``read`` and the name of a reader.
    folder
        Where it works.
    log
        What it prints.
    most_s
        Seconds of a core that it may take.
    environment
        Variables.
    """

    words: Sequence[str]
    folder: str
    log: str
    most_s: int
    environment: dict[str, str]


@dataclass(frozen=True)
class Started:
    """Number of a command's process, and bytes of memory that it was forked with."""

    number: int
    inherited: int


class Zygote:
    """The caller's side of it."""

    def __init__(self) -> None:
        ctypes.CDLL(None).prctl(SUBREAPER, 1, 0, 0, 0)
        paths = [str(REPOSITORY), str(REPOSITORY / "factors"), os.environ.get("PYTHONPATH", "")]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.zygote"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=REPOSITORY,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))},
        )
        atexit.register(self._process.communicate)

    def start(self, request: Request) -> Started:
        """Start a command whose parent is the caller."""
        asked, answers = self._process.stdin, self._process.stdout
        assert asked is not None
        assert answers is not None
        asked.write(json.dumps(asdict(request)) + "\n")
        asked.flush()
        return Started(**json.loads(answers.readline()))


@cache
def zygote() -> Zygote:
    """Return that of this process."""
    return Zygote()


def main() -> None:
    """Start what is asked for, line by line."""
    _import_commands()
    for line in sys.stdin:
        started = Started(_forked(Request(**json.loads(line))), _heap_bytes())
        print(json.dumps(asdict(started)), flush=True)


def _import_commands() -> None:
    """Import what commands import when they run, once for all cases."""
    for package in ("batch", "cli.tables", "calibration", "mapping", "slam", "validation"):
        name = f"l2m_gtsam.{package}"
        for module in pkgutil.walk_packages(importlib.import_module(name).__path__, f"{name}."):
            importlib.import_module(module.name)


def _heap_bytes() -> int:
    """Return the resident memory of this process without mapped files."""
    resident, shared = Path("/proc/self/statm").read_text().split()[1:3]
    return (int(resident) - int(shared)) * resource.getpagesize()


def _forked(request: Request) -> int:
    """Return the number of a command's process, the parent of which has ended."""
    here, there = os.pipe()
    between = os.fork()
    if between == 0:
        number = os.fork()
        if number == 0:
            _child(request)
        os.write(there, str(number).encode())
        os._exit(0)
    os.waitpid(between, 0)
    number = int(os.read(here, 32))
    for each in (here, there):
        os.close(each)
    return number


def _child(request: Request) -> None:
    """Run the command and end the process."""
    try:
        os.environ.clear()
        os.environ.update(request.environment)
        os.chdir(request.folder)
        handle = os.open(request.log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for each in (1, 2):
            os.dup2(handle, each)
        sys.stdin, sys.stdout, sys.stderr = (
            os.fdopen(each, mode, closefd=False) for each, mode in enumerate("rww")
        )
        with contextlib.suppress(ValueError, OSError):
            own = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (own + MORE_ADDRESSES,) * 2)
        resource.setrlimit(resource.RLIMIT_CPU, (request.most_s + 5, request.most_s + 6))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if request.words[0] == "read":
            _replace_command(READERS[request.words[1]], Path(request.words[2]))
        sys.argv = ["l2m", *request.words]
        app.main()
    except SystemExit as end:
        _leave(end.code if isinstance(end.code, int) else 0)
    except BaseException:  # what `main` lets through is what is looked for
        traceback.print_exc()
        _leave(99)
    _leave(0)


def _replace_command(read: Callable[[Path], object], path: Path) -> None:
    def command(*_: object, **__: object) -> None:
        read(path)

    # Errors end as those of a command do; the process ends with it.
    app.app = command  # type: ignore[assignment]  # called as Typer's object is


def _leave(code: int) -> None:
    for each in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            each.flush()
    os._exit(code)


if __name__ == "__main__":
    main()
