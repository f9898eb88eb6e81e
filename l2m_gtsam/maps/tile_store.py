"""What keeps the parts of a map that are costly to make, as a map sees it: a store of arrays."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy.typing as npt

Arrays = Mapping[str, npt.NDArray[Any]]
"""Arrays of float64 or int64 by name."""

Made = TypeVar("Made")


@dataclass(frozen=True)
class Entry:
    """What is kept, and of what.

    Attributes
    ----------
    name
        Of the part of the map; letters, digits, ``-``, ``_`` and ``.``.
    fingerprint
        Of all that it follows from.
    """

    name: str
    fingerprint: str


class TileStore(Protocol):
    """Arrays by entry, from one run to the next.

    Whatever goes wrong with a store is no error: an entry is not found, or is not kept. Threads
    and processes may share one.
    """

    @property
    def takes_more(self) -> bool:
        """Whether what is given to it now is kept."""

    def recall(self, entry: Entry, decode: Callable[[Arrays], Made], /) -> Made | None:
        """Return what an entry decodes to, or None.

        Parameters
        ----------
        entry
            What is asked for; one of this name with another fingerprint is not it.
        decode
            Raises a MapError for arrays that make no sense.
        """

    def keep(self, entry: Entry, arrays: Arrays, /) -> None:
        """Keep an entry in place of the one that has its name."""

    def sweep(self, wanted: Collection[Entry], /) -> None:
        """Remove all entries but these."""


class NoStore:
    """Keeps nothing; see ``TileStore``."""

    takes_more = False

    def recall(self, _entry: Entry, _decode: Callable[[Arrays], Made], /) -> None:
        """Return nothing."""

    def keep(self, _entry: Entry, _arrays: Arrays, /) -> None:
        """Keep nothing."""

    def sweep(self, _wanted: Collection[Entry], /) -> None:
        """Have nothing to remove."""


NO_STORE = NoStore()
