"""The basin study as a table in Markdown and as the paper's figure."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray
from l2m_gtsam.studies.basin.cells import BasinOptions, BasinTable, Rates, RingRow
from l2m_gtsam.studies.share import Share

# Blue, green and vermilion differ for all kinds of colour vision.
COLOURS = {"LM": "#d55e00", "published": "#009e73", "one-key": "#0072b2"}
# Where both thresholds have one rate, the small mark stands in the large one.
NEAR = {"fmt": "o-", "markersize": 3.5}
WIDE = {"fmt": "s--", "markersize": 8, "markerfacecolor": "white"}
ASIDE = 0.06  # of a ring's width: the methods' intervals stand side by side


def basin_page(table: BasinTable) -> str:
    """Return the page of a study, but for its title."""
    options = table.options
    intro = (
        f"The paper's protocol: {options.distortions} random sensors, each on its own drive "
        f"through the simulated warehouse, {options.starts} random starts in each ring of "
        f"{options.width:g} m around the true place. *One-key* is told the start alone: it looks "
        f"for the sensor within {options.search.search_radius:g} m of it. "
        "*Published* is the paper's algorithm 1 from there (weights as printed; its intercept and "
        "its Jacobian mended), *LM* Levenberg-Marquardt over t, C and H."
    )
    picture = "![Success rates over the initial offset](basin.png)"
    return f"{intro}\n\n{picture}\n\n{basin_markdown(table)}"


def basin_markdown(table: BasinTable) -> str:
    """Return the table of a study with 95 % intervals, and under it what was counted."""
    small, medium = sizes(table.options)
    each = f"within {small} | within {medium}"
    head = (
        f"| initial offset (m) | starts | one-key {each} | ambiguous | wrong, not ambiguous "
        f"| starts | published {each} | LM {each} |"
    )
    rows = [table_line(row) for row in table.rows]
    return "\n".join([head, "|---" * 11 + "|", *rows, "", sensors(table), "", note(table)])


def sensors(table: BasinTable) -> str:
    """Return how many distortions never failed: trials that are independent."""
    small, medium = sizes(table.options)
    return (
        f"Distortions of which one-key brought every start within {small}: "
        f"{counted(table.all_small)}; within {medium}: {counted(table.all_medium)}."
    )


def counted(share: Share) -> str:
    """Return a share as counts, with its interval."""
    low, high = share.interval
    return f"{share.successes} of {share.trials} ({100 * low:.1f}-{100 * high:.1f} %)"


def note(table: BasinTable) -> str:
    """Return what was counted."""
    small, _ = sizes(table.options)
    return (
        "All methods calibrate from the same starts, published and LM from the first "
        f"{table.options.few_starts} of each distortion and ring, with "
        f"{table.options.site.scenario.noise.field:g} uT of noise. In brackets Wilson's 95 % "
        "intervals, those of starts as if they were independent. They are not: the starts of one "
        "distortion share a drive and the lattice of the search, and differ for one-key in which "
        "nodes lie in the ball around them; more independent is the count of distortions, which "
        "share the site and its map. "
        f"Wrong: not within {small}. Ambiguous: marked so by one-key, right or wrong."
    )


def sizes(options: BasinOptions) -> tuple[str, str]:
    """Return what counts as a small and as a medium error."""
    return f"{100 * options.small:g} cm", f"{100 * options.medium:g} cm"


def table_line(row: RingRow) -> str:
    """Return one ring as a line of Markdown."""
    cells = [
        f"{row.inner:.2f}-{row.outer:.2f}",
        f"{row.one_key.small.trials:,}",
        *both(row.one_key),
        str(row.ambiguous),
        str(row.unwarned),
        f"{row.lm.small.trials:,}",
        *both(row.published),
        *both(row.lm),
    ]
    return f"| {' | '.join(cells)} |"


def both(rates: Rates) -> tuple[str, str]:
    """Return both rates of a method."""
    return said(rates.small), said(rates.medium)


def said(share: Share) -> str:
    """Return a share in per cent with its interval."""
    low, high = share.interval
    return f"{100 * share.rate:.2f} % ({100 * low:.2f}-{100 * high:.2f})"


def basin_figure(table: BasinTable) -> Figure:
    """Draw success rates against the initial offset: three methods, two thresholds."""
    figure = Figure(figsize=(7.5, 4.6), layout="constrained", dpi=150)
    axes = figure.add_subplot()
    small, medium = sizes(table.options)
    offset = np.array([(row.inner + row.outer) / 2 for row in table.rows])
    for place, (name, colour) in enumerate(COLOURS.items()):
        at = offset + ASIDE * table.options.width * (1 - place)
        found = [of_method(row, name) for row in table.rows]
        wide, near = [each.medium for each in found], [each.small for each in found]
        count = trials(near)
        draw_rates(axes, at, wide, label=f"{name}, within {medium}", color=colour, **WIDE)
        told = f"{name}, within {small} ({count} starts a ring)"
        draw_rates(axes, at, near, label=told, color=colour, **NEAR)
    rows = table.rows
    axes.set(xlabel="initial offset (m)", ylabel="success rate (%)", ylim=(-3, 103))
    axes.set_xlim(0, max(row.outer for row in rows))
    axes.grid(alpha=0.3)
    axes.legend(loc="lower left")
    return figure


def of_method(row: RingRow, name: str) -> Rates:
    """Return the rates of a method by the name it has on the page."""
    return {"one-key": row.one_key, "published": row.published, "LM": row.lm}[name]


def trials(shares: Sequence[Share]) -> str:
    """Return how many trials each share is of, or the least and the most."""
    least, most = (end(share.trials for share in shares) for end in (min, max))
    return f"{most:,}" if least == most else f"{least:,} to {most:,}"


def draw_rates(axes: Axes, offset: FloatArray, shares: Sequence[Share], **style: Any) -> None:
    """Draw rates in per cent, with their intervals, at offsets in metres, shape (N,)."""
    rate = 100 * np.array([share.rate for share in shares])
    low, high = 100 * np.array([share.interval for share in shares]).T
    # Rounding may put the end of an interval a hair on the wrong side of the rate.
    reach = np.maximum([rate - low, high - rate], 0.0)
    axes.errorbar(offset, rate, reach, capsize=2.5, linewidth=1.3, **style)
