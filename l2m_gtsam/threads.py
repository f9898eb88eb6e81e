"""Independent pieces of linear algebra, which leaves Python alone while it computes."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from os import cpu_count, environ
from typing import TypeVar

from threadpoolctl import threadpool_limits

MOST_THREADS = 8
THREADS = "L2M_THREADS"
"""Environment variable: how many threads a process may use; all cores where it is not set."""

In = TypeVar("In")
Out = TypeVar("Out")


def in_threads(work: Callable[[In], Out], items: Iterable[In]) -> list[Out]:
    """Return the results in the order of the items.

    Each piece is too small for threads of its own in BLAS, which would only wait for each other:
    with them a warehouse took three times as long.
    """
    threads = min(int(environ.get(THREADS) or cpu_count() or 1), MOST_THREADS)
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))
