"""How much memory work takes."""

import tracemalloc
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")


def with_peak(work: Callable[[], Found]) -> tuple[Found, int]:
    """Return what work finds, and the most bytes that Python held for it at once."""
    tracemalloc.start()
    try:
        return work(), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
