"""What a study is: cells that are computed anywhere, and what is made of all of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from matplotlib.figure import Figure

from l2m_gtsam.options import Options

Opts = TypeVar("Opts", bound=Options)
Cell = TypeVar("Cell")
Summary = TypeVar("Summary")


@dataclass(frozen=True)
class Study(Generic[Opts, Cell, Summary]):
    """One study: its parts, each a function of what the last one made.

    Cells and summary are dataclasses of plain values (numbers, text, None, tuples, options), for
    they go through JSON: figures and page are made of what was read back.

    Attributes
    ----------
    name
        Of its files.
    title
        Of its page.
    options
        Its options model.
    size
        Names of the options that only say how many cells there are: cells are kept when these
        change.
    cell, summary
        Their classes.
    keys
        The cells, from the options: file names.
    site
        Where a cell is computed, by name: what several cells share.
    prepare
        That place from its name.
    compute
        A cell from options, key and place alone, so that it may be computed in any order and
        anywhere.
    summarise
        The summary of all cells by key.
    page
        Markdown from the summary.
    figures
        Pictures from the summary, by name.
    """

    name: str
    title: str
    options: type[Opts]
    size: frozenset[str]
    cell: type[Cell]
    summary: type[Summary]
    keys: Callable[[Opts], tuple[str, ...]]
    site: Callable[[Opts, str], str]
    prepare: Callable[[Opts, str], Any]
    compute: Callable[[Opts, str, Any], Cell]
    summarise: Callable[[Opts, Mapping[str, Cell]], Summary]
    page: Callable[[Summary], str]
    figures: Callable[[Summary], Mapping[str, Figure]]
