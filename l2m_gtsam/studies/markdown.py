"""Tables of Markdown."""

from collections.abc import Iterable, Sequence


def table_lines(head: str, rows: Iterable[Sequence[str]]) -> str:
    """Return a table from its head, with its bars, and the cells of its rows."""
    rule = "|---" * (head.count("|") - 1) + "|"
    return "\n".join([head, rule, *(f"| {' | '.join(cells)} |" for cells in rows)])
