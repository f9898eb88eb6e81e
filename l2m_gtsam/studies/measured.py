"""What a piece of work takes: processor time, and the most memory that it adds."""

import ctypes
import gc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Generic, TypeVar

STATUS, REFERENCES = Path("/proc/self/status"), Path("/proc/self/clear_refs")
FORGET_PEAK = "5"  # see proc(5)
KIB_PER_MIB = 1024
Result = TypeVar("Result")
Other = TypeVar("Other")


@dataclass(frozen=True)
class MeasuredWork(Generic[Result]):
    """A piece of work that was done.

    Attributes
    ----------
    result
        What came of it.
    seconds
        Processor time of this process.
    peak_mib
        By how much its memory grew at most, MiB; absent where the system does not report it.
    """

    result: Result
    seconds: float
    peak_mib: float | None

    def of(self, part: Other) -> "MeasuredWork[Other]":
        """Return the same work with another result, such as a part of its own."""
        return MeasuredWork(part, self.seconds, self.peak_mib)


def measured(work: Callable[[], Result]) -> MeasuredWork[Result]:
    """Do a piece of work, and return what it took."""
    _forget_earlier()
    before = _memory("VmRSS") if _forget_peak() else None
    start = process_time()
    result = work()
    seconds = process_time() - start
    after = _memory("VmHWM")
    peak = None if before is None or after is None else max(after - before, 0.0)
    return MeasuredWork(result, seconds, peak)


def _forget_earlier() -> None:
    """Give back what earlier work left: used again, or freed meanwhile, it would hide this work."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc
    if trim is not None:
        trim(0)


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
