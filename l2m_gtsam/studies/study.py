"""What a study is: cells that are computed anywhere, a summary of all cells, a page and figures."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, ClassVar, Generic, TypeVar, get_args

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from l2m_gtsam.options import Options

Opts = TypeVar("Opts", bound=Options)
Cell = TypeVar("Cell")
Summary = TypeVar("Summary")

BLOCKS = ("|", "- ", "#", "![")
"""What a line of Markdown starts with that never continues the line above."""


class Study(ABC, Generic[Opts, Cell, Summary]):
    """One study; each method takes what those before it returned.

    Cells and summary are dataclasses of plain values (numbers, text, None, tuples, options), for
    they pass through JSON: page and figures are made from what was read back.

    Attributes
    ----------
    name
        Stem of its files and of its template.
    size
        Names of the options that only set the number of cells: finished cells remain valid when
        these change.
    options, cell, summary
        Classes of options, cells and summary, those in brackets behind ``Study``.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    size: ClassVar[frozenset[str]]
    options: type[Opts]
    cell: type[Cell]
    summary: type[Summary]

    def __init_subclass__(cls) -> None:
        """Take the classes from the brackets behind ``Study``."""
        (study,) = cls.__orig_bases__  # type: ignore[attr-defined]  # public from Python 3.12 on
        cls.options, cls.cell, cls.summary = get_args(study)

    @abstractmethod
    def keys(self, options: Opts) -> tuple[str, ...]:
        """Return the cells: file names without suffix, in the order of the summary."""

    def site(self, options: Opts, key: str) -> str:
        """Return the name of what a cell shares with others; by default all share one site."""
        return "site"

    @abstractmethod
    def prepare(self, options: Opts, site: str) -> Any:
        """Return what the cells of a site share, such as a map."""

    @abstractmethod
    def compute(self, options: Opts, key: str, shared: Any) -> Cell:
        """Return a cell from options, key and site alone, so that order and machine are free."""

    @abstractmethod
    def summarise(self, options: Opts, cells: Mapping[str, Cell]) -> Summary:
        """Return the summary of all cells by key."""

    @abstractmethod
    def figures(self, summary: Summary) -> Mapping[str, Figure]:
        """Return figures by file name without suffix."""

    def page_context(self, summary: Summary) -> dict[str, Any]:
        """Return what the template of the page uses beside the summary."""
        return {}

    def page(self, summary: Summary) -> str:
        """Return the page without title as Markdown, from ``templates/<name>.md.j2``."""
        template = environment().get_template(f"{self.name}.md.j2")
        return unwrapped(template.render(summary=summary, **self.page_context(summary)))


@cache
def environment() -> Environment:
    """Return what templates are rendered with.

    ``x|f(spec)`` formats a number as Python does; ``table(head, rows)`` is a table.
    """
    # Markdown of our own numbers, never HTML.
    made = Environment(  # noqa: S701
        loader=PackageLoader(__package__),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["f"] = format
    made.globals["table"] = table
    return made


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of Markdown from its titles and the cells of its rows."""
    lines = (f"| {' | '.join(cells)} |" for cells in (head, *rows))
    return "\n".join([next(lines), "|---" * len(head) + "|", *lines])


def unwrapped(text: str) -> str:
    """Return Markdown with each paragraph, item and table row on one line.

    Templates break lines for their readers; an indented line continues the one above. Several
    blank lines are one.
    """
    lines: list[str] = []
    for line in text.splitlines():
        new_block = not lines or not lines[-1] or line.startswith(BLOCKS)
        if not line.strip():
            if lines and lines[-1]:
                lines.append("")
        elif new_block:
            lines.append(line.strip())
        else:
            lines[-1] += f" {line.strip()}"
    return "\n".join(lines).strip()
