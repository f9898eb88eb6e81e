"""The basin study: ``l2m study basin``."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray
from l2m_gtsam.studies.basin.cells import (
    BasinOptions,
    BasinTable,
    DistortionCells,
    basin_table,
    cells_of,
)
from l2m_gtsam.studies.site import Site, mapped_site
from l2m_gtsam.studies.statistics import Share, in_percent
from l2m_gtsam.studies.study import Study

# Blue, green and vermilion differ for all kinds of colour vision.
COLOURS = {"LM": "#d55e00", "published": "#009e73", "one-key": "#0072b2"}
# Where both thresholds have one rate, the small mark is drawn inside the large one.
NEAR = {"fmt": "o-", "markersize": 3.5}
WIDE = {"fmt": "s--", "markersize": 8, "markerfacecolor": "white"}
ASIDE = 0.06  # of a ring's width: the methods' intervals are drawn side by side


class BasinStudy(Study[BasinOptions, DistortionCells, BasinTable]):
    """Success rates over initial offsets; a cell is one distortion with all its starts."""

    name = "basin"
    title = "How far off may a guess be?"
    size = frozenset({"distortions"})

    def keys(self, options: BasinOptions) -> tuple[str, ...]:
        """Return one cell for each distortion."""
        return tuple(f"distortion-{number:03d}" for number in range(options.distortions))

    def prepare(self, options: BasinOptions, site: str) -> Site:
        """Return the mapped warehouse."""
        return mapped_site(options.site)

    def compute(self, options: BasinOptions, key: str, shared: Site) -> DistortionCells:
        """Calibrate one sensor from all its starts."""
        return cells_of(options, shared, int(key.rpartition("-")[2]))

    def summarise(self, options: BasinOptions, cells: Mapping[str, DistortionCells]) -> BasinTable:
        """Return the success rates of all rings."""
        return basin_table(options, [ring for each in cells.values() for ring in each.rings])

    def figures(self, summary: BasinTable) -> dict[str, Figure]:
        """Draw success rates against the initial offset: three methods, two thresholds."""
        figure = Figure(figsize=(7.5, 4.6), layout="constrained", dpi=150)
        axes, rows, options = figure.add_subplot(), summary.rows, summary.options
        offset = np.array([(row.inner + row.outer) / 2 for row in rows])
        for place, (name, colour) in enumerate(COLOURS.items()):
            at = offset + ASIDE * options.width * (1 - place)
            rates = [getattr(row, name.lower().replace("-", "_")) for row in rows]
            wide, near = [each.medium for each in rates], [each.small for each in rates]
            label = f"{name}, within {100 * options.medium:g} cm"
            draw_rates(axes, at, wide, label=label, color=colour, **WIDE)
            label = f"{name}, within {100 * options.small:g} cm ({trials(near)} starts a ring)"
            draw_rates(axes, at, near, label=label, color=colour, **NEAR)
        axes.set(xlabel="initial offset (m)", ylabel="success rate (%)", ylim=(-3, 103))
        axes.set_xlim(0, max(row.outer for row in rows))
        axes.grid(alpha=0.3)
        axes.legend(loc="lower left")
        return {"basin": figure}


def trials(shares: Sequence[Share]) -> str:
    """Return how many trials each share is of, or the least and the most."""
    least, most = (end(share.trials for share in shares) for end in (min, max))
    return f"{most:,}" if least == most else f"{least:,} to {most:,}"


def draw_rates(axes: Axes, offset: FloatArray, shares: Sequence[Share], **style: Any) -> None:
    """Draw rates in per cent, with their intervals, at offsets in metres, shape (N,)."""
    rate, reach = in_percent([each.rate for each in shares], [each.interval for each in shares])
    axes.errorbar(offset, rate, reach, capsize=2.5, linewidth=1.3, **style)


BASIN = BasinStudy()
