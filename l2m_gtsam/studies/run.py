"""A study from its options to its files, going on where it was stopped."""

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from shutil import which
from time import process_time
from typing import Any, Generic, TypeVar

from pydantic import TypeAdapter, ValidationError

from l2m_gtsam.errors import ConfigError
from l2m_gtsam.options import Options
from l2m_gtsam.parallel.cluster import ClusterOptions, Work, computed
from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.qa.report.svg import save_figure
from l2m_gtsam.storage.bounded import read_content
from l2m_gtsam.storage.files import write_text
from l2m_gtsam.storage.parts import only_one
from l2m_gtsam.storage.result_set import made, published
from l2m_gtsam.studies.study import Study

Opts = TypeVar("Opts", bound=Options)
Cell = TypeVar("Cell")
Summary = TypeVar("Summary")

STUDY_FILE, CELLS, CONDITIONS = "study.json", "cells", "conditions.json"
FORMAT = "l2m-study-1"
GIB = 2**30
MAX_BYTES = 200_000_000  # of a study and of each of its cells


@dataclass(frozen=True)
class Provenance:
    """Where a study's numbers come from.

    Attributes
    ----------
    command
        That computes them again.
    code
        Version, and commits where they are known, of the code that computed the cells.
    machines
        Classes of machine that computed them.
    core_seconds
        That they took together.
    """

    command: str
    code: tuple[str, ...]
    machines: tuple[str, ...]
    cells: int
    core_seconds: float


@dataclass(frozen=True)
class StudyFile(Generic[Opts, Summary]):
    """``study.json``: everything that page and figures are made from."""

    format: str
    study: str
    made: Provenance
    options: Opts
    summary: Summary


@dataclass(frozen=True)
class ComputedCell(Generic[Cell]):
    """A cell with the seconds of one core that it took, and the code and machine that took them."""

    cell: Cell
    seconds: float
    code: str
    machine: str


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
    out
        Folder of ``study.json``, the page, the figures and, in ``cells``, all finished cells.
    progress
        Called with the study's name and the fraction of the cells that are finished.
    command
        That computes the study again, for its page.

    Raises
    ------
    ConfigError
        The folder holds a study with other options.
    ClusterError
        See ``computed``.
    """
    with made(out), only_one(out):
        keys = study.keys(options)
        folder = CellFolder.opened(out / CELLS, study, options)
        finished = {key: cell for key in keys if (cell := folder.read(key)) is not None}
        missing = [key for key in keys if key not in finished]
        report = counter(study.name, progress)
        report(len(finished), len(keys))
        work = Work(
            partial(study.site, options),
            partial(study.prepare, options),
            partial(computed_cell, study, options),
        )
        for key, cell in computed(work, missing, cluster):
            folder.write(key, cell)
            finished[key] = cell
            report(len(finished), len(keys))
        return conclude(study, options, {key: finished[key] for key in keys}, out, command)


def computed_cell(
    study: Study[Opts, Cell, Any], options: Opts, key: str, shared: Any
) -> ComputedCell[Cell]:
    """Compute a cell, on whichever worker."""
    start = process_time()
    cell = study.compute(options, key, shared)
    return ComputedCell(cell, process_time() - start, code_version(), machine_class())


def conclude(
    study: Study[Opts, Cell, Summary],
    options: Opts,
    cells: Mapping[str, ComputedCell[Cell]],
    out: Path,
    command: str,
) -> StudyFile[Opts, Summary]:
    """Publish ``study.json``, page and figures of all cells; return what was read back."""
    made = Provenance(
        command,
        tuple(sorted({each.code for each in cells.values()})),
        tuple(sorted({each.machine for each in cells.values()})),
        len(cells),
        round(sum(each.seconds for each in cells.values()), 1),
    )
    summary = study.summarise(options, {key: each.cell for key, each in cells.items()})
    content = StudyFile(FORMAT, study.name, made, options, summary)
    plain = file_type(study).dump_python(content, mode="json")
    with published(out) as stage:
        write_text(stage / STUDY_FILE, json.dumps(plain, indent=1, allow_nan=False) + "\n")
        return render(study, stage)


def render(study: Study[Opts, Any, Summary], folder: Path) -> StudyFile[Opts, Summary]:
    """Write page and figures from the ``study.json`` of a folder; return what was read."""
    content = read_study(study, folder / STUDY_FILE)
    for name, figure in study.figures(content.summary).items():
        save_figure(figure, folder / f"{name}.png")
    write_text(folder / f"{study.name}.md", whole_page(study, content))
    return content


def read_study(study: Study[Opts, Any, Summary], path: Path) -> StudyFile[Opts, Summary]:
    """Return the content of a ``study.json``."""
    return file_type(study).validate_json(read_content(path, MAX_BYTES, ConfigError))


def file_type(study: Study[Opts, Any, Summary]) -> TypeAdapter[StudyFile[Opts, Summary]]:
    """Return the type of a study's file, whose classes are values here."""
    return TypeAdapter(StudyFile[study.options, study.summary])  # type: ignore[name-defined]


def whole_page(study: Study[Opts, Any, Summary], content: StudyFile[Opts, Summary]) -> str:
    """Return the page with its title and, at its end, how to compute the study again."""
    made = content.made
    return (
        f"# {study.title}\n\n{study.page(content.summary)}\n\n"
        f"Made by `{made.command}`: {made.cells:,} cells, {made.core_seconds / 60:,.0f} minutes "
        f"of one core. Code {', '.join(made.code)}; {'; '.join(made.machines)}. Every number "
        f"above is in [{STUDY_FILE}]({STUDY_FILE}).\n"
    )


@dataclass(frozen=True)
class CellFolder(Generic[Cell]):
    """The finished cells of one study with one set of options: one file each, so none is lost."""

    path: Path
    content: TypeAdapter[ComputedCell[Cell]]

    @classmethod
    def opened(cls, path: Path, study: Study[Opts, Cell, Any], options: Opts) -> "CellFolder[Cell]":
        """Return the folder of a study, created if it does not exist.

        Raises
        ------
        ConfigError
            It holds cells of another study or made with other options.
        """
        path.mkdir(parents=True, exist_ok=True)
        wanted = {"study": study.name} | options.model_dump(mode="json", exclude=set(study.size))
        conditions, text = path / CONDITIONS, json.dumps(wanted, allow_nan=False)
        if not conditions.exists():
            write_text(conditions, text)
        elif read_content(conditions, MAX_BYTES, ConfigError) != text.encode():
            raise ConfigError(
                f"{path}: holds cells of a study with other options; choose another --out"
            )
        return cls(path, TypeAdapter(ComputedCell[study.cell]))  # type: ignore[name-defined]

    def write(self, key: str, cell: ComputedCell[Cell]) -> None:
        """Write a cell, whole or not at all."""
        plain = self.content.dump_python(cell, mode="json")
        write_text(self.path / f"{key}.json", json.dumps(plain, allow_nan=False))

    def read(self, key: str) -> ComputedCell[Cell] | None:
        """Return a cell; None if it is not finished.

        Raises
        ------
        ConfigError
            The file is not a cell of this version of the study.
        """
        file = self.path / f"{key}.json"
        if not file.exists():
            return None
        try:
            return self.content.validate_json(read_content(file, MAX_BYTES, ConfigError))
        except ValidationError as error:
            raise ConfigError(f"{file}: not a cell of this study; remove it") from error


@lru_cache(maxsize=1)
def code_version() -> str:
    """Return the version of this package, with the commit where it runs from a checkout."""
    git, folder = which("git"), Path(__file__).parents[1]
    released = version("l2m-gtsam")
    if git is None:
        return released
    # Limited to our folder: inside another project's checkout the log is empty.
    asked = [git, "-C", str(folder), "log", "-1", "--format=%h", "--", "."]
    log = subprocess.run(asked, capture_output=True, text=True, check=False)  # noqa: S603 - fixed words
    return f"{released} ({log.stdout.strip()})" if log.stdout.strip() else released


def machine_class() -> str:
    """Return processor architecture, number of cores and memory."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB
    python = platform.python_version()
    return f"{platform.machine()}, {os.cpu_count()} cores, {memory:.0f} GiB, Python {python}"
