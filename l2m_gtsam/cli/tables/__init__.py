"""Results as tables and lines in the terminal."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich import box
from rich.table import Table

from l2m_gtsam.data import FloatArray
from l2m_gtsam.text import entries_by_sigma, sigma_entries

TEXT_WIDTH = 18  # the least of a column of text that breaks where it must
OPEN = "-"  # what is not determined
COLOURS = {"pass": "green", "warn": "yellow", "fail": "red"}


def new_table(
    title: str, names: Sequence[str], numbers: Sequence[str], caption: str | None = None
) -> Table:
    """Return an empty table: columns of names, then columns of numbers.

    The most important ones come first: a narrow terminal shows those that fit.
    """
    table = plain_table(title, caption)
    for heading in names:
        table.add_column(heading, no_wrap=True)
    add_numbers(table, numbers)
    return table


def plain_table(title: str, caption: str | None = None) -> Table:
    """Return a table without columns; lines are only below the headings."""
    return Table(
        title=title,
        title_justify="left",
        caption=caption,
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )


def add_numbers(table: Table, headings: Sequence[str]) -> None:
    """Add columns of numbers, which do not wrap."""
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)


def add_text(table: Table, heading: str, width: int = TEXT_WIDTH) -> None:
    """Add a column of text, of this width at least."""
    table.add_column(heading, overflow="fold", min_width=width)


def vector_cell(values: FloatArray, sigmas: FloatArray, width: int = 0) -> str:
    """Return a vector by its standard deviations; a dash for what is not determined."""
    known = np.isfinite(values) & np.isfinite(sigmas)
    texts = entries_by_sigma(values.tolist(), sigmas.tolist())
    each = (text if is_known else OPEN for text, is_known in zip(texts, known, strict=True))
    return " ".join(f"{text:>{width}}" for text in each)


def sigmas_cell(sigmas: FloatArray) -> str:
    """Return standard deviations; a dash for what is not determined."""
    texts = sigma_entries(sigmas.tolist())
    known = np.isfinite(sigmas)
    return " ".join(text if is_known else OPEN for text, is_known in zip(texts, known, strict=True))


def held_note(reasons: Mapping[str, str]) -> str:
    """Return of which sensors time offsets are held, and why the first is; else nothing."""
    if not reasons:
        return ""
    first, reason = next(iter(reasons.items()))
    more = f" and {len(reasons) - 1} more" if len(reasons) > 1 else ""
    return f"time offset of {first}{more} {reason}"


def coloured(level: str) -> str:
    """Return a verdict's level as rich prints it."""
    return f"[bold {COLOURS[level]}]{level.upper()}[/]"
