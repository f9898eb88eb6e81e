"""Errors that readings of a survey share: those of some readings and of others after them."""

from typing import Protocol, Self, TypeVar


class ReadingErrors(Protocol):
    """Errors of readings that are known by their numbers."""

    def followed_by(self, other: Self, first: int) -> Self:
        """Return them with those of other readings, the first of which has this number."""

    def from_reading(self, first: int) -> Self:
        """Return the same of readings that begin with this number."""


Errors = TypeVar("Errors", bound=ReadingErrors)


def errors_together(before: Errors | None, after: Errors | None, first: int) -> Errors | None:
    """Return the errors of readings and of others after them; see ``ReadingErrors.followed_by``.

    Absent are those of what counts as exact.
    """
    if after is None:
        return before
    return after.from_reading(first) if before is None else before.followed_by(after, first)
