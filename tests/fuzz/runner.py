"""Run a case in a process of its own and say how it ended; what must not happen has a name."""

import contextlib
import importlib
import os
import pkgutil
import resource
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep

from l2m_gtsam.cli import app
from tests.fuzz.readers import READERS

MOST_CPU_S = 20  # of a command that reads
MORE_CPU_S = 60  # of one that computes: sound files take up to 20
MOST_WALL_S = 900  # on a machine that others use, too: who waits takes no seconds of a core
MOST_BYTES = 3 << 29  # 1.5 GiB
MORE_ADDRESSES = 6 << 30  # keeps the machine from harm when a case takes all memory
LOOK_AGAIN_S = 0.002
GOOD = {0: "done", 1: "answer is no", 2: "refused", 3: "verdict is FAIL"}
BAD = ("traceback", "fault", "hang", "memory", "crash", "no line", "left over")


def import_commands() -> None:
    """Import what commands import when they run, once for all cases."""
    for package in ("batch", "cli.tables", "calibration", "mapping", "slam", "validation"):
        name = f"l2m_gtsam.{package}"
        for module in pkgutil.walk_packages(importlib.import_module(name).__path__, f"{name}."):
            importlib.import_module(module.name)


@dataclass(frozen=True)
class Ended:
    """How a case ended: a word of ``GOOD`` or ``BAD``, what it used and what it said.

    ``peak_bytes`` is the memory at its peak beyond the heap that it was forked with: that one is as
    large as what ran in the same process before.
    """

    how: str
    said: str
    cpu_s: float
    peak_bytes: int


def run_case(words: Sequence[str], folder: Path, out: Path, most_s: int = MOST_CPU_S) -> Ended:
    """Run a command in a folder, in a process that ends with it.

    Parameters
    ----------
    words
        Of the command; see ``Sound.commands``.
    folder
        Working folder, with the input.
    out
        What is written begins with this name, if anything is.
    most_s
        Seconds of a core that it may take.
    """
    log, inherited = folder / "said.log", heap_bytes()
    number = start_command(words, folder, log, most_s)
    status, usage, late = _awaited(number)
    said = log.read_text(encoding="utf-8", errors="replace")
    log.unlink()
    cpu_s, peak = usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 - inherited
    how = _judged(status, said, late or cpu_s > most_s, peak)
    if how in GOOD.values() and (left := _left_over(folder, out, status)):
        how, said = "left over", f"{left}\n{said}"
    return Ended(how, said, cpu_s, peak)


def heap_bytes() -> int:
    """Return the resident memory of this process without mapped files."""
    try:
        resident, shared = Path("/proc/self/statm").read_text().split()[1:3]
    except OSError:  # no such file: the heap of a child counts as its own
        return 0
    return (int(resident) - int(shared)) * resource.getpagesize()


def start_command(words: Sequence[str], folder: Path, log: Path, most_s: int) -> int:
    """Start a command as ``run_case`` does, and return the number of its process."""
    number = os.fork()
    if number == 0:
        _child(words, folder, log, most_s)
    return number


def _child(words: Sequence[str], folder: Path, log: Path, most_s: int) -> None:
    """Run the command and end the process."""
    try:
        os.chdir(folder)
        handle = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        for each in (1, 2):
            os.dup2(handle, each)
        sys.stdout = os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", closefd=False)
        with contextlib.suppress(ValueError, OSError):
            own = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (own + MORE_ADDRESSES,) * 2)
        resource.setrlimit(resource.RLIMIT_CPU, (most_s + 5, most_s + 6))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if words[0] == "read":
            _replace_command(READERS[words[1]], Path(words[2]))
        sys.argv = ["l2m", *words]
        app.main()
    except SystemExit as end:
        _leave(end.code if isinstance(end.code, int) else 0)
    except BaseException:  # what `main` lets through is what is looked for
        import traceback

        traceback.print_exc()
        _leave(99)
    _leave(0)


def _replace_command(read: Callable[[Path], object], path: Path) -> None:
    def command(_: list[str]) -> None:
        read(path)

    app.app = command  # type: ignore[assignment]


def _leave(code: int) -> None:
    for each in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            each.flush()
    os._exit(code)


def _awaited(number: int) -> tuple[int, resource.struct_rusage, bool]:
    """Return status and use of a process, and whether it had to be killed."""
    begun, late = monotonic(), False
    while True:
        done, status, usage = os.wait4(number, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), usage, late
        if monotonic() - begun > MOST_WALL_S and not late:
            late = True
            os.kill(number, signal.SIGKILL)
        sleep(LOOK_AGAIN_S)  # `wait4` has no time limit of its own


def _judged(status: int, said: str, late: bool, peak: int) -> str:
    if late or status in (-signal.SIGXCPU, -signal.SIGKILL):
        return "hang"
    if peak > MOST_BYTES or "not enough memory" in said:
        return "memory"
    if "Traceback (most recent call last)" in said or status == 99:
        return "traceback"
    if status < 0:
        return "crash"
    if status not in GOOD:
        return "fault"
    last = said.strip().splitlines()[-1:] or [""]
    if status == 2 and not (last[0].startswith("l2m: ") or "Error" in said or "Usage" in said):
        return "no line"
    return GOOD[status]


def _left_over(folder: Path, out: Path, status: int) -> str:
    """Return what should not be there: hidden files, and results of what failed."""
    found = [each for each in folder.rglob("*") if each.name.startswith(".")]
    if status == 2:
        found += [each for each in folder.iterdir() if each.name.startswith(out.name)]
    return ", ".join(sorted(str(each.relative_to(folder)) for each in found))
