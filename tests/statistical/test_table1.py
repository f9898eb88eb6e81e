"""Table I: one small run through the whole path, and its figures on made-up drives."""

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from pydantic import TypeAdapter

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate.route import RouteShape
from l2m_gtsam.studies.methods import as_published
from l2m_gtsam.studies.site import random_drive
from l2m_gtsam.studies.table1.cells import (
    Ends,
    SurveyedWarehouse,
    Table1Cell,
    Table1Options,
    compute,
    prepare,
)
from l2m_gtsam.studies.table1.methods import HARMONIC, NAIVE, OTHERS, OURS, SLIDING
from l2m_gtsam.studies.table1.study import TABLE1
from l2m_gtsam.studies.table1.summary import (
    BETTER,
    NOISES,
    Printed,
    Table1Summary,
    printed,
    summarise,
)
from tests.worlds.study_sites import one_row_site

NOISE = 0.2
TINY = Table1Options(
    noises=(NOISE,),
    paths=(RouteShape.CIRCLES,),
    distortions=1,
    starts=3,
    others=1,
    bounds=1,
    site=one_row_site(0.1),
)


@pytest.fixture(scope="module")
def place() -> SurveyedWarehouse:
    return prepare(TINY)


@pytest.fixture(scope="module")
def cells(place: SurveyedWarehouse) -> dict[str, Table1Cell]:
    return {key: compute(TINY, place, *map(int, key.split("-"))) for key in TABLE1.keys(TINY)}


@pytest.fixture(scope="module")
def summary(cells: Mapping[str, Table1Cell]) -> Table1Summary:
    return summarise(TINY, cells)


def test_our_method_comes_within_centimetres_from_every_start(summary: Table1Summary) -> None:
    ours = summary.entry(RouteShape.CIRCLES, NOISE, OURS, HARMONIC)
    assert (ours.calibrations, ours.lost, ours.far) == (3, 0, 0)
    # 170 readings a drive: the bound is about 8 mm.
    assert ours.t is not None
    assert ours.t.max < 0.05
    assert summary.solves <= ours.calibrations


def test_every_method_has_an_entry_on_its_maps(summary: Table1Summary) -> None:
    kinds = {(each.method, each.map_kind) for each in summary.entries}
    both = {(name, kind) for name in (*OTHERS, OURS) for kind in (HARMONIC, SLIDING)}
    assert kinds == both | {(NAIVE, "thinned GP")}
    others = [each for each in summary.entries if each.map_kind == SLIDING]
    assert {each.calibrations for each in others} == {TINY.others * TINY.other_starts}


def test_the_published_algorithm_off_the_map_has_no_result(place: SurveyedWarehouse) -> None:
    drive = random_drive(place.site, TINY.site, np.random.default_rng(1))
    away = np.array([500.0, 0.0, 0.0])
    assert np.isnan(as_published(drive.readings, place.maps[HARMONIC], away)).all()


def test_errors_are_near_their_bound(summary: Table1Summary) -> None:
    (bound,) = summary.bounds
    assert bound.drives == 1
    # One drive: an error of three dimensions beyond thrice its root mean square has p < 1e-5.
    for error, least in (
        (bound.t_error, bound.t),
        (bound.C_error, bound.C),
        (bound.H_error, bound.H),
    ):
        assert 0 < error < 3 * least


def test_cells_and_summary_come_back_from_json(
    cells: Mapping[str, Table1Cell], summary: Table1Summary
) -> None:
    adapter = TypeAdapter(Table1Cell)
    back = {key: adapter.validate_json(adapter.dump_json(cell)) for key, cell in cells.items()}
    assert summarise(TINY, back) == summary
    whole = TypeAdapter(Table1Summary)
    assert whole.validate_json(whole.dump_json(summary)) == summary


def test_the_page_has_all_parts(summary: Table1Summary) -> None:
    text = TABLE1.page(summary)
    for heading in ("Beside the paper", "All methods", "What any method could do at best"):
        assert f"## {heading}" in text
    assert "nan" not in text
    (figure,) = TABLE1.figures(summary).values()
    assert len(figure.axes) == len(TINY.noises)


def made_up(t: list[float], bound: float = 0.01) -> Table1Cell:
    """A drive of our method alone: errors of t as given, those of C and H small."""
    errors = np.array(t)
    small: FloatArray = np.full(len(t), 1e-4)
    ends = Ends(OURS, HARMONIC, errors, small, np.where(np.isfinite(errors), small, np.nan), 1.0)
    bounds = np.array([bound, 1e-4, 1e-4])
    return Table1Cell(NOISE, RouteShape.CIRCLES, 1000, 1, bounds, (ends,))


def test_errors_are_counted_and_squared() -> None:
    made = summarise(TINY, {"a": made_up([0.01, 0.03]), "b": made_up([0.06, np.nan])})
    (entry,) = made.entries
    assert (entry.calibrations, entry.lost, entry.far) == (4, 1, 1)
    assert entry.t is not None
    assert entry.t2 is not None
    assert entry.t.mean == pytest.approx((0.01 + 0.03 + 0.06) / 3)
    assert entry.t.max == 0.06
    assert entry.t2.mean == pytest.approx((0.01**2 + 0.03**2 + 0.06**2) / 3)
    (level,) = made.efficiency
    assert level.ratio == pytest.approx(np.sqrt((0.01**2 + 0.03**2 + 0.06**2) / 3) / 0.01)


def test_all_paths_together_are_one_set_of_errors() -> None:
    one, other = made_up([0.01, 0.03]), replace(made_up([0.06]), path=RouteShape.EIGHT)
    (entry,) = summarise(TINY, {"a": one, "b": other}).together
    assert entry.path is None
    assert entry.calibrations == 3
    assert entry.t is not None
    assert (entry.t.mean, entry.t.median) == pytest.approx((0.1 / 3, 0.03))


@pytest.mark.parametrize(("bound", "word"), [(0.001, "allows"), (0.1, "forbids")])
def test_a_row_that_misses_its_aim_is_named_with_its_bound(bound: float, word: str) -> None:
    aim = printed("t", 0, NOISE)
    assert aim is not None
    error = 1.1 * np.sqrt(aim.mean / BETTER)
    page = TABLE1.page(summarise(TINY, {"a": made_up([error], bound)}))
    assert re.search(f"^- .*path 1 at 0.2 uT.*the bound {word} it", page, flags=re.M)


def test_a_peer_that_knows_no_place_is_not_lost() -> None:
    nothing = np.full(2, np.nan)
    ends = Ends("peer", "-", nothing, nothing, np.array([1.0, np.nan]), 1.0)
    cell = made_up([0.01])
    made = summarise(TINY, {"a": replace(cell, ends=(*cell.ends, ends))})
    entry = made.entry(RouteShape.CIRCLES, NOISE, "peer", "-")
    assert (entry.calibrations, entry.lost, entry.far) == (2, 1, 0)
    assert entry.t is None
    assert entry.H is not None
    assert entry.H.mean == 1.0


def test_a_row_that_reaches_its_aim_is_not() -> None:
    made = summarise(TINY, {"a": made_up([0.001])})
    assert not list(made.shortfalls())
    assert "All rows reach it." in TABLE1.page(made)


def test_the_printed_table_is_the_papers() -> None:
    """Its bold entries, and nothing where it has no column."""
    columns = [[printed("t", row, noise) for row in range(5)] for noise in NOISES]
    assert [min(each.mean for each in column if each) for column in columns] == [
        0.0018,
        0.0017,
        0.0034,
    ]
    assert printed("C", 2, 0.1) == Printed(mean=0.0016, std=0.0023)
    assert printed("H", 5, 0.1) is None
    assert printed("H", 0, 0.3) is None
