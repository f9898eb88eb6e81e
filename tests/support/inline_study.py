"""Studies computed in the process of a test: what ``run_study`` does, without a cluster."""

from pathlib import Path
from typing import TypeVar

from l2m_gtsam.options import Options
from l2m_gtsam.studies.cell_files import CellFolder
from l2m_gtsam.studies.run import FORMAT, StudyFile, made_cell, provenance, publish
from l2m_gtsam.studies.study import Study

Opts = TypeVar("Opts", bound=Options)
Cell = TypeVar("Cell")
Summary = TypeVar("Summary")


def run_inline(study: Study[Opts, Cell, Summary], options: Opts, out: Path) -> Summary:
    """Return the summary of all cells after they went through files, and write page and figures."""
    folder = CellFolder.opened(out / "cells", study, options)
    name, place = "", None
    keys = study.keys(options)
    for key in keys:
        if study.site(options, key) != name:
            name = study.site(options, key)
            place = study.prepare(options, name)
        folder.write(key, made_cell(study.compute, options, key, place))
    read = {key: folder.read(key) for key in keys}
    made = {key: cell for key, cell in read.items() if cell is not None}
    summary = study.summarise(options, {key: each.cell for key, each in made.items()})
    content = StudyFile(FORMAT, study.name, provenance(made, "l2m study"), options, summary)
    return publish(study, content, out).summary
