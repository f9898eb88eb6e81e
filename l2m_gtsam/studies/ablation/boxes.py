"""The ablation study's errors as box plots, as in the paper."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from l2m_gtsam.studies.ablation.cells import Solver
from l2m_gtsam.studies.ablation.table import AblationTable, Combination, Spread
from l2m_gtsam.studies.ablation.words import density_label, kind_label

# Okabe and Ito's colours differ for all kinds of colour vision.
COLOURS = {
    Solver.OLS: "#999999",
    Solver.RRTLS: "#e69f00",
    Solver.PAPER: "#56b4e9",
    Solver.LIKELIHOOD: "#009e73",
    Solver.ONE_KEY: "#0072b2",
}
ERRORS = (("t", 100.0, "error of t (cm)"), ("C", 1.0, "error of C"), ("H", 1.0, "error of H (uT)"))
"""Attribute, scale and label of each row of the figure."""
PITCH, WIDTH = 0.16, 0.12  # of boxes, where groups are 1 apart


def box_figure(table: AblationTable) -> Figure:
    """Draw the errors: rows of the figure are t, C and H, columns densities."""
    spacings = table.options.spacings
    figure = Figure(figsize=(3.6 * len(spacings) + 0.6, 8.2), layout="constrained", dpi=150)
    grid = figure.subplots(3, len(spacings), sharex=True, sharey="row", squeeze=False)
    for row, (name, scale, label) in zip(grid, ERRORS, strict=True):
        for axes, spacing in zip(row, spacings, strict=True):
            combinations = [each for each in table.rows if each.spacing == spacing]
            draw_boxes(axes, combinations, table.options.kinds, name, scale)
            axes.tick_params(labelleft=axes is row[0])
        row[0].set_ylabel(label)
    for axes, spacing in zip(grid[0], spacings, strict=True):
        axes.set_title(density_label(table, spacing), fontsize=10)
    handles = [Patch(facecolor=COLOURS[solver], label=solver.value) for solver in Solver]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    return figure


def draw_boxes(
    axes: Axes, combinations: list[Combination], kinds: tuple[str, ...], name: str, scale: float
) -> None:
    """Draw the boxes of one kind of error at one density, grouped by the kind of map."""
    for each in combinations:
        spread: Spread | None = getattr(each, name)
        if spread is None:
            continue
        place = list(Solver).index(each.solver) - (len(Solver) - 1) / 2
        at = kinds.index(each.kind) + PITCH * place
        draw_box(axes, at, box(spread, scale), COLOURS[each.solver])
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(LogLocator(subs=tuple(np.arange(1.0, 10.0))))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xticks(range(len(kinds)), [kind_label(kind) for kind in kinds])
    axes.set_xlim(-0.55, len(kinds) - 0.45)
    axes.grid(axis="y", alpha=0.3)
    axes.tick_params(axis="x", length=0)


def draw_box(axes: Axes, at: float, stats: dict[str, float], colour: str) -> None:
    """Draw one box at a place along x."""
    line = {"color": "0.2", "linewidth": 0.8}
    axes.bxp(
        [stats],
        positions=[at],
        widths=WIDTH,
        showfliers=False,
        showmeans=True,
        patch_artist=True,
        boxprops={"facecolor": colour, "edgecolor": "0.2", "linewidth": 0.8},
        medianprops={"color": "black", "linewidth": 1.4},
        meanprops={"marker": "D", "markersize": 3, "markerfacecolor": "white"}
        | {"markeredgecolor": "black", "markeredgewidth": 0.7},
        whiskerprops=line,
        capprops=line,
    )


def box(spread: Spread, scale: float) -> dict[str, Any]:
    """Return a box for ``Axes.bxp``: quartiles, whiskers at 5 and 95 %, and the mean."""
    names = {"whislo": "p05", "q1": "p25", "med": "median", "q3": "p75", "whishi": "p95"}
    stats = {key: scale * getattr(spread, name) for key, name in names.items()}
    return stats | {"mean": scale * spread.mean}
