"""The ablation study as a page of Markdown."""

from collections.abc import Sequence

from l2m_gtsam.studies.ablation.cells import Solver
from l2m_gtsam.studies.ablation.table import (
    FAR_M,
    FAR_UT,
    AblationTable,
    Combination,
    Comparison,
    Gain,
    MapRow,
    Spread,
)
from l2m_gtsam.studies.ablation.verdict import verdicts
from l2m_gtsam.studies.ablation.words import density_label, kind_label, spacing_label
from l2m_gtsam.studies.markdown import table_lines

ERROR_NOTE = (
    "Lengths of the errors of t (cm), of C (Frobenius) and of H (uT). The paper squares that of t."
)
GAIN_NOTE = (
    "Each line compares calibrations of the same drives from the same guesses: the mean by which "
    "the length of the error shrinks, with its 95 % interval, and on how many of the drives it "
    "does. Means whose interval leaves out zero are bold."
)


def ablation_page(table: AblationTable) -> str:
    """Return the page of a study, but for its title."""
    parts = [
        intro(table),
        "## Against the paper",
        *verdicts(table),
        "## Maps",
        "![The maps at each density beside the truth](ablation_maps.png)",
        map_lines(table),
        map_note(table),
        "## Errors",
        "![Errors of t, C and H](ablation.png)",
        "Boxes: quartiles and median; whiskers: 5 and 95 %; diamonds: means.",
    ]
    for spacing in table.options.spacings:
        rows = [row for row in table.rows if row.spacing == spacing]
        parts += [f"### Fingerprints: {density_label(table, spacing)}", error_lines(rows)]
    parts += [
        ERROR_NOTE,
        far_note(table),
        "## What the map does",
        gain_lines(table.map_gains, "method"),
        "## What the weights do",
        gain_lines(table.weight_gains, "from"),
        "## What our method does",
        gain_lines(table.method_gains, "from"),
        GAIN_NOTE,
    ]
    return "\n\n".join(parts)


def intro(table: AblationTable) -> str:
    """Return what was done."""
    options, spacings = table.options, table.options.spacings
    sensors = options.batches * options.batch
    noise = options.site.scenario.noise.field
    kinds = ", ".join(kind_label(kind) for kind in options.kinds)
    densities = "; ".join(spacing_label(each) for each in spacings)
    return (
        f"The paper's protocol: {sensors} random sensors, each on its own drive with {noise:g} uT "
        f"of noise, are calibrated on maps of one survey (noise {noise:g} uT, too): {kinds}. "
        f"Fingerprints are thinned over the floor, {options.around:g} m around the drive "
        f"({densities}; at each height of the survey's sensors). OLS, RRTLS and w-RRTLS are the "
        "closed forms within the two-step loop, from a guess up to "
        f"{options.guess:g} m off, without the joint graph. The paper's weights are the inverse "
        "squares of the map's variances; those of *w-RRTLS* are likelihood weights, with the "
        f"sensor's noise in them. *{Solver.ONE_KEY.value}* looks for its start around the same "
        "guess and ends with the joint graph."
    )


def map_lines(table: AblationTable) -> str:
    """Return the maps as a table."""
    head = "| fingerprints | map | readings | rms error (uT) | predicted (uT) | inside (%) |"
    return table_lines(head, (map_cells(row) for row in table.maps))


def map_cells(row: MapRow) -> list[str]:
    """Return one map as cells of a table."""
    picture = row.picture
    worth = [f"{picture.rmse:.3f}", f"{picture.sigma:.3f}", f"{100 * picture.inside:.1f}"]
    return [spacing_label(row.spacing), kind_label(row.kind), f"{picture.readings:,}", *worth]


def map_note(table: AblationTable) -> str:
    """Return what the figures of maps mean."""
    return (
        "Strength of the field at one height "
        f"({table.maps[0].picture.z:.2f} m), the fingerprints of all heights as dots; grey: no "
        "data, or steel. Errors per axis where sensors pass; predicted: what the map itself says "
        "of them; inside: the share of the readings that lie in the map, the others do not count."
    )


def far_note(table: AblationTable) -> str:
    """Return where calibrations ended in another minimum, which is seen in means alone."""
    beyond = f"more than {FAR_M:g} m or {FAR_UT:g} uT off"
    maps: dict[str, list[str]] = {}
    for row in table.rows:
        if row.far:
            where = f"{kind_label(row.kind)}, {spacing_label(row.spacing)}"
            maps.setdefault(where, []).append(f"{row.solver.value} {row.far}")
    if not maps:
        return f"No calibration ended {beyond}."
    counts = "; ".join(f"{where} ({', '.join(each)})" for where, each in maps.items())
    return (
        f"In another minimum than the sensor's, {beyond}, ended, of {table.rows[0].calibrations} "
        f"each: {counts}. Means and their intervals carry these few, medians do not."
    )


def error_lines(rows: Sequence[Combination]) -> str:
    """Return the errors at one density as a table."""
    each = "mean | median | p95"
    head = f"| map | method | t (cm): {each} | C: {each} | H (uT): {each} | no result |"
    return table_lines(head, map(error_cells, rows))


def error_cells(row: Combination) -> list[str]:
    """Return one combination as cells of a table."""
    errors = [*three(row.t, 100.0, 2), *three(row.C, 1.0, 4), *three(row.H, 1.0, 3)]
    return [kind_label(row.kind), row.solver.value, *errors, str(row.failed)]


def three(spread: Spread | None, scale: float, digits: int) -> list[str]:
    """Return mean, median and 95th percentile."""
    if spread is None:
        return ["-"] * 3
    values = (spread.mean, spread.median, spread.p95)
    return [f"{scale * value:.{digits}f}" for value in values]


def gain_lines(comparisons: Sequence[Comparison], what: str) -> str:
    """Return comparisons as a table; ``what`` heads the method's column."""
    head = f"| fingerprints | map | {what} | to | t (cm) | better | H (uT) | better |"
    return table_lines(head, map(gain_cells, comparisons))


def gain_cells(each: Comparison) -> list[str]:
    """Return one comparison as cells of a table."""
    names = [spacing_label(each.spacing), kind_label(each.kind), each.solver.value]
    return [*names, kind_label(each.to), *said(each.t, 100.0, 2), *said(each.H, 1.0, 3)]


def said(gain: Gain | None, scale: float, digits: int) -> list[str]:
    """Return a gain with its interval, and the share of drives that are better."""
    if gain is None:
        return ["-", "-"]
    mean = f"{scale * gain.mean:+.{digits}f}"
    marked = f"**{mean}**" if gain.sure else mean
    return [f"{marked} ± {scale * gain.margin:.{digits}f}", f"{100 * gain.better:.0f} %"]
