"""How long work tells how far it is."""

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with the name of a stage and the fraction of it that is done."""


def counter(stage: str, progress: Progress) -> Callable[[int, int], None]:
    """Return what is called with a number done and the number of all, to tell it as a stage."""
    return lambda done, total: progress(stage, done / max(total, 1))
