"""The honesty study: ``l2m study honesty``."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from scipy.stats import norm

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.studies.honesty.cells import HonestyCell, cell_of
from l2m_gtsam.studies.honesty.drives import Condition, HonestyOptions, MappedHall, mapped_hall
from l2m_gtsam.studies.honesty.summary import (
    EDGES,
    GROUPS,
    NAMES,
    TARGET,
    ConsistencyVerdict,
    Histogram,
    HonestySummary,
    honesty_summary,
    settings,
)
from l2m_gtsam.studies.statistics import LEVEL, in_percent
from l2m_gtsam.studies.study import Study

UNITS = {
    "t": (1e3, "t (mm)"),
    "C": (1.0, "C"),
    "H": (1.0, "H (uT)"),
    "offset": (1e3, "offset (ms)"),
}
"""Factor from SI and uT, and name with unit, of the parameters as tables show them."""
# These differ for all kinds of colour vision.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
ASIDE = 0.14  # side by side where both have one value
STYLES = {
    Uncertainty.FULL: ("#0072b2", "o", -ASIDE),
    Uncertainty.INDEPENDENT: ("#d55e00", "s", ASIDE),
}
TICKS = (1, 1.25, 1.6, 2, 2.5, 3.2, 4, 5, 6.3, 8)  # of a decade
MARKERS = ("o", "s", "D", "^")
GREY = "#777777"


class HonestyStudy(Study[HonestyOptions, HonestyCell, HonestySummary]):
    """Consistency of stated covariances; a cell is one survey under one condition."""

    name = "honesty"
    title = "Are the stated errors true?"
    size = frozenset({"surveys", "noises", "troubled_noises"})

    def keys(self, options: HonestyOptions) -> tuple[str, ...]:
        """Return a cell for each noise, survey and condition, those of one survey together."""
        wanted = settings(options)
        return tuple(
            f"{noise!r}-uT-survey-{number:03d}-{condition}"
            for noise in sorted({noise for _, noise in wanted})
            for number in range(options.surveys)
            for condition in Condition
            if (condition, noise) in wanted
        )

    def site(self, options: HonestyOptions, key: str) -> str:
        """Return noise and survey: both conditions have the same map."""
        return key.rpartition("-")[0]

    def prepare(self, options: HonestyOptions, site: str) -> MappedHall:
        """Return a hall with its map."""
        noise, _, number = site.partition("-uT-survey-")
        return mapped_hall(options, float(noise), int(number))

    def compute(self, options: HonestyOptions, key: str, shared: MappedHall) -> HonestyCell:
        """Calibrate on all drives through a hall."""
        return cell_of(options, shared, Condition(key.rpartition("-")[2]))

    def summarise(
        self, options: HonestyOptions, cells: Mapping[str, HonestyCell]
    ) -> HonestySummary:
        """Return the verdicts on all conditions."""
        return honesty_summary(options, list(cells.values()))

    def page_context(self, summary: HonestySummary) -> dict[str, Any]:
        """Return the verdicts with the map's full errors, and NEES ratios of t without them."""
        full = summary.of(Uncertainty.FULL)
        rows = [row for verdict in full for row in verdict.parameters]
        first = [row for v in summary.of(Uncertainty.INDEPENDENT) for row in v.blocks[:1]]
        return {
            "full": full,
            "rows": rows,
            "names": list(dict.fromkeys(row.name for row in rows)),
            "neglected": [row.honesty.nees / row.honesty.dof for row in first],
            "target": TARGET,
            "level": LEVEL,
            "units": UNITS,
        }

    def figures(self, summary: HonestySummary) -> dict[str, Figure]:
        """Draw NEES, coverage and z-scores."""
        full = summary.of(Uncertainty.FULL)
        return {
            "nees": nees_figure(summary),
            "coverage": coverage_figure(full),
            "zscores": score_figure(full),
        }


def setting(verdict: ConsistencyVerdict) -> str:
    """Return condition and noise."""
    return f"{verdict.condition}, {verdict.noise:g} uT"


def nees_figure(summary: HonestySummary) -> Figure:
    """Draw the NEES of all blocks over what is expected of them, with their bands."""
    full = summary.of(Uncertainty.FULL)
    figure = Figure(figsize=(8.0, 3.6), layout="constrained", dpi=150)
    widths = [max(len(verdict.blocks), 1) for verdict in full]
    panels = figure.subplots(1, len(full), sharey=True, squeeze=False, width_ratios=widths)[0]
    for axes, verdict in zip(panels, full, strict=True):
        axes.set_title(setting(verdict), fontsize=10)
        axes.axhline(1.0, color=GREY, linewidth=0.8)
        axes.grid(axis="y", alpha=0.25)
        names = [row.name for row in verdict.blocks]
        axes.set_xticks(range(len(names)), names)
        axes.set_xlim(-0.6, max(len(names), 1) - 0.4)
        for each in summary.verdicts:
            if setting(each) == setting(verdict):
                draw_nees(axes, each)
    panels[0].set_yscale("log")
    panels[0].yaxis.set_major_locator(LogLocator(10, TICKS))
    panels[0].yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panels[0].yaxis.set_minor_locator(NullLocator())
    panels[0].set_ylabel("mean NEES / its expectation")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    return figure


def draw_nees(axes: Axes, verdict: ConsistencyVerdict) -> None:
    """Draw the NEES of one way to count the map's errors; the band of the full one."""
    each = [row.honesty for row in verdict.blocks]
    at, dof = np.arange(len(each), dtype=np.float64), np.array([h.dof for h in each])
    if verdict.uncertainty is Uncertainty.FULL:
        low = np.array([h.band.low for h in each]) / dof
        high = np.array([h.band.high for h in each]) / dof
        axes.bar(at, high - low, 0.7, low, color="#0072b2", alpha=0.22, label="95 % band (full)")
    values = np.array([h.nees for h in each]) / dof
    colour, marker, aside = STYLES[verdict.uncertainty]
    axes.plot(at + aside, values, marker, color=colour, label=f"{verdict.uncertainty}")


def coverage_figure(verdicts: Sequence[ConsistencyVerdict]) -> Figure:
    """Draw the share of 95 % intervals that hold the truth, parameter by parameter."""
    figure = Figure(figsize=(8.0, 3.8), layout="constrained", dpi=150)
    axes = figure.add_subplot()
    axes.axhline(100 * LEVEL, color=GREY, linewidth=0.8)
    shown = [
        name for name in NAMES if any(name == row.name for v in verdicts for row in v.parameters)
    ]
    aside = np.linspace(-0.27, 0.27, len(verdicts)) if len(verdicts) > 1 else np.zeros(1)
    for number, (verdict, shift) in enumerate(zip(verdicts, aside, strict=True)):
        at = np.array([shown.index(row.name) for row in verdict.parameters]) + shift
        draw_coverage(axes, verdict, at, number)
    for place in range(1, len(shown)):
        # Between t, C, H and the offset stronger than within.
        same = shown[place][0] == shown[place - 1][0]
        axes.axvline(place - 0.5, color=GREY, linewidth=0.4 if same else 1.0, alpha=0.5)
    axes.set_xticks(range(len(shown)), shown)
    axes.set_xlim(-0.5, max(len(shown), 1) - 0.5)
    axes.set_ylabel("95 % intervals that hold the truth (%)")
    axes.grid(axis="y", alpha=0.25)
    figure.legend(loc="outside lower center", ncols=4, fontsize=9)
    return figure


def draw_coverage(axes: Axes, verdict: ConsistencyVerdict, at: FloatArray, number: int) -> None:
    """Draw shares with their intervals at places (N,), in the style of a number."""
    rows = verdict.parameters
    ends = [(row.interval.low, row.interval.high) for row in rows]
    share, reach = in_percent([row.covered for row in rows], ends)
    axes.errorbar(
        at,
        share,
        reach,
        fmt=MARKERS[number % len(MARKERS)],
        color=COLOURS[number % len(COLOURS)],
        markersize=3.5,
        linewidth=1,
        label=setting(verdict),
    )


def score_figure(verdicts: Sequence[ConsistencyVerdict]) -> Figure:
    """Draw histograms of z-scores beside the normal distribution: a row for each condition."""
    groups = [g for g in GROUPS if any(g == h.name for v in verdicts for h in v.histograms)]
    size = (2.1 * max(len(groups), 1) + 0.8, 1.25 * len(verdicts) + 0.7)
    figure = Figure(figsize=size, layout="constrained", dpi=150)
    panels = figure.subplots(
        len(verdicts), max(len(groups), 1), sharex=True, sharey=True, squeeze=False
    )
    for verdict, row in zip(verdicts, panels, strict=True):
        row[0].set_ylabel(setting(verdict).replace(", ", ",\n"), fontsize=9)
        found = {each.name: each for each in verdict.histograms}
        for name, axes in zip(groups, row, strict=False):
            axes.set_yticks([])
            if name in found:
                draw_scores(axes, found[name])
            else:
                style = {"ha": "center", "va": "center", "color": GREY, "fontsize": 8}
                axes.text(0.5, 0.5, "not estimated", transform=axes.transAxes, **style)
    for name, axes in zip(groups, panels[0], strict=False):
        axes.set_title(name, fontsize=10)
    figure.supxlabel("z: error / stated sigma", fontsize=10)
    return figure


def draw_scores(axes: Axes, each: Histogram) -> None:
    """Draw one histogram with the normal density."""
    counts = np.array(each.counts, dtype=np.float64)
    density = counts / counts.sum() / np.diff(EDGES)
    axes.stairs(density, EDGES, fill=True, color="#0072b2", alpha=0.45)
    z = np.linspace(EDGES[0], EDGES[-1], 161)
    axes.plot(z, norm.pdf(z), color="black", linewidth=1)
    axes.set_xticks([-4, -2, 0, 2, 4])


HONESTY = HonestyStudy()
