"""Run a case in a process of its own and say how it ended; what must not happen has a name."""

import os
import resource
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep

from tests.fuzz.zygote import Request, Started, zygote

MOST_CPU_S = 20  # of a command that reads
MORE_CPU_S = 60  # of one that computes: sound files take up to 20
MOST_WALL_S = 900  # on a machine that others use, too: who waits takes no seconds of a core
MOST_BYTES = 3 << 29  # 1.5 GiB
LOOK_AGAIN_S = 0.002
GOOD = {0: "done", 1: "answer is no", 2: "refused", 3: "verdict is FAIL"}
BAD = ("traceback", "fault", "hang", "memory", "crash", "no line", "left over")


@dataclass(frozen=True)
class Ended:
    """How a case ended: a word of ``GOOD`` or ``BAD``, what it used and what it said.

    ``peak_bytes`` is the memory at its peak beyond the heap that it was forked with, which
    holds what commands import.
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
    log = folder / "said.log"
    started = _started(words, folder, log, most_s)
    status, usage, late = _awaited(started.number)
    said = log.read_text(encoding="utf-8", errors="replace")
    log.unlink()
    cpu_s, peak = usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 - started.inherited
    how = _judged(status, said, late or cpu_s > most_s, peak)
    if how in GOOD.values() and (left := _left_over(folder, out, status)):
        how, said = "left over", f"{left}\n{said}"
    return Ended(how, said, cpu_s, peak)


def start_command(words: Sequence[str], folder: Path, log: Path, most_s: int) -> int:
    """Start a command as ``run_case`` does, and return the number of its process."""
    return _started(words, folder, log, most_s).number


def _started(words: Sequence[str], folder: Path, log: Path, most_s: int) -> Started:
    return zygote().start(Request(words, str(folder), str(log), most_s, dict(os.environ)))


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
