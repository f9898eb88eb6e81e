"""Table I as a page: ours beside the paper's, all methods, the bound, and where targets fail."""

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from l2m_gtsam.simulate.route import RouteShape
from l2m_gtsam.studies.table1.methods import HARMONIC, OURS
from l2m_gtsam.studies.table1.paper import Printed, printed
from l2m_gtsam.studies.table1.summary import Bound, Entry, Spread, Table1Summary

BETTER = 10  # our mean of e_t is to be at most the paper's over this
EFFICIENT = 1.3  # our error of t is to be at most so many times the bound
METRICS = {"t": "e_t (m^2)", "C": "e_C", "H": "e_H (uT^2)"}
# Blue, green, orange, purple, black: apart for all colour vision.
COLOURS = ("#0072b2", "#009e73", "#e69f00", "#cc79a7", "#000000")
CAPTION = "Errors of the position by method: median (dot), 95 % (end of line), largest (tick)"
BESIDE = 0.14  # of a method's row: its paths stand under each other


def page(summary: Table1Summary) -> str:
    """Return the page but for its title."""
    parts = [
        intro(summary),
        "## Beside the paper",
        paper_table(summary),
        *misses(summary),
        "## All methods",
        f"![{CAPTION}](table1.png)",
        "\n\n".join(method_table(summary, noise) for noise in summary.options.noises),
        notes(),
        "## What any method could do at best",
        bound_table(summary),
        *(efficiency_lines(summary)),
    ]
    return "\n\n".join(parts)


def intro(summary: Table1Summary) -> str:
    """Return what was done."""
    options = summary.options
    ours = [each for each in summary.entries if (each.method, each.map_kind) == (OURS, HARMONIC)]
    count = sum(each.calibrations for each in ours)
    return (
        f"{len(options.paths)} paths through the simulated warehouse, "
        f"{len(options.noises)} noise levels of the sensor, {options.distortions} random sensors "
        f"(place, C and H) on each, each on its own drive, {options.starts} starts within "
        f"{options.reach:g} m each: {count:,} calibrations of our full method. Starts from which "
        f"its search finds the same place share one solve: {summary.solves:,} were computed. The "
        f"other methods run from {options.other_starts} of these starts on the first "
        f"{options.others} drives of each path and level. Maps are of one survey with "
        f"{options.site.scenario.noise.field:g} uT of noise."
    )


def paper_table(summary: Table1Summary) -> str:
    """Return our means and standard deviations beside the paper's, row by row."""
    noises = summary.options.noises
    head = ["", "path", *(f"ours {n:g} uT | paper" for n in noises)]
    lines = [f"| {' | '.join(head)} |", "|---" * (2 + 2 * len(noises)) + "|"]
    for metric, name in METRICS.items():
        for row, path in enumerate(summary.options.paths):
            cells = [f"{name}", f"{row + 1}: {path}"]
            for noise in noises:
                entry = summary.entry(OURS, HARMONIC, path, noise)
                cells += [beside(squared(entry, metric)), beside(printed(metric, row, noise))]
            lines.append(f"| {' | '.join(cells)} |")
    caption = (
        "Mean and standard deviation of the metrics as the paper defines them: e_t and e_H "
        "squared, e_C a norm. Its paths are its own; the order of ours means nothing."
    )
    return "\n".join([caption, "", *lines])


def squared(entry: Entry, metric: str) -> Spread | None:
    """Return the errors as the paper defines them."""
    return {"t": entry.t2, "C": entry.C, "H": entry.H2}[metric]


def beside(figures: Spread | Printed | None) -> str:
    """Return mean and standard deviation."""
    return "-" if figures is None else f"{figures.mean:.3g} +- {figures.std:.2g}"


def misses(summary: Table1Summary) -> Iterator[str]:
    """Yield a sentence on every entry that is not as good as was aimed at."""
    wrong = list(missed(summary))
    entries = [each for each in summary.entries if (each.method, each.map_kind) == (OURS, HARMONIC)]
    far, lost = sum(each.far for each in entries), sum(each.lost for each in entries)
    worst = max(each.t.max for each in entries if each.t is not None)
    yield (
        f"Aim: mean e_t at most a tenth of the paper's, e_C and e_H no larger, no single |e_t| "
        f"above 5 cm. The largest |e_t| is {1e3 * worst:.1f} mm; {far} are above 5 cm, {lost} "
        "calibrations ended without a result."
    )
    if wrong:
        yield "Not reached:\n\n" + "\n".join(f"- {line}" for line in wrong)
    else:
        yield "All rows reach it."


def missed(summary: Table1Summary) -> Iterator[str]:
    """Yield what is above its aim, and whether the bound forbids it."""
    for metric in METRICS:
        for row, path in enumerate(summary.options.paths):
            for noise in summary.options.noises:
                ours = squared(summary.entry(OURS, HARMONIC, path, noise), metric)
                theirs = printed(metric, row, noise)
                if ours is None or theirs is None:
                    continue
                aim = theirs.mean / (BETTER if metric == "t" else 1)
                if ours.mean > aim:
                    least = least_mean(bound_at(summary, path, noise), metric)
                    yield (
                        f"{METRICS[metric]} of path {row + 1} at {noise:g} uT: {ours.mean:.3g}, "
                        f"aim {aim:.3g}; the bound {'forbids' if least > aim else 'allows'} it: "
                        f"{least:.3g}."
                    )


def bound_at(summary: Table1Summary, path: RouteShape, noise: float) -> Bound:
    """Return the bound of one path at one noise level."""
    return next(each for each in summary.bounds if (each.path, each.noise) == (path, noise))


def least_mean(bound: Bound, metric: str) -> float:
    """Return the bound of the metric's mean.

    That of a squared norm is the trace itself. The mean of a norm is below the root of its
    square's; of a norm that one direction dominates, sqrt(2 / pi) of it.
    """
    return {"t": bound.t**2, "C": math.sqrt(2 / math.pi) * bound.C, "H": bound.H**2}[metric]


def method_table(summary: Table1Summary, noise: float) -> str:
    """Return all methods over all paths at one noise level."""
    head = (
        f"Noise {noise:g} uT: mean / median / 95 % / largest over all paths.\n\n"
        "| method | map | calibrations | lost | above 5 cm | e_t (mm) | e_C (1e-3) | e_H (uT) "
        "| s each |\n" + "|---" * 9 + "|"
    )
    lines = [method_line(each) for each in summary.together if each.noise == noise]
    return "\n".join([head, *lines])


def method_line(entry: Entry) -> str:
    """Return one method on one map over all paths."""
    cells = [
        entry.method,
        entry.map_kind,
        f"{entry.calibrations:,}",
        str(entry.lost),
        str(entry.far),
        plain(entry.t, 1e3),
        plain(entry.C, 1e3),
        plain(entry.H, 1.0),
        f"{entry.seconds:.2f}",
    ]
    return f"| {' | '.join(cells)} |"


def plain(spread: Spread | None, unit: float) -> str:
    """Return mean, median, 95 % and largest."""
    if spread is None:
        return "-"
    figures = (spread.mean, spread.median, spread.p95, spread.max)
    return " / ".join(f"{unit * value:.3g}" for value in figures)


def notes() -> str:
    """Return what the methods are."""
    return (
        "OLS, RRTLS and w-RRTLS corrected alternate their closed form with the translation graph; "
        "as published has the printed weights, the map's variance to the power -2, and none in "
        "the step for t. Its intercept and its Jacobian are mended: as printed, H comes out as "
        "zero and nothing converges. The naive peer fits t, C and H at once by scipy on "
        "scikit-learn's Gaussian processes of a thinned survey. All of them but one-key are told "
        "the start, and look no further. magyc, where it ran, knows neither map nor place: of C it "
        "tells the shape up to a turn, so that only its H stands here; it is told the turn rates "
        "along the sensor's true axes."
    )


def bound_table(summary: Table1Summary) -> str:
    """Return the Cramer-Rao bound and our errors on the same drives."""
    head = (
        "| path | noise (uT) | readings | drives | t: error / bound (mm) | C (1e-3) | H (uT) |\n"
        + "|---" * 7
        + "|"
    )
    lines = [
        f"| {summary.options.paths.index(each.path) + 1}: {each.path} | {each.noise:g} "
        f"| {each.readings:,.0f} | {each.drives} | {1e3 * each.t_error:.2f} / {1e3 * each.t:.2f} "
        f"| {1e3 * each.C_error:.2f} / {1e3 * each.C:.2f} | {each.H_error:.3f} / {each.H:.3f} |"
        for each in summary.bounds
    ]
    caption = (
        "Root mean square of errors, and of the Cramer-Rao bound of the full model at the truth: "
        "the map's errors are unknown, too, with the prior that the survey leaves."
    )
    return "\n".join([caption, "", head, *lines])


def efficiency_lines(summary: Table1Summary) -> Iterator[str]:
    """Yield how far above the bound our errors of t are."""
    for each in summary.efficiency:
        reached = "within" if each.ratio <= EFFICIENT else "above"
        yield (
            f"At {each.noise:g} uT the error of t is {1e3 * each.error:.2f} mm, "
            f"{each.ratio:.2f} times the bound: {reached} {EFFICIENT:g} times."
        )


def figures(summary: Table1Summary) -> dict[str, Figure]:
    """Return the errors of t by method, a panel for each noise level."""
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
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=3, frameon=False)
    return {"table1": figure}


def draw_method(axes: Axes, row: int, entries: list[Entry]) -> None:
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
