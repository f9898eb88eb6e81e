"""What changed in a map since its survey, in the terminal."""

import numpy as np
from rich.table import Table

from l2m_gtsam.cli.tables import add_numbers, plain_table
from l2m_gtsam.records.map_diary import MapDiary, between, doubtful, words_of

HEADINGS = ("x y z (m)", "+- (m)", "A m2", "+-", "at most (uT)")


def changes_table(diary: MapDiary) -> Table:
    """Return one row for each source that came or went, the last first."""
    drives = len(diary.drives) - 1
    drive = "one drive" if drives == 1 else f"{drives} drives"
    since = f"{drive} since the survey ({diary.drives[0].day})"
    caption = doubtful(diary)
    if not diary.changes:
        caption = "nothing came or went that the drives noticed"
    table = plain_table(f"What changed: {since}", caption)
    for heading in ("what", "between"):
        table.add_column(heading, no_wrap=True)
    add_numbers(table, HEADINGS)
    for number in reversed(range(len(diary.changes))):
        source = diary.changes[number].source
        table.add_row(
            f"{number + 1} {words_of(diary, number)}",
            between(diary, number),
            " ".join(f"{value:.2f}" for value in source.position),
            f"{float(np.max(source.position_sigma)):.2f}",
            f"{float(np.linalg.norm(source.moment)):.1f}",
            f"{float(np.linalg.norm(source.moment_sigma)):.1f}",
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
