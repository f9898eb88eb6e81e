"""The study of SLAM in an unknown field: ``l2m study slam``."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.studies.slam.methods import (
    MethodRow,
    SlamCell,
    SlamStudyOptions,
    cell_keys,
    computed,
    read_drive,
    site_of,
)
from l2m_gtsam.studies.slam.recordings import TrueDrive
from l2m_gtsam.studies.study import Study

METHODS = {"odometry": "odometry", "filter": "reduced-rank filter", "ours": "l2m slam"}
COLOURS = {"odometry": "#999999", "filter": "#d55e00", "ours": "#0072b2"}
LOWEST, HIGHEST = 3.0, 12.0  # NEES of whole poses, 6 where sigmas are right
WIDTH = 0.26  # of a bar, where drives are one apart


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
        Whether no seed is worse than its odometry.
    nees, ms_per_pose
        Means; NEES is None where the method states no sigmas.
    """

    rms_m: float
    worst_m: float
    removed: float
    never_worse: bool
    nees: float | None
    ms_per_pose: float
    unchanged: int


@dataclass(frozen=True)
class SlamRow:
    """A recording with one kind and form of drift."""

    site: str
    kind: str
    form: str
    path_m: float
    key_poses: int
    odometry: MethodFigures
    filter: MethodFigures
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
    options = SlamStudyOptions
    cell = SlamCell
    summary = SlamSummary

    def keys(self, options: SlamStudyOptions) -> tuple[str, ...]:
        """Return one cell for each recording, drift, form and seed."""
        return cell_keys(options)

    def site(self, options: SlamStudyOptions, key: str) -> str:
        """Return the recording."""
        return site_of(key)

    def prepare(self, options: SlamStudyOptions, site: str) -> TrueDrive:
        """Return the recording."""
        return read_drive(options, site)

    def compute(self, options: SlamStudyOptions, key: str, shared: TrueDrive) -> SlamCell:
        """Run all methods on one odometry."""
        return computed(options, key, shared)

    def summarise(self, options: SlamStudyOptions, cells: Mapping[str, SlamCell]) -> SlamSummary:
        """Return the figures over all seeds."""
        groups: dict[str, list[SlamCell]] = {}
        for key, cell in cells.items():
            groups.setdefault(key.rpartition("-")[0], []).append(cell)
        return SlamSummary(options, tuple(row_of(key, own) for key, own in groups.items()))

    def page_context(self, summary: SlamSummary) -> dict[str, Any]:
        """Return what is lost: rows that the peer wins, wrong sigmas, drives without a gain."""
        rows = summary.rows
        return {
            "lost": [named(row) for row in rows if row.filter.rms_m < row.ours.rms_m],
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
        figure = Figure(figsize=(9.0, 4.6), layout="constrained", dpi=150)
        axes, at = figure.add_subplot(), np.arange(len(summary.rows))
        for place, (name, label) in enumerate(METHODS.items()):
            own: list[MethodFigures] = [getattr(row, name) for row in summary.rows]
            mean = np.array([each.rms_m for each in own])
            worst = np.array([each.worst_m for each in own])
            axes.bar(at + (place - 1) * WIDTH, mean, WIDTH, color=COLOURS[name], label=label)
            axes.vlines(at + (place - 1) * WIDTH, mean, worst, color="black", linewidth=0.8)
        names = [f"{row.site}\n{row.kind}\n{row.form}" for row in summary.rows]
        axes.set_xticks(at, names, fontsize=5.5)
        axes.set(ylabel="error (m); lines: worst seed", ylim=(0, None))
        axes.grid(axis="y", alpha=0.3)
        axes.legend()
        return {"slam": figure}


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
        odometry=figures_of(before, before),
        filter=figures_of([each.filter for each in cells], before),
        ours=figures_of([each.ours for each in cells], before),
    )


def figures_of(rows: list[MethodRow], before: list[MethodRow]) -> MethodFigures:
    """Return one method's figures, beside odometry's rows of the same seeds."""
    error = np.array([each.rms_m for each in rows])
    alone = np.array([each.rms_m for each in before])
    stated = [each.nees for each in rows if each.nees is not None]
    return MethodFigures(
        rms_m=float(error.mean()),
        worst_m=float(error.max()),
        removed=float(1 - error.mean() / alone.mean()),
        never_worse=bool((error <= alone).all()),
        nees=float(np.mean(stated)) if stated else None,
        ms_per_pose=float(np.mean([each.ms_per_pose for each in rows])),
        unchanged=sum(each.unchanged for each in rows),
    )


SLAM = SlamStudy()
