"""Studies computed in the process of a test: what ``run_study`` does, without a cluster."""

from itertools import groupby
from pathlib import Path
from typing import TypeVar

from l2m_gtsam.options import Options
from l2m_gtsam.studies.run import CELLS, CellFolder, computed_cell, conclude
from l2m_gtsam.studies.study import Study

Opts = TypeVar("Opts", bound=Options)
Cell = TypeVar("Cell")
Summary = TypeVar("Summary")


def run_inline(study: Study[Opts, Cell, Summary], options: Opts, out: Path) -> Summary:
    """Return the summary of all cells after they went through files, and write page and figures."""
    folder = CellFolder.opened(out / CELLS, study, options)
    keys = study.keys(options)
    for site, cells in groupby(keys, lambda key: study.site(options, key)):
        shared = study.prepare(options, site)
        for key in cells:
            folder.write(key, computed_cell(study, options, key, shared))
    read = {key: folder.read(key) for key in keys}
    made = {key: cell for key, cell in read.items() if cell is not None}
    return conclude(study, options, made, out, "l2m study").summary
