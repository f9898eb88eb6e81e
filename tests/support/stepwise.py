"""Work that is done in pieces, done at once."""

from collections.abc import Generator
from typing import TypeVar

Found = TypeVar("Found")


def completed(work: Generator[None, None, Found]) -> tuple[Found, int]:
    """Return what work finds, and how often it paused."""
    pauses = 0
    while True:
        try:
            next(work)
        except StopIteration as end:
            found: Found = end.value
            return found, pauses
        pauses += 1
