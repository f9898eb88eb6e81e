"""A sentence as the one reason of a rule, at its level."""

from l2m_gtsam.records.verdict import Level, Reason


def note(text: str) -> list[Reason]:
    """Return a note: it passes."""
    return [Reason(Level.PASS, text)]


def warning(text: str) -> list[Reason]:
    """Return a warning."""
    return [Reason(Level.WARN, text)]


def failure(text: str) -> list[Reason]:
    """Return a failure."""
    return [Reason(Level.FAIL, text)]
