"""A basin study from start to files, on as many processes as wanted, going on where it stopped."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import product
from multiprocessing import get_context
from pathlib import Path

from l2m_gtsam.qa.figures import save_figure
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.studies.basin import BasinOptions, BasinTable, Cell, basin_table, cell
from l2m_gtsam.studies.basin_file import BasinStudy, cells_to_keep, write_study
from l2m_gtsam.studies.basin_report import basin_figure, basin_markdown

STUDY_FILE, TABLE_FILE, FIGURE_FILE = "basin.json", "basin.md", "basin.png"

Place = tuple[int, int]


def run_basin(
    options: BasinOptions, out: Path, processes: int, tell: Callable[[Cell, float], None]
) -> BasinTable:
    """Compute all cells that a folder does not hold yet, writing after each what there is.

    Parameters
    ----------
    options
        The study.
    out
        Folder of ``basin.json``, ``basin.md`` and ``basin.png``.
    processes
        How many compute; with one it is this one.
    tell
        Called with each new cell and the share of all that is there.

    Raises
    ------
    ConfigError
        The folder holds a study with other options.
    """
    out.mkdir(parents=True, exist_ok=True)
    cells = list(cells_to_keep(out / STUDY_FILE, options))
    every = list(product(range(options.distortions), range(options.rings)))
    there = {(each.distortion, each.ring) for each in cells}
    for new in computed(options, [place for place in every if place not in there], processes):
        cells.append(new)
        cells.sort(key=lambda each: (each.distortion, each.ring))
        write_results(out, options, cells)
        tell(new, len(cells) / len(every))
    return write_results(out, options, cells)


def computed(options: BasinOptions, places: Sequence[Place], processes: int) -> Iterator[Cell]:
    """Yield the cells at these places, as they get ready."""
    if processes == 1:
        yield from (cell(options, *place) for place in places)
        return
    # Forks of a process that has threads may wait for ever.
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        waiting = [pool.submit(cell, options, *place) for place in places]
        yield from (ready.result() for ready in as_completed(waiting))


def write_results(out: Path, options: BasinOptions, cells: Sequence[Cell]) -> BasinTable:
    """Write cells, table and figure, and return the table."""
    table = basin_table(options, cells)
    write_study(out / STUDY_FILE, BasinStudy(options, tuple(cells)))
    with atomic_path(out / TABLE_FILE) as temporary:
        temporary.write_text(basin_markdown(table), encoding="utf-8")
    save_figure(basin_figure(table), out / FIGURE_FILE)
    return table
