"""How long work takes."""

import time
import timeit
from collections.abc import Callable


def seconds(
    work: Callable[[], object], repeats: int = 3, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Return the shortest time of several runs; with ``process_time`` that of the processor."""
    return min(timeit.repeat(work, timer=clock, repeat=repeats, number=1))
