"""The study of SLAM in an unknown field: ``l2m study slam``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from l2m_gtsam.studies.slam.methods import (
    DriftKind,
    MethodRow,
    SlamCell,
    SlamStudyOptions,
    computed,
)
from l2m_gtsam.studies.slam.recordings import (
    HANDHELD,
    ROBOT,
    SHIP,
    Form,
    TrueDrive,
    handheld_run,
    parts_of,
    robot_run,
    ship_run,
)
from l2m_gtsam.studies.statistics import mean_of
from l2m_gtsam.studies.study import Study

Cell = TypeVar("Cell")
READERS = {
    "ship": (ship_run, SHIP),
    "hand": (handheld_run, HANDHELD),
    "robot": (robot_run, ROBOT),
}
METHODS = {
    "odometry": "odometry",
    "ekf": "reduced-rank filter",
    "particles": "particle filter",
    "fixed_lag": "fixed-lag smoother",
    "online": "l2m slam --online",
    "ours": "l2m slam",
}
PEERS = ("ekf", "particles", "fixed_lag")
COLOURS = {
    "odometry": "#999999",
    "ekf": "#d55e00",
    "particles": "#e69f00",
    "fixed_lag": "#cc79a7",
    "online": "#56b4e9",
    "ours": "#0072b2",
}
LOWEST, HIGHEST = 3.0, 12.0  # NEES of whole poses, 6 where sigmas are right
HIGHEST_BAR = 1.4  # times odometry's error: what is beyond is cut off
WIDTH = 0.14  # of a bar, where drives are one apart


@dataclass(frozen=True)
class MethodFigures:
    """One method over all seeds.

    Attributes
    ----------
    rms_m, worst_m
        Mean and largest error of the seeds.
    removed
        Share of the drift that is removed, of the means.
    never_worse
        Whether no seed is worse than its odometry, at whatever key poses that was returned.
    nees, ms_per_pose
        Means; NEES is None where the method states no sigmas.
    unchanged
        In how many seeds odometry was returned.
    inside
        Mean share of poses within their own 95 %; None where the method states no sigmas.
    peak_mib
        Largest, MiB; None where the system does not report it.
    """

    rms_m: float
    worst_m: float
    removed: float
    never_worse: bool
    nees: float | None
    ms_per_pose: float
    unchanged: int
    inside: float | None = None
    peak_mib: float | None = None


@dataclass(frozen=True)
class SlamRow:
    """A recording with one kind and form of drift."""

    site: str
    kind: str
    form: str
    path_m: float
    key_poses: int
    odometry: MethodFigures
    ekf: MethodFigures
    particles: MethodFigures
    fixed_lag: MethodFigures
    online: MethodFigures
    ours: MethodFigures


@dataclass(frozen=True)
class SlamSummary:
    """All rows, and the options."""

    options: SlamStudyOptions
    rows: tuple[SlamRow, ...]


class SlamStudy(Study[SlamStudyOptions, SlamCell, SlamSummary]):
    """Methods side by side; a cell is one drive with one odometry."""

    name = "slam"
    title = "SLAM in an unknown field"
    size = frozenset({"seeds", "recordings"})

    def keys(self, options: SlamStudyOptions) -> tuple[str, ...]:
        """Return one cell for each recording, drift, form and seed."""
        return tuple(
            f"{carrier}-{run}-{kind}-{form}-{options.seed + number}"
            for carrier, run in (parts_of(each, READERS) for each in options.recordings)
            for kind in DriftKind
            for form in Form
            for number in range(options.seeds)
        )

    def site(self, options: SlamStudyOptions, key: str) -> str:
        """Return the recording."""
        return "-".join(key.split("-")[:2])

    def prepare(self, options: SlamStudyOptions, site: str) -> TrueDrive:
        """Return the recording with its true poses."""
        carrier, run = parts_of(site, READERS)
        read, name = READERS[carrier]
        return read(Path(options.data) / name, run)

    def compute(self, options: SlamStudyOptions, key: str, shared: TrueDrive) -> SlamCell:
        """Run all methods on one odometry."""
        return computed(options, key, shared)

    def summarise(self, options: SlamStudyOptions, cells: Mapping[str, SlamCell]) -> SlamSummary:
        """Return the figures over all seeds."""
        rows = (row_of(key, own) for key, own in seeds_together(cells).items())
        return SlamSummary(options, tuple(rows))

    def page_context(self, summary: SlamSummary) -> dict[str, Any]:
        """Return what is lost: rows that a peer wins, wrong sigmas, drives without a gain."""
        rows = summary.rows
        return {
            "methods": METHODS,
            "lost": [f"{named(row)} ({', '.join(won)})" for row in rows if (won := winners(row))],
            "worse": [named(row) for row in rows if not row.online.never_worse],
            "outside": [
                named(row)
                for row in rows
                if row.ours.nees is None or not LOWEST <= row.ours.nees <= HIGHEST
            ],
            "unchanged": [
                f"{named(row)} ({row.ours.unchanged})" for row in rows if row.ours.unchanged
            ],
        }

    def figures(self, summary: SlamSummary) -> dict[str, Figure]:
        """Draw the errors of the methods, drive by drive."""
        sites = list(dict.fromkeys(row.site for row in summary.rows))
        size = (9.0, 2.4 * len(sites) + 0.4)
        figure = Figure(figsize=size, layout="constrained", dpi=150)
        panels = figure.subplots(len(sites), squeeze=False)[:, 0]
        for axes, site in zip(panels, sites, strict=True):
            own = [row for row in summary.rows if row.site == site]
            for place, name in enumerate(METHODS):
                beside = (place - 0.5 * (len(METHODS) - 1)) * WIDTH
                found = [getattr(row, name) for row in own]
                draw_bars(axes, found, METHODS[name], COLOURS[name], beside)
            names = [f"{row.kind}, {row.form}" for row in own]
            axes.set_xticks(np.arange(len(own)), names)
            most = max(row.odometry.worst_m for row in own)
            axes.set(title=site, ylabel="error (m)", ylim=(0, HIGHEST_BAR * most))
            axes.grid(axis="y", alpha=0.3)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=len(METHODS), fontsize=7, loc="outside upper center")
        return {"slam": figure}


def draw_bars(
    axes: Axes, rows: Sequence[MethodFigures], label: str, colour: str, beside: float
) -> None:
    """Draw a method's errors, drive by drive, and lines to its worst seeds.

    Parameters
    ----------
    axes
        Drives are one apart.
    rows
        The method's figures on each drive.
    label, colour
        Of the method.
    beside
        How far its bars are beside the middle of a drive.
    """
    for place, found in enumerate(rows):
        own = label if place == len(rows) - 1 else None
        axes.bar(place + beside, found.rms_m, WIDTH, color=colour, label=own)
        axes.vlines(place + beside, found.rms_m, found.worst_m, color="black", linewidth=0.8)


def winners(row: SlamRow) -> list[str]:
    """Return the peers whose error is smaller than that of ``l2m slam``."""
    return [METHODS[name] for name in PEERS if getattr(row, name).rms_m < row.ours.rms_m]


def named(row: SlamRow) -> str:
    """Return what a row is of."""
    return f"{row.site}, {row.kind}, {row.form}"


def row_of(key: str, cells: list[SlamCell]) -> SlamRow:
    """Return the figures of one group of seeds."""
    vehicle, run, kind, form = key.split("-")
    before = [each.odometry for each in cells]
    return SlamRow(
        site=f"{vehicle} {run}",
        kind=kind,
        form=form,
        path_m=cells[0].path_m,
        key_poses=cells[0].key_poses,
        **{name: figures_of([getattr(cell, name) for cell in cells], before) for name in METHODS},
    )


def seeds_together(cells: Mapping[str, Cell]) -> dict[str, list[Cell]]:
    """Return cells that differ in their seed alone, by what they have in common."""
    groups: dict[str, list[Cell]] = {}
    for key, cell in cells.items():
        groups.setdefault(key.rpartition("-")[0], []).append(cell)
    return groups


def figures_of(rows: list[MethodRow], before: list[MethodRow]) -> MethodFigures:
    """Return one method's figures, beside odometry's rows of the same seeds."""
    error = np.array([each.rms_m for each in rows])
    alone = np.array([each.rms_m for each in before])
    return MethodFigures(
        rms_m=float(error.mean()),
        worst_m=float(error.max()),
        removed=float(1 - error.mean() / alone.mean()),
        never_worse=all(
            each.unchanged or each.rms_m <= own.rms_m
            for each, own in zip(rows, before, strict=True)
        ),
        nees=mean_of([each.nees for each in rows]),
        inside=mean_of([each.inside for each in rows]),
        ms_per_pose=float(np.mean([each.ms_per_pose for each in rows])),
        peak_mib=max((each.peak_mib for each in rows if each.peak_mib is not None), default=None),
        unchanged=sum(each.unchanged for each in rows),
    )


SLAM = SlamStudy()
