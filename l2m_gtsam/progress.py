"""Progress of long work, reported to whoever asked for it."""

from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from typing import TypeVar

Progress = Callable[[str, float], None]
"""Called with the name of a stage and the fraction of it that is done, 0 to 1."""

Count = Callable[[int, int], None]
"""Called with a number of pieces done and the number of all."""

Piece = TypeVar("Piece")
Found = TypeVar("Found")


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


def completed(
    work: Generator[Piece, None, Found], after_piece: Callable[[Piece], object] | None = None
) -> Found:
    """Do work that pauses between its pieces to the end, and return what it finds.

    Parameters
    ----------
    work
        The work.
    after_piece
        Called with what is yielded at each pause.
    """
    while True:
        try:
            piece = next(work)
        except StopIteration as end:
            found: Found = end.value
            return found
        if after_piece is not None:
            after_piece(piece)
