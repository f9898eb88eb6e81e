"""Cells of the study of SLAM: one recording, one form of drift and one seed, by all methods."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from pydantic import Field

from l2m_gtsam.options import Options
from l2m_gtsam.studies.peers.reduced_rank_ekf import ReducedRankEkfOptions
from l2m_gtsam.studies.slam.methods import (
    MethodRow,
    filter_row,
    odometry_row,
    our_row,
    stated_drift,
)
from l2m_gtsam.studies.slam.recipes import DriftRecipe, Form, drifted
from l2m_gtsam.studies.slam.recordings import ROBOT, SHIP, TrueDrive, robot_run, ship_run

SHIP_RUNS = ("ship-1", "ship-2")
WALK_TIMES = 10.0  # the drift of a step as noise of the walk: half a metre in 500 steps


class DriftKind(StrEnum):
    """Which errors odometry has."""

    PUBLISHED = "published"
    WALK = "walk"


class SlamStudyOptions(Options):
    """Of the study of SLAM in an unknown field."""

    data: str = "../shared/data"
    """Folder of the recordings, which are no part of this package."""
    recordings: tuple[str, ...] = SHIP_RUNS
    """Runs of the ship, and `robot-1` to `robot-4`: passes whose field has so much detail that a
    drive takes ten minutes and more."""
    seed: int = Field(default=0, ge=0)
    """The first;"""
    seeds: int = Field(default=2, ge=1)
    """and how many, of the drift's noise."""
    noise_ut: float = Field(default=5.0, gt=0)
    """Of a reading per axis, as the publication on the ship has it: a tenth of the field."""
    drift: DriftRecipe = DriftRecipe()
    """Errors of odometry. The random walk has none that all steps share, and ten times as much
    noise more."""
    filter: ReducedRankEkfOptions = ReducedRankEkfOptions()
    """Parameters of the peer."""


@dataclass(frozen=True)
class SlamCell:
    """What the methods make of one drive with one odometry."""

    path_m: float
    key_poses: int
    odometry: MethodRow
    filter: MethodRow
    ours: MethodRow


def cell_keys(options: SlamStudyOptions) -> tuple[str, ...]:
    """Return all cells."""
    return tuple(
        f"{site}-{kind}-{form}-{options.seed + number}"
        for site in options.recordings
        for kind in DriftKind
        for form in Form
        for number in range(options.seeds)
    )


def site_of(key: str) -> str:
    """Return the recording of a cell."""
    return "-".join(key.split("-")[:2])


def read_drive(options: SlamStudyOptions, site: str) -> TrueDrive:
    """Return a recording with its true poses."""
    vehicle, run = site.split("-")
    if vehicle == "ship":
        return ship_run(Path(options.data) / SHIP, int(run))
    return robot_run(Path(options.data) / ROBOT, int(run))


def computed(options: SlamStudyOptions, key: str, drive: TrueDrive) -> SlamCell:
    """Return a cell."""
    *_, kind, form, seed = key.split("-")
    recipe = recipe_of(DriftKind(kind), options.drift)
    odometry = drifted(drive.truth, recipe, Form(form), int(seed))
    stated = stated_drift(drive.truth, recipe, Form(form))
    ours, rows = our_row(drive, odometry, stated, options.noise_ut)
    return SlamCell(
        path_m=float(drive.path_m),
        key_poses=len(rows),
        odometry=odometry_row(drive, odometry, rows),
        filter=filter_row(drive, odometry, rows, options.filter),
        ours=ours,
    )


def recipe_of(kind: DriftKind, published: DriftRecipe) -> DriftRecipe:
    """Return the errors of a kind of drift."""
    if kind is DriftKind.PUBLISHED:
        return published
    level = published.level_m + WALK_TIMES * published.drift_m
    return published.model_copy(update={"drift_m": 0.0, "level_m": level})
