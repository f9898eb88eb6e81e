"""Progress of long work, reported to whoever asked for it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, float], None]
"""Called with the name of a stage and the fraction of it that is done, 0 to 1."""

Count = Callable[[int, int], None]
"""Called with a number of pieces done and the number of all."""


def silent(_stage: str, _fraction: float) -> None:
    """Report nothing."""


def counter(stage: str, progress: Progress) -> Count:
    """Return what reports counts as the fraction of a stage."""
    return lambda done, total: progress(stage, done / max(total, 1))


@contextmanager
def reported(stage: str, progress: Progress) -> Iterator[None]:
    """Report that a stage begins and, when the block ends well, that it is done."""
    progress(stage, 0.0)
    yield
    progress(stage, 1.0)
