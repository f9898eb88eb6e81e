"""Work that is done in pieces, done at once."""

from collections.abc import Generator
from typing import TypeVar

from l2m_gtsam import progress

Found = TypeVar("Found")


def completed(work: Generator[None, None, Found]) -> tuple[Found, int]:
    """Return what work finds, and how often it paused."""
    pauses: list[None] = []
    found = progress.completed(work, pauses.append)
    return found, len(pauses)
