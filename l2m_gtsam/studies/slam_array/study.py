"""The study of SLAM with several sensors: ``l2m study slam-array``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.studies.slam.methods import MethodRow
from l2m_gtsam.studies.slam.recordings import parts_of
from l2m_gtsam.studies.slam.study import WIDTH, MethodFigures, draw_bars, figures_of, seeds_together
from l2m_gtsam.studies.slam_array.methods import (
    NEAR_M,
    WIDE_M,
    SlamArrayCell,
    SlamArrayOptions,
    computed,
)
from l2m_gtsam.studies.slam_array.places import PLACES, Drift, DriveInMap
from l2m_gtsam.studies.study import Study

METHODS = {
    "odometry": "odometry",
    "particles": "map: particle filter",
    "map_online": "map: l2m slam --online",
    "map_ours": "map: l2m slam",
    "online": "no map: l2m slam --online",
    "ours": "no map: l2m slam",
}
COLOURS = {
    "odometry": "#999999",
    "particles": "#e69f00",
    "map_online": "#56b4e9",
    "map_ours": "#0072b2",
    "online": "#66c2a5",
    "ours": "#1b7837",
}
LOWEST_M = 0.005  # of the axis
SIMULATED = {"warehouse", "corridor"}


@dataclass(frozen=True)
class DriftLeft:
    """What loops without errors leave of the drift.

    Attributes
    ----------
    rms_m
        Mean error of the seeds.
    removed
        Share of the drift that is removed, of the means.
    """

    rms_m: float
    removed: float

    @classmethod
    def of(cls, rms_m: Sequence[float], before: Sequence[MethodRow]) -> "DriftLeft":
        """Return it over all seeds, by what is left in each and odometry alone."""
        mean = float(np.mean(rms_m))
        return cls(mean, 1 - mean / float(np.mean([each.rms_m for each in before])))


@dataclass(frozen=True)
class SlamArrayRow:
    """A recording with one kind of drift."""

    site: str
    kind: str
    path_m: float
    sensors: int
    odometry: MethodFigures
    particles: MethodFigures
    map_online: MethodFigures
    map_ours: MethodFigures
    online: MethodFigures
    ours: MethodFigures
    near_loops: DriftLeft
    wide_loops: DriftLeft


@dataclass(frozen=True)
class SlamArraySummary:
    """All rows, and the options."""

    options: SlamArrayOptions
    rows: tuple[SlamArrayRow, ...]


class SlamArrayStudy(Study[SlamArrayOptions, SlamArrayCell, SlamArraySummary]):
    """Methods side by side; a cell is one drive with one odometry."""

    name = "slam-array"
    title = "SLAM with several sensors, in a map and without one"
    size = frozenset({"seeds", "recordings"})

    def keys(self, options: SlamArrayOptions) -> tuple[str, ...]:
        """Return one cell for each recording, drift and seed."""
        return tuple(
            f"{place}-{run}-{drift}-{options.seed + number}"
            for place, run in (parts_of(each, PLACES) for each in options.recordings)
            for drift in Drift
            for number in range(options.seeds)
        )

    def site(self, options: SlamArrayOptions, key: str) -> str:
        """Return the recording."""
        return "-".join(key.split("-")[:2])

    def prepare(self, options: SlamArrayOptions, site: str) -> DriveInMap:
        """Return the drive and its map."""
        place, number = parts_of(site, PLACES)
        return PLACES[place](Path(options.data), number)

    def compute(self, options: SlamArrayOptions, key: str, shared: DriveInMap) -> SlamArrayCell:
        """Run all methods on one odometry."""
        return computed(options, key, shared)

    def summarise(
        self, options: SlamArrayOptions, cells: Mapping[str, SlamArrayCell]
    ) -> SlamArraySummary:
        """Return the figures over all seeds."""
        rows = (row_of(key, own) for key, own in seeds_together(cells).items())
        return SlamArraySummary(options, tuple(rows))

    def page_context(self, summary: SlamArraySummary) -> dict[str, Any]:
        """Return which places there are, rows that odometry wins, and those that kept odometry."""
        named = {f"{row.site}, {row.kind}": row for row in summary.rows}
        kinds = {row.site.split()[0] for row in summary.rows}
        return {
            "methods": METHODS,
            "near_m": NEAR_M,
            "wide_m": WIDE_M,
            "kinds": kinds,
            "ours": kinds & SIMULATED,
            "worse": [
                f"{name} ({', '.join(own)})"
                for name, row in named.items()
                if (own := worse_than_odometry(row))
            ],
            "unchanged": [
                f"{name} ({row.ours.unchanged})"
                for name, row in named.items()
                if row.ours.unchanged
            ],
        }

    def figures(self, summary: SlamArraySummary) -> dict[str, Figure]:
        """Draw the errors of the methods, drive by drive, on a logarithmic axis."""
        rows = summary.rows
        figure = Figure(figsize=(9.0, 4.2), layout="constrained", dpi=150)
        axes = figure.subplots()
        for place, name in enumerate(METHODS):
            beside = (place - 0.5 * (len(METHODS) - 1)) * WIDTH
            draw_bars(
                axes, [getattr(row, name) for row in rows], METHODS[name], COLOURS[name], beside
            )
        names = [f"{row.site}\n{row.kind}" for row in rows]
        axes.set_xticks(np.arange(len(rows)), names, fontsize=7)
        axes.set(ylabel="error (m)", yscale="log", ylim=(LOWEST_M, None))
        axes.grid(axis="y", alpha=0.3)
        figure.legend(ncols=3, fontsize=7, loc="outside upper center")
        return {"slam-array": figure}


def worse_than_odometry(row: SlamArrayRow) -> list[str]:
    """Return the methods of which a seed is worse than its odometry."""
    return [METHODS[name] for name in METHODS if not getattr(row, name).never_worse]


def row_of(key: str, cells: list[SlamArrayCell]) -> SlamArrayRow:
    """Return the figures of one group of seeds."""
    place, number, kind = key.split("-")
    before = [each.odometry for each in cells]
    return SlamArrayRow(
        site=f"{place} {number}",
        kind=kind,
        path_m=cells[0].path_m,
        sensors=cells[0].sensors,
        **{name: figures_of([getattr(cell, name) for cell in cells], before) for name in METHODS},
        near_loops=DriftLeft.of([each.near_loops_m for each in cells], before),
        wide_loops=DriftLeft.of([each.wide_loops_m for each in cells], before),
    )


SLAM_ARRAY = SlamArrayStudy()
