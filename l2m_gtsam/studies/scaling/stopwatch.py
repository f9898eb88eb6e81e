"""Time and memory that a piece of work takes."""

import gc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import process_time

STATUS, REFERENCES = Path("/proc/self/status"), Path("/proc/self/clear_refs")
FORGET_PEAK = "5"  # see proc(5)
KIB_PER_MIB = 1024


@dataclass(frozen=True)
class Taken:
    """What a piece of work took.

    Attributes
    ----------
    seconds
        Processor time of this process.
    peak_mib
        By how much its memory grew at most, MiB; absent where the system does not tell.
    """

    seconds: float
    peak_mib: float | None


def taken(work: Callable[[], object], rounds: int, long: float) -> Taken:
    """Return the least time of some rounds, and the peak of memory in the first.

    Parameters
    ----------
    work
        What is measured.
    rounds
        How often at most.
    long
        Work that takes so many seconds is not repeated.
    """
    gc.collect()  # what earlier work left would be freed meanwhile, and hide what this takes
    before = _memory("VmRSS") if _forget_peak() else None
    seconds = timed(work)
    after = _memory("VmHWM")
    peak = None if before is None or after is None else max(after - before, 0.0)
    for _ in range(rounds - 1):
        if seconds >= long:
            break
        seconds = min(seconds, timed(work))
    return Taken(seconds, peak)


def timed(work: Callable[[], object]) -> float:
    """Return the processor time of a piece of work in seconds."""
    start = process_time()
    work()
    return process_time() - start


def _forget_peak() -> bool:
    """Start counting the peak of this process' memory anew; return whether that is possible."""
    try:
        REFERENCES.write_text(FORGET_PEAK, encoding="ascii")
    except OSError:
        return False
    return True


def _memory(name: str) -> float | None:
    """Return an entry of this process' status in MiB, if the system has it."""
    try:
        lines = STATUS.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    found = [line for line in lines if line.startswith(f"{name}:")]
    return float(found[0].split()[1]) / KIB_PER_MIB if found else None
