"""The honesty study as a page of Markdown: verdicts in words, then the tables."""

from collections.abc import Sequence

from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.studies.honesty.conditions import HonestyOptions
from l2m_gtsam.studies.honesty.outcomes import Honesty
from l2m_gtsam.studies.honesty.summary import (
    TARGET,
    BoundRow,
    HonestySummary,
    ParameterRow,
    Verdict,
)
from l2m_gtsam.studies.statistics import LEVEL

UNITS = {"t": (1e3, "mm"), "C": (1.0, ""), "H": (1.0, "uT"), "offset": (1e3, "ms")}
"""Factor from SI and uT, and unit, of the parameters as tables show them."""
SPELT = {"C, H": "(C, H)", "all": "all together", "offset": "the time offset"}
BLOCK_NOTE = (
    "NEES: mean of e' inv(P) e, which true covariances bring to the number of parameters. The band "
    "holds it with 95 %; calibrations on one survey share its map, so that only surveys count as "
    "independent. Ellipsoid: share of the 95 % ellipsoids that hold the truth, with its interval. "
    "In bold what is out of its band."
)
BOUND_NOTE = (
    "Root mean square of errors over calibrations, and of what the bound says of them. The bound "
    "is the inverse information of the full model at the true values and noise, with the errors of "
    "map and poses as unknowns, and without the readings that were spoilt."
)


def honesty_page(summary: HonestySummary) -> str:
    """Return the page of a study, but for its title."""
    full = summary.of(Uncertainty.FULL)
    return "\n\n".join(
        [
            intro(summary.options),
            "## What came out",
            "\n".join(f"- {sentence(each)}" for each in full),
            neglected(summary.of(Uncertainty.INDEPENDENT)),
            "## Covariances",
            "![Mean NEES over its expectation, with bands](nees.png)",
            block_table(summary.verdicts),
            BLOCK_NOTE,
            "## Against the Cramer-Rao bound",
            bound_table(full),
            BOUND_NOTE,
            "## Each parameter",
            "![Share of 95 % intervals that hold the truth](coverage.png)",
            parameter_table(full),
            tally(full),
            "![Histograms of z-scores against the normal distribution](zscores.png)",
            "z: errors over their stated sigmas. Scores beyond 4 are counted at the ends.",
        ]
    )


def intro(options: HonestyOptions) -> str:
    """Return what was tried."""
    heights = ", ".join(f"{height:g}" for height in options.heights)
    return (
        f"{options.surveys} halls of magnetised steel, each surveyed ({options.survey_readings:,} "
        f"readings at {heights} m) and mapped, and on each map {options.drives} drives with a "
        "sensor of random place and distortion, "
        f"{options.readings} readings each. *Troubled* drives are off in everything: clocks by up "
        "to 40 ms, poses by errors that last, a tenth of the readings by tens of microtesla. "
        "All conditions have the same halls, paths and sensors and, scaled to each level, the "
        "same draws of noise: their rows are no independent trials of each other."
    )


def setting(verdict: Verdict) -> str:
    """Return condition and noise."""
    return f"{verdict.condition}, {verdict.noise:g} uT"


def sentence(verdict: Verdict) -> str:
    """Return whether sigmas are true under one condition, and errors near the bound."""
    said = f"**{setting(verdict)}**: {counted(verdict)}"
    if not verdict.blocks:
        return f"{said}; of too few surveys to judge."
    place = verdict.bounds[0]
    met = "within" if place.ratio <= TARGET else "beyond"
    return (
        f"{said}; {in_band(verdict)}; the error of t is {place.ratio:.2f} times the bound "
        f"({place.interval.low:.2f}-{place.interval.high:.2f}), {met} the {TARGET:g} aimed at."
    )


def in_band(verdict: Verdict) -> str:
    """Return of which parameters the NEES is in its band, and on which side it is not."""
    sides = {
        "in band": [r for r in verdict.blocks if r.honesty.honest],
        "above it (sigmas too small)": [
            r for r in verdict.blocks if r.honesty.nees > r.honesty.band.high
        ],
        "below it (sigmas too large)": [
            r for r in verdict.blocks if r.honesty.nees < r.honesty.band.low
        ],
    }
    parts = [f"{listed([r.name for r in rows])} {side}" for side, rows in sides.items() if rows]
    return f"NEES of {', of '.join(parts)}"


def listed(names: Sequence[str]) -> str:
    """Return blocks in words."""
    words = [SPELT.get(name, name) for name in names]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def counted(verdict: Verdict) -> str:
    """Return how many calibrations were judged."""
    if verdict.determined == verdict.wanted:
        return f"all {verdict.wanted} calibrations determined"
    return f"{verdict.determined} of {verdict.wanted} calibrations determined"


def neglected(verdicts: Sequence[Verdict]) -> str:
    """Return what comes of taking the map's errors for independent."""
    values = [row.honesty.nees / row.honesty.dof for v in verdicts for row in v.blocks[:1]]
    if not values:
        return ""
    return (
        "With `uncertainty: independent`, which takes the map's errors for independent from "
        f"reading to reading, the NEES of t is {min(values):.1f} to {max(values):.1f} times what "
        "true covariances give."
    )


def block_table(verdicts: Sequence[Verdict]) -> str:
    """Return NEES and ellipsoids of all conditions."""
    head = "| condition | map errors | block | size | NEES | 95 % band | ellipsoid | interval |"
    lines = [
        f"| {setting(verdict)} | {verdict.uncertainty} | {row.name} | {row.honesty.dof} "
        f"| {block_cells(row.honesty)} |"
        for verdict in verdicts
        for row in verdict.blocks
    ]
    return "\n".join([head, "|---" * 8 + "|", *lines])


def block_cells(each: Honesty) -> str:
    """Return NEES and coverage with their bands, as cells of a line."""
    low, high = each.coverage_band.low, each.coverage_band.high
    return (
        f"{marked(f'{each.nees:.2f}', ok=each.honest)} | {each.band.low:.2f}-{each.band.high:.2f} "
        f"| {marked(f'{100 * each.coverage:.1f} %', ok=LEVEL in each.coverage_band)} "
        f"| {100 * low:.1f}-{100 * high:.1f} %"
    )


def bound_table(verdicts: Sequence[Verdict]) -> str:
    """Return errors and bounds of all conditions."""
    head = "| condition | of | rms error | rms bound | error / bound | 95 % interval |"
    lines = [
        f"| {setting(verdict)} | {bound_cells(row)} |"
        for verdict in verdicts
        for row in verdict.bounds
    ]
    return "\n".join([head, "|---" * 6 + "|", *lines])


def bound_cells(row: BoundRow) -> str:
    """Return error and bound as cells of a line."""
    factor, unit = UNITS[row.name]
    of = f"{row.name} ({unit})" if unit else row.name
    ok = row.name != "t" or row.ratio <= TARGET
    return (
        f"{of} | {factor * row.error:.3g} | {factor * row.bound:.3g} "
        f"| {marked(f'{row.ratio:.2f}', ok=ok)} | {row.interval.low:.2f}-{row.interval.high:.2f}"
    )


def parameter_table(verdicts: Sequence[Verdict]) -> str:
    """Return the z-scores of every parameter under all conditions side by side."""
    names = list(dict.fromkeys(row.name for verdict in verdicts for row in verdict.parameters))
    found = [{row.name: row for row in verdict.parameters} for verdict in verdicts]
    titles = " | ".join(f"{setting(v)}: std of z | within 95 %" for v in verdicts)
    lines = [
        f"| {name} | {' | '.join(parameter_cells(rows.get(name)) for rows in found)} |"
        for name in names
    ]
    return "\n".join([f"| | {titles} |", "|---" * (1 + 2 * len(verdicts)) + "|", *lines])


def parameter_cells(row: ParameterRow | None) -> str:
    """Return spread of z-scores and coverage as cells of a line, empty for none."""
    if row is None:
        return " | "
    std = marked(f"{row.z_std:.2f}", ok=row.z_std in row.z_band)
    return f"{std} | {marked(f'{100 * row.covered:.1f} %', ok=LEVEL in row.interval)}"


def tally(verdicts: Sequence[Verdict]) -> str:
    """Return how many of the figures in the table of parameters are out of their bands."""
    rows = [row for verdict in verdicts for row in verdict.parameters]
    stds = sum(row.z_std not in row.z_band for row in rows)
    shares = sum(LEVEL not in row.interval for row in rows)
    expected = (1 - LEVEL) * len(rows)
    return (
        f"Of {len(rows)} standard deviations {stds} are out of their 95 % bands, of as many shares "
        f"{shares} (in bold): about {expected:.0f} of each are bound to be by chance alone."
    )


def marked(text: str, *, ok: bool) -> str:
    """Return a figure, bold where it is not as it should be."""
    return text if ok else f"**{text}**"
