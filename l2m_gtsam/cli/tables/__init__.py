"""Results as tables and lines in the terminal."""

from collections.abc import Sequence

from rich.table import Table


def new_table(title: str, first: str, numbers: Sequence[str], caption: str | None = None) -> Table:
    """Return an empty table: a column of names, then columns of numbers."""
    table = Table(title=title, title_justify="left", caption=caption, caption_justify="left")
    table.add_column(first, no_wrap=True)
    for heading in numbers:
        table.add_column(heading, justify="right", no_wrap=True)
    return table
