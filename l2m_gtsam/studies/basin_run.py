"""A basin study from start to files, on as many processes as wanted, going on where it stopped."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from l2m_gtsam.qa.figures import save_figure
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.studies.basin import BasinOptions, BasinTable, Cell, basin_table, cells_of
from l2m_gtsam.studies.basin_file import BasinStudy, cells_to_keep, write_study
from l2m_gtsam.studies.basin_report import basin_figure, basin_markdown

STUDY_FILE, TABLE_FILE, FIGURE_FILE = "basin.json", "basin.md", "basin.png"


def run_basin(
    options: BasinOptions, out: Path, processes: int, tell: Callable[[Cell, float], None]
) -> BasinTable:
    """Compute all cells that a folder does not hold yet, writing after each distortion.

    Parameters
    ----------
    options
        The study.
    out
        Folder of ``basin.json``, ``basin.md`` and ``basin.png``.
    processes
        How many compute; with one it is this one.
    tell
        Called with each new cell and the share of all cells that is there.

    Raises
    ------
    ConfigError
        The folder holds a study with other options.
    """
    out.mkdir(parents=True, exist_ok=True)
    cells = list(cells_to_keep(out / STUDY_FILE, options))
    there = {(each.distortion, each.ring) for each in cells}
    missing = {
        distortion: [ring for ring in range(options.rings) if (distortion, ring) not in there]
        for distortion in range(options.distortions)
    }
    for new in computed(options, {d: rings for d, rings in missing.items() if rings}, processes):
        cells = sorted([*cells, *new], key=lambda each: (each.distortion, each.ring))
        write_results(out, options, cells)
        for each in new:
            tell(each, len(cells) / (options.distortions * options.rings))
    return write_results(out, options, cells)


def computed(
    options: BasinOptions, missing: Mapping[int, Sequence[int]], processes: int
) -> Iterator[list[Cell]]:
    """Yield the cells of these rings of each distortion, as they get ready."""
    if processes == 1:
        yield from (cells_of(options, *each) for each in missing.items())
        return
    # Forks of a process that has threads may wait for ever.
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        waiting = [pool.submit(cells_of, options, *each) for each in missing.items()]
        yield from (ready.result() for ready in as_completed(waiting))


def write_results(out: Path, options: BasinOptions, cells: Sequence[Cell]) -> BasinTable:
    """Write cells, table and figure, and return the table."""
    table = basin_table(options, cells)
    write_study(out / STUDY_FILE, BasinStudy(options, tuple(cells)))
    with atomic_path(out / TABLE_FILE) as temporary:
        temporary.write_text(basin_markdown(table), encoding="utf-8")
    save_figure(basin_figure(table), out / FIGURE_FILE)
    return table
