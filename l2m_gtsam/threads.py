"""Independent pieces of linear algebra, which leaves Python alone while it computes."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from os import cpu_count, environ
from typing import TypeVar

from threadpoolctl import ThreadpoolController

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
    pieces = list(items)
    threads = min(int(environ.get(THREADS) or cpu_count() or 1), MOST_THREADS, len(pieces))
    with _libraries().limit(limits=1, user_api="blas"):
        if threads <= 1:
            return [work(piece) for piece in pieces]
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(work, pieces))


@lru_cache(maxsize=1)
def _libraries() -> ThreadpoolController:
    """Return the BLAS libraries of this process: looking for them takes longer than a task."""
    return ThreadpoolController()
