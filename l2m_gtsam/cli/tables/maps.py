"""Magnetic maps in the terminal: content of one, its changes, and kinds of maps compared."""

import numpy as np
from rich.markup import escape
from rich.table import Table

from l2m_gtsam.batch.files import entries_of, origin_of
from l2m_gtsam.batch.maps import DescribedMap
from l2m_gtsam.cli.tables import add_numbers, add_text, new_table, plain_table, vector_cell
from l2m_gtsam.maps.compare import KindFigures, KindResult, MapComparison
from l2m_gtsam.qa.report.facts import period
from l2m_gtsam.records.map_diary import MapDiary, between, doubtful, words_of
from l2m_gtsam.text import by_sigma, sigma_alone

HEADINGS = (
    "log-likelihood",
    "rmse (uT)",
    "z-score std",
    "in 95 %",
    "inside",
    "build (s)",
    "noise (uT)",
    "shared rmse (uT)",
    "x y z (uT)",
)
CHANGE_HEADINGS = ("x y z (m)", "+- (m)", "A m2", "+-", "at most (uT)")


def comparison_table(comparison: MapComparison) -> Table:
    """Return one row per kind of map: how it predicts held-out readings, or why it failed.

    Figures are of the readings inside each map, "shared" of those inside all maps; only the
    log-likelihood is of all readings.
    """
    table = plain_table(
        f"Maps compared on {comparison.readings:,} readings in {comparison.patches:,} "
        f"patches of {comparison.fold:.3g} m, held out in {comparison.folds} folds",
        escape(recommendation(comparison)),
    )
    table.add_column("kind", no_wrap=True)
    failed = any(result.figures is None for result in comparison.kinds)
    if failed:
        add_text(table, "failed")
    add_numbers(table, HEADINGS)
    for result in comparison.kinds:
        row = _row(result)
        style = "green" if result.kind == comparison.recommended else None
        table.add_row(*(row if failed else (row[0], *row[2:])), style=style)
    return table


def recommendation(comparison: MapComparison) -> str:
    """Return which kind is recommended and why, as a sentence."""
    if comparison.recommended is None:
        return comparison.reason
    return f"recommended: {comparison.recommended}; {comparison.reason}"


def _row(result: KindResult) -> tuple[str, ...]:
    figures = result.figures
    cells = ("-",) * len(HEADINGS) if figures is None else _cells(figures)
    return (escape(result.kind), escape(result.reason), *cells)


def _cells(figures: KindFigures) -> tuple[str, ...]:
    return (
        f"{figures.log_likelihood:.3f}",
        f"{figures.rmse:.3f}",
        f"{figures.z_std:.2f}",
        f"{figures.coverage:.3f}",
        f"{figures.inside:.1%}",
        f"{figures.seconds:.1f}",
        f"{figures.noise:.3f}",
        f"{figures.rmse_shared:.3f}",
        " ".join(f"{value:.3f}" for value in figures.rmse_axes),
    )


def map_table(described: DescribedMap) -> Table:
    """Return what a map is made of, what it covers and where it came from."""
    summary = described.field_map.summary
    table = plain_table("Magnetic map")
    for heading in ("fact", "value"):
        table.add_column(heading)
    table.add_row("kind", summary.kind)
    table.add_row("readings given, kept", f"{summary.readings:,}, {summary.rows:,}")
    for axis, low, high in zip("xyz", summary.lower, summary.upper, strict=True):
        table.add_row(f"readings along {axis}", f"{low:.2f} to {high:.2f} m")
    for name, value in summary.facts.items():
        shown = f"{value:.4g}" if isinstance(value, float) else str(value)
        table.add_row(escape(name), escape(shown))
    for name in ("frame", "version"):
        table.add_row(name, escape(str(described.provenance.get(name, "unknown"))))
    for source in entries_of(described.provenance, "bags"):
        if isinstance(source, dict):
            table.add_row("made from", escape(", ".join(str(value) for value in source.values())))
    origin = origin_of(described.provenance)
    table.add_row("surveyed", escape(period(origin.surveyed)))
    for each in origin.sources:
        if each.role.startswith(("suite", "calibration")):
            table.add_row(escape(each.role), escape(f"{each.path}, {each.sha256}"))
    for name, shown in (("structure", "structure"), ("lidar", "cloud of scans")):
        if isinstance(parts := described.provenance.get(name), dict):
            facts = (f"{part.replace('_', ' ')} {value}" for part, value in parts.items())
            table.add_row(shown, escape(", ".join(facts)))
    return table


def changes_table(diary: MapDiary) -> Table:
    """Return one row for each source that came or went, the last first."""
    drives = len(diary.drives) - 1
    drive = "one drive" if drives == 1 else f"{drives} drives"
    since = f"{drive} since the survey ({diary.drives[0].day})"
    caption = doubtful(diary)
    if not diary.changes:
        caption = "nothing came or went that the drives noticed"
    table = new_table(f"What changed: {since}", ("what", "between"), CHANGE_HEADINGS, caption)
    for number in reversed(range(len(diary.changes))):
        source = diary.changes[number].source
        position = float(np.max(source.position_sigma))
        moment = float(np.linalg.norm(source.moment_sigma))
        table.add_row(
            f"{number + 1} {words_of(diary, number)}",
            between(diary, number),
            vector_cell(source.position, np.full(3, position)),
            sigma_alone(position),
            by_sigma(float(np.linalg.norm(source.moment)), moment),
            sigma_alone(moment),
            f"{source.strongest:.1f}",
        )
    return table


def faded_lines(diary: MapDiary) -> list[str]:
    """Return where earlier readings count less, drive by drive, a line each."""
    lines = []
    for drive in sorted({each.drive for each in diary.faded}, reverse=True):
        own = [each for each in diary.faded if each.drive == drive]
        places = ", ".join(
            f"({each.middle[0]:.1f}, {each.middle[1]:.1f}) {100 * each.kept:.0f} %" for each in own
        )
        lines.append(
            f"{diary.drives[drive].day}: earlier readings count less about (x, y in m): {places}"
        )
    return lines
