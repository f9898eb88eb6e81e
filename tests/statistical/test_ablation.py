"""The ablation study: its errors and comparisons, and the whole of it at a tiny size."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

from l2m_gtsam.calibration.start.global_start import StartOptions
from l2m_gtsam.data import FloatArray
from l2m_gtsam.studies.ablation.cells import (
    AblationCell,
    AblationOptions,
    BatchErrors,
    Solver,
    map_options,
)
from l2m_gtsam.studies.ablation.map_image import MapImage, WindowOptions
from l2m_gtsam.studies.ablation.study import ABLATION
from l2m_gtsam.studies.ablation.table import AblationTable, ablation_table, gain
from l2m_gtsam.studies.json_arrays import STEP, Packed
from l2m_gtsam.studies.site import LAYER, thinned_rows
from tests.support.inline_study import run_inline
from tests.worlds.study_sites import one_row_site

TINY = AblationOptions(
    batches=2,
    batch=1,
    kinds=("bilinear", "sliding_gp"),
    spacings=(0.0, 1.5),
    window=WindowOptions(width=4.0, height=3.0, step=0.5),
    site=one_row_site(0.1),
    search=StartOptions(search_radius=1.0, poses=20, basins=2),
)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ablation")


@pytest.fixture(scope="module")
def table(out: Path) -> AblationTable:
    return run_inline(ABLATION, TINY, out)


def test_every_combination_of_map_density_and_method_is_there(table: AblationTable) -> None:
    found = {(row.kind, row.spacing, row.solver) for row in table.rows}
    assert found == {(k, s, m) for k in TINY.kinds for s in TINY.spacings for m in Solver}
    assert all((row.calibrations, row.failed) == (2, 0) for row in table.rows)


def test_thinner_fingerprints_make_a_worse_map(table: AblationTable) -> None:
    for kind in TINY.kinds:
        dense, sparse = (each.picture for each in table.maps if each.kind == kind)
        assert sparse.readings < dense.readings / 4
        assert sparse.rmse > dense.rmse


def test_every_method_comes_near_on_a_map_of_the_whole_survey(table: AblationTable) -> None:
    for row in table.rows:
        if (row.kind, row.spacing) == ("sliding_gp", 0.0):
            assert row.t is not None
            # Guesses are up to 30 cm off; 200 readings leave a few centimetres, with the paper's
            # weights, which trust few of them, more.
            assert row.t.median < 0.25, str(row)


def test_page_and_figures_are_made_of_the_file(out: Path, table: AblationTable) -> None:
    page = (out / "ablation.md").read_text(encoding="utf-8")
    assert ABLATION.page(table) in page
    for name in re.findall(r"!\[.*\]\((.*)\)", page):
        assert (out / name).stat().st_size > 10_000
    assert json.loads((out / "study.json").read_text())["summary"]["rows"][0]["solver"] == "OLS"


def picture() -> MapImage:
    """A map that is a fifth of a microtesla off everywhere."""
    truth = np.full((3, 4), 50.0)
    box = (0.0, 4.0, 0.0, 3.0)
    return MapImage(box, 0.5, truth + 0.2, truth, np.zeros((2, 2)), 100, 10.0, 0.2, 0.1, 1.0)


def made_up(H: dict[tuple[str, float], dict[Solver, float]]) -> AblationTable:
    """A table of ten drives; errors of H per map and method, 1 where none is given."""
    rng = np.random.default_rng(1)
    drives = rng.uniform(-0.01, 0.01, (10, 1))
    cells = {}
    for place in [(kind, spacing) for kind in MADE_UP.kinds for spacing in MADE_UP.spacings]:
        errors = np.array([[H.get(place, {}).get(solver, 1.0) for solver in Solver]]) + drives
        batch = BatchErrors(errors / 100, errors / 10, errors)
        cells[place] = [AblationCell(picture=picture()), AblationCell(batch=batch)]
    return ablation_table(MADE_UP, cells)


MADE_UP = AblationOptions(kinds=("bilinear", "sliding_gp"), spacings=(0.0, 1.0))


def test_gains_are_paired() -> None:
    table = made_up({("sliding_gp", 1.0): dict.fromkeys(Solver, 0.25)})
    dense, sparse = table.map_gains
    assert dense.H is not None
    assert sparse.H is not None
    # All drives differ by the same: what drives do to both sides leaves nothing but rounding.
    assert (dense.H.mean, dense.H.margin) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert (sparse.H.mean, sparse.H.margin) == pytest.approx((0.75, 0.0), abs=1e-12)
    assert sparse.H.better == 1.0


def test_the_page_says_what_the_paper_claims_and_what_came_out() -> None:
    far = dict.fromkeys(Solver, 3.0)
    near = dict.fromkeys(Solver, 2.5)
    held = made_up({("bilinear", 0.0): near, ("bilinear", 1.0): far})
    assert "the gain is over 0.2 uT at the densest, and clearly larger" in ABLATION.page(held)
    failed = made_up({("bilinear", 0.0): dict.fromkeys(Solver, 1.1)})
    said = "the gain is not over 0.2 uT at the densest, and not clearly larger"
    assert said in ABLATION.page(failed)


def test_the_page_counts_maps_on_which_weights_help() -> None:
    better, worse = {Solver.PAPER: 0.5}, {Solver.PAPER: 2.0}
    table = made_up({("bilinear", 0.0): better, ("bilinear", 1.0): worse})
    gains = [each.H for each in table.weight_gains if each.to == Solver.PAPER.value]
    assert [round(each.mean, 6) for each in gains if each is not None] == [0.5, 0.0, -1.0, 0.0]


def test_calibrations_without_a_result_are_counted_and_left_out() -> None:
    lost = np.array([[np.nan], [1.0], [3.0]]) * np.ones((1, len(Solver)))
    batch = BatchErrors(lost, lost, lost)
    cells = [AblationCell(picture=picture()), AblationCell(batch=batch)]
    options = AblationOptions(kinds=("bilinear",), spacings=(0.0,))
    row = ablation_table(options, {("bilinear", 0.0): cells}).rows[0]
    assert (row.calibrations, row.failed, row.far) == (3, 1, 2)  # 1 and 3 m are another minimum
    assert row.t is not None
    assert (row.t.mean, row.t.largest) == (2.0, 3.0)


def test_rounding_is_no_difference() -> None:
    errors = np.linspace(1.0, 2.0, 9)
    same = gain(errors, errors - 1e-9)
    assert same is not None
    assert (same.sure, same.better) == (False, 0.0)


def test_without_pairs_there_is_no_gain() -> None:
    assert gain(np.array([1.0, np.nan]), np.array([np.nan, 1.0])) is None


def test_a_bilinear_grid_is_no_finer_than_its_fingerprints() -> None:
    base = TINY.site.mapping.model
    assert map_options(base, "bilinear", 1.0).bilinear.spacing == 1.0
    assert map_options(base, "bilinear", 0.0).bilinear == base.bilinear
    assert map_options(base, "bilinear", 1.0).kind == "bilinear"


@given(spacing=st.floats(0.3, 2.0), seed=st.integers(0, 1000))
def test_thinning_leaves_one_reading_in_each_cell_and_height(spacing: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([0, 0, 0.3], [6.0, 6.0, 1.0], (400, 3))
    kept = points[thinned_rows(points, spacing)]
    cells = {tuple(row) for row in np.floor(points / [spacing, spacing, LAYER]).astype(int)}
    left = [tuple(row) for row in np.floor(kept / [spacing, spacing, LAYER]).astype(int)]
    assert len(left) == len(set(left))
    assert set(left) == cells


def test_no_spacing_keeps_the_whole_survey() -> None:
    assert thinned_rows(np.zeros((7, 3)), 0.0).tolist() == list(range(7))


@given(st.lists(st.floats(-1000, 1000) | st.just(float("nan")), min_size=1, max_size=20))
def test_pictures_come_back_rounded(values: list[float]) -> None:
    adapter: TypeAdapter[FloatArray] = TypeAdapter(Packed)
    before = np.array([values])
    back = adapter.validate_json(adapter.dump_json(before))
    assert back.shape == before.shape
    np.testing.assert_array_equal(np.isnan(back), np.isnan(before))
    # Half a step, and what the double that stands for it is off.
    np.testing.assert_allclose(back, before, rtol=0, atol=STEP / 2 + 1e-9)
