"""A study whose cells cost next to nothing, for tests of what runs studies."""

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.options import Options
from l2m_gtsam.studies.study import Study


class ToyOptions(Options):
    """Of a study of random numbers."""

    seed: int = 1
    cells: int = 6
    seconds: float = 0.0
    """That a cell takes."""
    log: str = ""
    """File that every computed cell appends a line to."""
    deadly: str = ""
    """Cell that ends its worker when it is computed for the first time."""


@dataclass(frozen=True)
class ToyCell:
    value: float


@dataclass(frozen=True)
class ToySummary:
    mean: float
    values: tuple[float, ...]


class ToyStudy(Study[ToyOptions, ToyCell, ToySummary]):
    name = "toy"
    title = "Random numbers"
    size = frozenset({"cells", "seconds", "log", "deadly"})

    def keys(self, options: ToyOptions) -> tuple[str, ...]:
        return tuple(f"cell-{number}" for number in range(options.cells))

    def site(self, options: ToyOptions, key: str) -> str:
        return "even" if int(key[5:]) % 2 == 0 else "odd"

    def prepare(self, options: ToyOptions, site: str) -> float:
        return 10.0 if site == "even" else 20.0

    def compute(self, options: ToyOptions, key: str, shared: float) -> ToyCell:
        if options.log:
            with Path(options.log).open("a") as log:
                log.write(f"{key}\n")
            begun = Path(options.log).read_text().count(f"{key}\n")
            if key == options.deadly and begun == 1:
                os._exit(1)
        time.sleep(options.seconds)  # long enough for a test to kill the run between cells
        return ToyCell(shared + float(np.random.default_rng([options.seed, int(key[5:])]).normal()))

    def summarise(self, options: ToyOptions, cells: Mapping[str, ToyCell]) -> ToySummary:
        values = tuple(cell.value for cell in cells.values())
        return ToySummary(float(np.mean(values)), values)

    def page(self, summary: ToySummary) -> str:
        return f"Mean {summary.mean!r} of {summary.values!r}."

    def figures(self, summary: ToySummary) -> dict[str, Figure]:
        return {}


TOY = ToyStudy()
