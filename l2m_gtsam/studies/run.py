"""A study from its options to its files, going on where it was stopped."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any, Generic, TypeVar

from pydantic import TypeAdapter

from l2m_gtsam.options import Options
from l2m_gtsam.parallel.cluster import ClusterOptions, Work, computed
from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.qa.report.svg import save_figure
from l2m_gtsam.storage.files import atomic_path
from l2m_gtsam.studies.cell_files import CellFolder, Made
from l2m_gtsam.studies.provenance import Provenance, code_version, machine_class
from l2m_gtsam.studies.study import Study

Opts = TypeVar("Opts", bound=Options)
Cell = TypeVar("Cell")
Summary = TypeVar("Summary")

STUDY_FILE, CELLS = "study.json", "cells"
FORMAT = "l2m-study-1"


@dataclass(frozen=True)
class StudyFile(Generic[Opts, Summary]):
    """``study.json``: everything that page and figures are made of.

    Attributes
    ----------
    format, study
        What the file is.
    made
        What made it.
    options
        Of the study.
    summary
        What came out.
    """

    format: str
    study: str
    made: Provenance
    options: Opts
    summary: Summary


def run_study(
    study: Study[Opts, Cell, Summary],
    options: Opts,
    out: Path,
    cluster: ClusterOptions,
    progress: Progress,
    command: str,
) -> StudyFile[Opts, Summary]:
    """Compute all cells that a folder does not hold yet, then write summary, page and figures.

    Parameters
    ----------
    study, options
        What to compute.
    out
        Folder of ``study.json``, the page, the figures and, in ``cells``, all finished cells.
    cluster
        Who computes.
    progress
        Told the share of the cells that is there.
    command
        That makes the study again, for its page.

    Raises
    ------
    ConfigError
        The folder holds a study with other options.
    ClusterError
        See ``computed``.
    """
    out.mkdir(parents=True, exist_ok=True)
    keys = study.keys(options)
    folder = CellFolder.opened(out / CELLS, study, options)
    found = {key: folder.read(key) for key in keys}
    there = {key: made for key, made in found.items() if made is not None}
    missing = [key for key in keys if key not in there]
    tell = counter(study.name, progress)
    tell(len(there), len(keys))
    work = Work(
        partial(study.site, options),
        partial(study.prepare, options),
        partial(made_cell, study.compute, options),
    )
    for key, made in computed(work, missing, cluster):
        folder.write(key, made)
        there[key] = made
        tell(len(there), len(keys))
    in_order = {key: there[key] for key in keys}
    summary = study.summarise(options, {key: made.cell for key, made in in_order.items()})
    made_by = provenance(in_order, command)
    return publish(study, StudyFile(FORMAT, study.name, made_by, options, summary), out)


def made_cell(
    compute: Callable[[Opts, str, Any], Cell], options: Opts, key: str, site: Any
) -> Made[Cell]:
    """Compute a cell, on whichever worker."""
    start = process_time()
    cell = compute(options, key, site)
    return Made(cell, process_time() - start, code_version(), machine_class())


def provenance(cells: Mapping[str, Made[Cell]], command: str) -> Provenance:
    """Return what made these cells."""
    return Provenance(
        command,
        tuple(sorted({made.code for made in cells.values()})),
        tuple(sorted({made.machine for made in cells.values()})),
        len(cells),
        round(sum(made.seconds for made in cells.values()), 1),
    )


def publish(
    study: Study[Opts, Cell, Summary], content: StudyFile[Opts, Summary], out: Path
) -> StudyFile[Opts, Summary]:
    """Write ``study.json``, and page and figures from what it holds; return what was read back."""
    adapter = TypeAdapter(StudyFile[study.options, study.summary])  # type: ignore[name-defined]
    plain = adapter.dump_python(content, mode="json")
    with atomic_path(out / STUDY_FILE) as temporary:
        temporary.write_text(json.dumps(plain, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    read: StudyFile[Opts, Summary] = adapter.validate_json((out / STUDY_FILE).read_bytes())
    figures = study.figures(read.summary)
    for name, figure in figures.items():
        save_figure(figure, out / f"{name}.png")
    text = f"# {study.title}\n\n{study.page(read.summary)}\n\n{footer(read.made)}"
    with atomic_path(out / f"{study.name}.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    return read


def footer(made: Provenance) -> str:
    """Return how to make the study again, as Markdown."""
    return (
        f"Made by `{made.command}`: {made.cells:,} cells, {made.core_seconds / 60:,.0f} minutes "
        f"of one core. Code {', '.join(made.code)}; {'; '.join(made.machines)}. Every number "
        f"above stands in [{STUDY_FILE}]({STUDY_FILE}).\n"
    )
