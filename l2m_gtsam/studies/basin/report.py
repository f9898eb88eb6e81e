"""The basin study as a table in Markdown and as the paper's figure."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray
from l2m_gtsam.studies.basin.cells import BasinOptions, BasinTable, RingRow
from l2m_gtsam.studies.share import Share

# Blue and vermilion differ for all kinds of colour vision.
ONE_KEY, LM = {"color": "#0072b2"}, {"color": "#d55e00"}
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
        f"for the sensor within {options.search.search_radius:g} m of it. *LM* is "
        "Levenberg-Marquardt over t, C and H from there."
    )
    picture = "![Success rates over the initial offset](basin.png)"
    return f"{intro}\n\n{picture}\n\n{basin_markdown(table)}"


def basin_markdown(table: BasinTable) -> str:
    """Return the table of a study with 95 % intervals, and under it what was counted."""
    small, medium = sizes(table.options)
    head = (
        f"| initial offset (m) | starts | one-key within {small} | within {medium} | LM starts "
        f"| LM within {small} | within {medium} | ambiguous | wrong, not ambiguous |"
    )
    rows = [table_line(row) for row in table.rows]
    return "\n".join([head, "|---" * 9 + "|", *rows, "", sensors(table), "", note(table)])


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
        f"Both methods calibrate from the same starts, LM from the first {table.options.lm_starts} "
        "of each distortion and ring, with "
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
    shares = (row.one_key_small, row.one_key_medium, row.lm_small, row.lm_medium)
    cells = [
        f"{row.inner:.2f}-{row.outer:.2f}",
        f"{row.one_key_small.trials:,}",
        *(said(share) for share in shares[:2]),
        f"{row.lm_small.trials:,}",
        *(said(share) for share in shares[2:]),
        str(row.ambiguous),
        str(row.unwarned),
    ]
    return f"| {' | '.join(cells)} |"


def said(share: Share) -> str:
    """Return a share in per cent with its interval."""
    low, high = share.interval
    return f"{100 * share.rate:.2f} % ({100 * low:.2f}-{100 * high:.2f})"


def basin_figure(table: BasinTable) -> Figure:
    """Draw success rates against the initial offset: two methods, two thresholds."""
    figure = Figure(figsize=(7, 4.2), layout="constrained", dpi=150)
    axes = figure.add_subplot()
    small, medium = sizes(table.options)
    rows = table.rows
    offset = np.array([(row.inner + row.outer) / 2 for row in rows])
    left, right = offset - ASIDE * table.options.width, offset + ASIDE * table.options.width
    for name, style, at, shares in (
        (f"LM, within {medium}", LM | WIDE, right, [row.lm_medium for row in rows]),
        (f"LM, within {small}", LM | NEAR, right, [row.lm_small for row in rows]),
        (f"one-key, within {medium}", ONE_KEY | WIDE, left, [row.one_key_medium for row in rows]),
        (f"one-key, within {small}", ONE_KEY | NEAR, left, [row.one_key_small for row in rows]),
    ):
        draw_rates(axes, at, shares, label=f"{name} ({trials(shares)} starts a ring)", **style)
    axes.set(xlabel="initial offset (m)", ylabel="success rate (%)", ylim=(-3, 103))
    axes.set_xlim(0, max(row.outer for row in rows))
    axes.grid(alpha=0.3)
    axes.legend(loc="lower left")
    return figure


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
