"""The troubles study: ``l2m study troubles``."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.records.verdict import Level
from l2m_gtsam.studies.statistics import (
    LEVEL,
    Share,
    ellipsoid_coverage,
    in_percent,
    mean_of,
    rms_of,
)
from l2m_gtsam.studies.study import Study
from l2m_gtsam.studies.troubles.cells import JudgedSensor, TroublesCell, cell_of
from l2m_gtsam.studies.troubles.options import Trouble, TroublesOptions, World
from l2m_gtsam.studies.troubles.surveys import TroubledPlace, troubled_place

TARGET = 0.93  # of the PASS whose 95 % ellipsoid should hold the truth
DOF_T, DOF = 3, 15
COLOURS = {Level.PASS: "#009e73", Level.WARN: "#e69f00", Level.FAIL: "#d55e00"}


@dataclass(frozen=True)
class TroubleRow:
    """What came of one condition in one kind of places.

    Attributes
    ----------
    world
        The kind of places.
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
    alone_t, alone_C, alone_H
        Sensors whose 95 % ellipsoid by the check on parts alone, without any process, holds t, C
        and H.
    error_m, sigma_m
        Root mean squares of the error of t and of its stated sigma.
    """

    world: World
    trouble: Trouble
    levels: tuple[int, int, int]
    determined: int
    nees_t: float | None
    nees: float | None
    held: Share | None
    passed_t: Share | None
    passed: Share | None
    flagged: int
    alone_t: Share | None
    alone_C: Share | None
    alone_H: Share | None
    error_m: float | None
    sigma_m: float | None


@dataclass(frozen=True)
class TroublesSummary:
    """All conditions in each kind of places, in the order of ``Trouble``."""

    options: TroublesOptions
    rows: tuple[TroubleRow, ...]


class TroublesStudy(Study[TroublesOptions, TroublesCell, TroublesSummary]):
    """Verdicts and sigmas under troubles; a cell is one survey under one condition."""

    name = "troubles"
    title = "What a PASS is worth"
    size = frozenset({"surveys", "worlds"})

    def keys(self, options: TroublesOptions) -> tuple[str, ...]:
        """Return a cell for each survey and condition, those of one map together."""
        ordered = sorted(Trouble, key=lambda each: (kind(each), list(Trouble).index(each)))
        return tuple(
            str(CellName(world, number, each))
            for number in range(options.surveys)
            for world in options.worlds
            for each in ordered
        )

    def site(self, options: TroublesOptions, key: str) -> str:
        """Return survey and kind of map: most conditions have the same."""
        cell = CellName.of(key)
        return str(replace(cell, trouble=kind(cell.trouble)))

    def prepare(self, options: TroublesOptions, site: str) -> TroubledPlace:
        """Return a place with its map."""
        name = CellName.of(site)
        return troubled_place(options, name.world, name.trouble, name.survey)

    def compute(self, options: TroublesOptions, key: str, shared: TroubledPlace) -> TroublesCell:
        """Calibrate and judge all drives through a place."""
        name = CellName.of(key)
        return cell_of(options, name.world, shared, name.trouble)

    def summarise(
        self, options: TroublesOptions, cells: Mapping[str, TroublesCell]
    ) -> TroublesSummary:
        """Return a row for each condition in each kind of places."""
        gathered: dict[tuple[World, Trouble], list[JudgedSensor]] = {
            (world, trouble): [] for world in World for trouble in Trouble
        }
        for cell in cells.values():
            gathered[cell.world, cell.trouble] += cell.sensors
        rows = tuple(row_of(*each, found) for each, found in gathered.items() if found)
        return TroublesSummary(options, rows)

    def page_context(self, summary: TroublesSummary) -> dict[str, Any]:
        """Return what the text compares with."""
        return {"target": TARGET, "level": LEVEL, "dof_t": DOF_T, "dof": DOF}

    def figures(self, summary: TroublesSummary) -> dict[str, Figure]:
        """Draw the verdicts of each condition, and how many hold the truth."""
        figure = Figure(
            figsize=(8.0, 1.0 + 0.28 * len(summary.rows)), layout="constrained", dpi=150
        )
        axes, other = figure.subplots(1, 2, sharey=True)
        at, left = np.arange(len(summary.rows))[::-1], np.zeros(len(summary.rows))
        total = np.array([sum(row.levels) for row in summary.rows])
        for index, level in enumerate((Level.PASS, Level.WARN, Level.FAIL)):
            share = 100 * np.array([row.levels[index] for row in summary.rows]) / total
            axes.barh(at, share, 0.7, left, color=COLOURS[level], label=level.value.upper())
            left = left + share
        names = [f"{row.trouble.value}, {row.world.value}" for row in summary.rows]
        axes.set_yticks(at, names, fontsize=8)
        axes.set_xlabel("verdicts (%)")
        for shift, name, colour in ((0.13, "passed", "#009e73"), (-0.13, "held", "#0072b2")):
            known = [k for k, row in enumerate(summary.rows) if getattr(row, name) is not None]
            shares = [getattr(summary.rows[k], name) for k in known]
            rate, reach = in_percent([e.rate for e in shares], [e.interval for e in shares])
            label = "of those judged PASS" if name == "passed" else "of all"
            style = {"fmt": "o", "markersize": 4, "capsize": 2.5, "color": colour, "label": label}
            other.errorbar(rate, at[known] + shift, xerr=reach, **style)
        other.axvline(100 * TARGET, color="#777777", linewidth=0.8)
        other.set_xlabel("95 % ellipsoid holds the truth (%)")
        other.set_xlim(-3, 103)
        figure.legend(loc="outside lower center", ncols=5, fontsize=9)
        return {"troubles": figure}


@dataclass(frozen=True)
class CellName:
    """The kind of places, the number of the survey and the condition of a cell."""

    world: World
    survey: int
    trouble: Trouble

    @classmethod
    def of(cls, key: str) -> "CellName":
        """Return what a key names."""
        world, number, trouble = key.split("-", 2)
        return cls(World(world), int(number), Trouble(trouble))

    def __str__(self) -> str:
        return f"{self.world.value}-{self.survey:03d}-{self.trouble.value}"


def kind(trouble: Trouble) -> Trouble:
    """Return the condition whose map a condition has."""
    if trouble is Trouble.SUITE_STATED:
        return trouble
    return Trouble.SUITE if trouble.wrong_suite else Trouble.CLEAN


def row_of(world: World, trouble: Trouble, found: list[JudgedSensor]) -> TroubleRow:
    """Return what came of a condition."""
    known = [each for each in found if each.distance is not None]
    passed = [each for each in known if each.level == Level.PASS.value]
    return TroubleRow(
        world=world,
        trouble=trouble,
        levels=(count(found, Level.PASS), count(found, Level.WARN), count(found, Level.FAIL)),
        determined=len(known),
        nees_t=mean_of([each.distance_t for each in known]),
        nees=mean_of([each.distance for each in known]),
        held=within([each.distance for each in known], DOF),
        passed_t=within([each.distance_t for each in passed], DOF_T),
        passed=within([each.distance for each in passed], DOF),
        flagged=sum(each.unmodelled > 1 for each in found),
        alone_t=by_check(known, "t"),
        alone_C=by_check(known, "C"),
        alone_H=by_check(known, "H"),
        error_m=rms_of([each.error_m for each in known]),
        sigma_m=rms_of([each.sigma_m for each in known]),
    )


def count(found: list[JudgedSensor], level: Level) -> int:
    """Return how many were judged so."""
    return sum(each.level == level.value for each in found)


def within(distances: list[Any], dof: int) -> Share | None:
    """Return how many squared distances lie within the ellipsoid of 95 %."""
    if not distances:
        return None
    return Share(int(ellipsoid_coverage(np.array(distances), dof).sum()), len(distances))


def by_check(known: list[JudgedSensor], name: str) -> Share | None:
    """Return how many 95 % ellipsoids of the check alone hold the truth in t, C or H."""
    held = [each.alone[name] for each in known if each.alone]
    return Share(sum(held), len(held)) if held else None


TROUBLES = TroublesStudy()
