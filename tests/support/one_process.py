"""What a cluster computes, in this process: for tests whose subject is not the cluster."""

from collections.abc import Iterator, Sequence
from typing import TypeVar

from l2m_gtsam.parallel.cluster import ClusterOptions, Work

Key = TypeVar("Key")
Place = TypeVar("Place")
Value = TypeVar("Value")


def computed_here(
    work: Work[Key, Place, Value], keys: Sequence[Key], _: ClusterOptions
) -> Iterator[tuple[Key, Value]]:
    """Yield what `computed` yields, one after the other; each worker takes seconds of imports."""
    prepared = {place: work.prepare(place) for place in dict.fromkeys(map(work.place, keys))}
    for key in keys:
        yield key, work.task(key, prepared[work.place(key)])
