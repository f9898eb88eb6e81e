"""The troubles study: ``l2m study troubles``."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from l2m_gtsam.records.verdict import Level
from l2m_gtsam.studies.statistics import LEVEL, Share
from l2m_gtsam.studies.study import Study
from l2m_gtsam.studies.troubles.cells import JudgedSensor, TroublesCell, cell_of
from l2m_gtsam.studies.troubles.options import Trouble, TroublesOptions
from l2m_gtsam.studies.troubles.surveys import TroubledHall, troubled_hall

TARGET = 0.93  # of the PASS whose 95 % ellipsoid should hold the truth
DOF_T, DOF = 3, 15
COLOURS = {Level.PASS: "#009e73", Level.WARN: "#e69f00", Level.FAIL: "#d55e00"}


@dataclass(frozen=True)
class TroubleRow:
    """What came of one condition.

    Attributes
    ----------
    trouble
        The condition.
    levels
        Sensors by their verdict: PASS, WARN, FAIL.
    determined
        Those with a result and finite variances.
    nees_t, nees
        Means over these; 3 and 15 are expected. None where there is none.
    held
        Those whose 95 % ellipsoid of all fifteen holds the truth.
    passed_t, passed
        Of those judged PASS, whose ellipsoid of t, and of all fifteen, holds it; None without any.
    flagged
        Those whose parts scatter more than modelled.
    error_m, sigma_m
        Root mean squares of the error of t and of its stated sigma.
    """

    trouble: Trouble
    levels: tuple[int, int, int]
    determined: int
    nees_t: float | None
    nees: float | None
    held: Share | None
    passed_t: Share | None
    passed: Share | None
    flagged: int
    error_m: float | None
    sigma_m: float | None


@dataclass(frozen=True)
class TroublesSummary:
    """All conditions, in the order of ``Trouble``."""

    options: TroublesOptions
    rows: tuple[TroubleRow, ...]


class TroublesStudy(Study[TroublesOptions, TroublesCell, TroublesSummary]):
    """Verdicts and sigmas under troubles; a cell is one survey under one condition."""

    name = "troubles"
    title = "What a PASS is worth"
    size = frozenset({"surveys"})
    options = TroublesOptions
    cell = TroublesCell
    summary = TroublesSummary

    def keys(self, options: TroublesOptions) -> tuple[str, ...]:
        """Return a cell for each survey and condition, those of one map together."""
        ordered = sorted(Trouble, key=lambda each: (kind(each), list(Trouble).index(each)))
        return tuple(
            f"survey-{number:03d}-{each.value}"
            for number in range(options.surveys)
            for each in ordered
        )

    def site(self, options: TroublesOptions, key: str) -> str:
        """Return survey and kind of map: most conditions have the same."""
        number, trouble = split(key)
        return f"{number}-{kind(trouble).value}"

    def prepare(self, options: TroublesOptions, site: str) -> TroubledHall:
        """Return a hall with its map."""
        number, _, trouble = site.partition("-")
        return troubled_hall(options, Trouble(trouble), int(number))

    def compute(self, options: TroublesOptions, key: str, shared: TroubledHall) -> TroublesCell:
        """Calibrate and judge all drives through a hall."""
        return cell_of(options, shared, split(key)[1])

    def summarise(
        self, options: TroublesOptions, cells: Mapping[str, TroublesCell]
    ) -> TroublesSummary:
        """Return a row for each condition."""
        by_trouble: dict[Trouble, list[JudgedSensor]] = {each: [] for each in Trouble}
        for cell in cells.values():
            by_trouble[cell.trouble] += cell.sensors
        rows = tuple(row_of(each, found) for each, found in by_trouble.items() if found)
        return TroublesSummary(options, rows)

    def page_context(self, summary: TroublesSummary) -> dict[str, Any]:
        """Return what the text compares with."""
        return {"target": TARGET, "level": LEVEL, "dof_t": DOF_T, "dof": DOF}

    def figures(self, summary: TroublesSummary) -> dict[str, Figure]:
        """Draw the verdicts of each condition, and how many hold the truth."""
        figure = Figure(figsize=(8.0, 3.8), layout="constrained", dpi=150)
        axes, other = figure.subplots(1, 2, sharey=True)
        at, left = np.arange(len(summary.rows))[::-1], np.zeros(len(summary.rows))
        total = np.array([sum(row.levels) for row in summary.rows])
        for index, level in enumerate((Level.PASS, Level.WARN, Level.FAIL)):
            share = 100 * np.array([row.levels[index] for row in summary.rows]) / total
            axes.barh(at, share, 0.7, left, color=COLOURS[level], label=level.value.upper())
            left = left + share
        axes.set_yticks(at, [row.trouble.value for row in summary.rows])
        axes.set_xlabel("verdicts (%)")
        for shift, name, colour in ((0.13, "passed", "#009e73"), (-0.13, "held", "#0072b2")):
            shares = [getattr(row, name) for row in summary.rows]
            known = [k for k, share in enumerate(shares) if share is not None]
            rate = np.array([100 * shares[k].rate for k in known])
            ends = 100 * np.array([shares[k].interval for k in known]).reshape(-1, 2).T
            reach = np.maximum([rate - ends[0], ends[1] - rate], 0.0)
            label = "of those judged PASS" if name == "passed" else "of all"
            style = {"fmt": "o", "markersize": 4, "capsize": 2.5, "color": colour, "label": label}
            other.errorbar(rate, at[known] + shift, xerr=reach, **style)
        other.axvline(100 * TARGET, color="#777777", linewidth=0.8)
        other.set_xlabel("95 % ellipsoid holds the truth (%)")
        other.set_xlim(-3, 103)
        figure.legend(loc="outside lower center", ncols=5, fontsize=9)
        return {"troubles": figure}


def split(key: str) -> tuple[int, Trouble]:
    """Return number of the survey and condition of a cell."""
    _, number, trouble = key.split("-", 2)
    return int(number), Trouble(trouble)


def kind(trouble: Trouble) -> Trouble:
    """Return the condition whose map a condition has."""
    if trouble is Trouble.SUITE_STATED:
        return trouble
    return Trouble.SUITE if trouble.wrong_suite else Trouble.CLEAN


def row_of(trouble: Trouble, found: list[JudgedSensor]) -> TroubleRow:
    """Return what came of a condition."""
    known = [each for each in found if each.distance is not None]
    passed = [each for each in known if each.level == Level.PASS.value]
    return TroubleRow(
        trouble=trouble,
        levels=(count(found, Level.PASS), count(found, Level.WARN), count(found, Level.FAIL)),
        determined=len(known),
        nees_t=mean([each.distance_t for each in known]),
        nees=mean([each.distance for each in known]),
        held=within([each.distance for each in known], DOF),
        passed_t=within([each.distance_t for each in passed], DOF_T),
        passed=within([each.distance for each in passed], DOF),
        flagged=sum(each.unmodelled > 1 for each in found),
        error_m=rms([each.error_m for each in known]),
        sigma_m=rms([each.sigma_m for each in known]),
    )


def count(found: list[JudgedSensor], level: Level) -> int:
    """Return how many were judged so."""
    return sum(each.level == level.value for each in found)


def mean(values: list[Any]) -> float | None:
    """Return the mean, if there is one."""
    return float(np.mean(values)) if values else None


def rms(values: list[Any]) -> float | None:
    """Return the root of the mean square, if there is one."""
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def within(distances: list[Any], dof: int) -> Share | None:
    """Return how many squared distances lie within the ellipsoid of 95 %."""
    if not distances:
        return None
    inside = int(np.count_nonzero(np.array(distances) <= chi2.ppf(LEVEL, dof)))
    return Share(inside, len(distances))


TROUBLES = TroublesStudy()
