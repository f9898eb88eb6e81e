"""The paper's Table I: ``l2m study table1``."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from l2m_gtsam.studies.study import Study
from l2m_gtsam.studies.table1.cells import (
    SurveyedWarehouse,
    Table1Cell,
    Table1Options,
    compute,
    prepare,
)
from l2m_gtsam.studies.table1.methods import HARMONIC, OURS
from l2m_gtsam.studies.table1.summary import (
    METRICS,
    MethodErrors,
    Table1Summary,
    printed,
    summarise,
)

EFFICIENT = 1.3  # our error of t is to be at most so many times the bound
# Blue, green, orange, purple, black: apart for all colour vision.
COLOURS = ("#0072b2", "#009e73", "#e69f00", "#cc79a7", "#000000")
BESIDE = 0.14  # of a method's row: its paths are drawn below each other


class Table1Study(Study[Table1Options, Table1Cell, Table1Summary]):
    """Errors beside the paper's; a cell is one drive."""

    name = "table1"
    title = "The paper's Table I"
    size = frozenset({"distortions"})

    def keys(self, options: Table1Options) -> tuple[str, ...]:
        """Return a cell for each drive: noise level, path, number."""
        sizes = (len(options.noises), len(options.paths), options.distortions)
        return tuple("-".join(f"{i:02d}" for i in each) for each in product(*map(range, sizes)))

    def prepare(self, options: Table1Options, site: str) -> SurveyedWarehouse:
        """Return the warehouse and its maps."""
        return prepare(options)

    def compute(self, options: Table1Options, key: str, shared: SurveyedWarehouse) -> Table1Cell:
        """Calibrate the sensor of one drive."""
        level, row, number = map(int, key.split("-"))
        return compute(options, shared, level, row, number)

    def summarise(self, options: Table1Options, cells: Mapping[str, Table1Cell]) -> Table1Summary:
        """Return the errors of all methods, and the bounds."""
        return summarise(options, cells)

    def page_context(self, summary: Table1Summary) -> dict[str, Any]:
        """Return our own entries, and the paper's table."""
        ours = [e for e in summary.entries if (e.method, e.map_kind) == (OURS, HARMONIC)]
        return {
            "ours": ours,
            "entry": partial(summary.entry, method=OURS, map_kind=HARMONIC),
            "worst": max(each.t.max for each in ours if each.t is not None),
            "printed": printed,
            "metrics": METRICS,
            "efficient": EFFICIENT,
        }

    def figures(self, summary: Table1Summary) -> dict[str, Figure]:
        """Draw the errors of t by method, a panel for each noise level."""
        noises = summary.options.noises
        placed = [each for each in summary.entries if each.t is not None]
        kinds = list(dict.fromkeys((each.method, each.map_kind) for each in placed))
        size = (2.5 + 3.2 * len(noises), 0.5 * len(kinds) + 1.8)
        figure = Figure(figsize=size, layout="constrained", dpi=130)
        panels = figure.subplots(1, len(noises), sharex=True, sharey=True, squeeze=False)[0]
        for axes, noise in zip(panels, noises, strict=True):
            for row, kind in enumerate(kinds):
                own = [each for each in summary.entries if (each.method, each.map_kind) == kind]
                draw_method(axes, row, [each for each in own if each.noise == noise])
            bound = 1e3 * next(each.bound for each in summary.efficiency if each.noise == noise)
            axes.axvline(bound, color="0.4", linewidth=1, linestyle=":", label="bound (rms)")
            axes.set(title=f"noise {noise:g} uT", xscale="log", xlabel="error of t (mm)")
            axes.grid(axis="x", alpha=0.3)
        panels[0].set_yticks(range(len(kinds)), [f"{method}\n{kind}" for method, kind in kinds])
        panels[0].invert_yaxis()
        handles, labels = panels[0].get_legend_handles_labels()
        named = dict(zip(labels, handles, strict=True))
        figure.legend(
            named.values(), named.keys(), loc="outside lower center", ncols=3, frameon=False
        )
        return {"table1": figure}


def draw_method(axes: Axes, row: int, entries: Sequence[MethodErrors]) -> None:
    """Draw median, 95 % and largest error of one method, a line for each path."""
    for index, entry in enumerate(entries):
        if entry.t is None:
            continue
        y = row + BESIDE * (index - (len(entries) - 1) / 2)
        colour = COLOURS[index % len(COLOURS)]
        ends = 1e3 * np.array([entry.t.median, entry.t.p95, entry.t.max])
        axes.plot(ends[:2], [y, y], color=colour, linewidth=2, label=str(entry.path))
        axes.plot(ends[0], y, "o", color=colour, markersize=4)
        axes.plot(ends[2], y, "|", color=colour, markersize=5)


TABLE1 = Table1Study()
