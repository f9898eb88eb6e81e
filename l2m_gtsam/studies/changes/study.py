"""The study of places that change: ``l2m study changes``."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.studies.changes.cells import NEAR_M, ChangesCell, TrueChange, cell_of
from l2m_gtsam.studies.changes.loads import ChangesStudyOptions, LoadedHall, loaded_hall
from l2m_gtsam.studies.statistics import Share, in_percent, rms_of
from l2m_gtsam.studies.study import Study

# Edges of the classes that changes are counted in.
MOMENTS = (1.0, 3.0, 10.0, 50.0)  # A m^2
DISTANCES = (0.0, 0.8, 1.2, 2.0, 4.0)  # metres
STRENGTHS = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, np.inf)  # uT


@dataclass(frozen=True)
class ShareFound:
    """How many of some changes are found; and how well, None where none is.

    Attributes
    ----------
    share
        Of them that are found.
    away_m, moment_off
        Medians of the distance of the source that was found, and of the error of its moment.
    """

    share: Share
    away_m: float | None
    moment_off: float | None


@dataclass(frozen=True)
class ChangesSummary:
    """What is found of changes, and what they cost.

    Attributes
    ----------
    by_size
        Changes by moment (rows) and distance of the nearest reading (columns); None for none.
    by_strength
        By their strongest field at a reading.
    false_with, false_without, hours_with, hours_without
        False alarms on drives with changes and without, and how long each of these took together.
    clean_m, changed_m
        Root mean squares of the error of t; None where no sensor has a result.
    undetermined
        Sensors without a result on a drive with changes.
    clean_held, changed_held
        How many ellipsoids of 95 % hold the true t.
    """

    options: ChangesStudyOptions
    by_size: tuple[tuple[ShareFound | None, ...], ...]
    by_strength: tuple[ShareFound | None, ...]
    came: ShareFound | None
    went: ShareFound | None
    false_with: int
    false_without: int
    hours_with: float
    hours_without: float
    clean_m: float | None
    changed_m: float | None
    undetermined: int
    clean_held: Share
    changed_held: Share
    most_rejected: float


class ChangesStudy(Study[ChangesStudyOptions, ChangesCell, ChangesSummary]):
    """Detection of changes and errors of t; a cell is one path, with changes and without.

    Further cells are paths without changes alone.
    """

    name = "changes"
    title = "Places that change"
    size = frozenset({"halls", "unchanged"})

    def keys(self, options: ChangesStudyOptions) -> tuple[str, ...]:
        """Return the paths, hall by hall, then further ones without changes."""
        kinds = [f"path-{path}" for path in range(options.paths)]
        kinds += [f"unchanged-{options.paths + each}" for each in range(options.unchanged)]
        return tuple(f"hall-{hall:03d}-{kind}" for hall in range(options.halls) for kind in kinds)

    def site(self, options: ChangesStudyOptions, key: str) -> str:
        """Return the number of the hall."""
        return key.split("-")[1]

    def prepare(self, options: ChangesStudyOptions, site: str) -> LoadedHall:
        """Return a hall with its loads, mapped."""
        return loaded_hall(options, int(site))

    def compute(self, options: ChangesStudyOptions, key: str, shared: LoadedHall) -> ChangesCell:
        """Calibrate on one path."""
        return cell_of(options, shared, int(key.split("-")[3]))

    def summarise(
        self, options: ChangesStudyOptions, cells: Mapping[str, ChangesCell]
    ) -> ChangesSummary:
        """Count what is found."""
        every = list(cells.values())
        changes = [each for cell in every for each in cell.changes]
        sensors = [each for cell in every for each in cell.sensors]
        return ChangesSummary(
            options=options,
            by_size=tuple(
                tuple(
                    found_of([e for e in changes if m0 <= e.moment < m1 and d0 <= e.nearest_m < d1])
                    for d0, d1 in pairs(DISTANCES)
                )
                for m0, m1 in pairs(MOMENTS)
            ),
            by_strength=tuple(
                found_of([e for e in changes if low <= e.strongest_ut < high])
                for low, high in pairs(STRENGTHS)
            ),
            came=found_of([each for each in changes if each.came]),
            went=found_of([each for each in changes if not each.came]),
            false_with=sum(cell.false_with for cell in every),
            false_without=sum(cell.false_without for cell in every),
            hours_with=sum(cell.hours_with for cell in every),
            hours_without=sum(cell.hours_without for cell in every),
            clean_m=rms_of([each.clean_m for each in sensors]),
            changed_m=rms_of([each.changed_m for each in sensors]),
            undetermined=sum(each.changed_m is None for each in sensors),
            clean_held=Share(sum(each.clean_held for each in sensors), len(sensors)),
            changed_held=Share(sum(each.changed_held for each in sensors), len(sensors)),
            most_rejected=max(cell.rejected for cell in every),
        )

    def page_context(self, summary: ChangesSummary) -> dict[str, Any]:
        """Return the classes."""
        return {
            "near": NEAR_M,
            "distances": pairs(DISTANCES),
            "by_size": list(zip(pairs(MOMENTS), summary.by_size, strict=True)),
            "by_strength": list(zip(pairs(STRENGTHS), summary.by_strength, strict=True)),
        }

    def figures(self, summary: ChangesSummary) -> dict[str, Figure]:
        """Draw the share that is found against the strongest field."""
        figure = Figure(figsize=(6.5, 3.2), layout="constrained", dpi=150)
        axes, at = figure.subplots(), np.arange(len(STRENGTHS) - 1)
        known = [k for k, each in enumerate(summary.by_strength) if each is not None]
        shares = [each.share for each in summary.by_strength if each is not None]
        rate, reach = in_percent([each.rate for each in shares], [each.interval for each in shares])
        axes.errorbar(at[known], rate, yerr=reach, fmt="o-", capsize=3, color="#0072b2")
        axes.set_xticks(at, [interval(*each) for each in pairs(STRENGTHS)])
        axes.set_xlabel("strongest field of the change at a reading (µT)")
        axes.set_ylabel("found (%)")
        axes.set_ylim(-3, 103)
        return {"changes": figure}


def pairs(edges: tuple[float, ...]) -> list[tuple[float, float]]:
    """Return lower and upper end of each class."""
    return list(pairwise(edges))


def interval(low: float, high: float) -> str:
    """Return a class in words."""
    return f"over {low:g}" if np.isinf(high) else f"{low:g}-{high:g}"


def found_of(changes: list[TrueChange]) -> ShareFound | None:
    """Return how many are found, and how well; None for no changes."""
    if not changes:
        return None
    found = [each for each in changes if each.away_m is not None]
    away = [each.away_m for each in found if each.away_m is not None]
    off = [abs(each.moment_ratio - 1) for each in found if each.moment_ratio is not None]
    return ShareFound(
        Share(len(found), len(changes)),
        float(np.median(away)) if away else None,
        float(np.median(off)) if off else None,
    )


CHANGES = ChangesStudy()
