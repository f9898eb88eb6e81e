"""The honesty study: one small run over its whole path, and its judgement of made-up cells."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.studies.honesty.cells import HonestyCell, Stated, bound_of, cell_of
from l2m_gtsam.studies.honesty.drives import Condition, HonestyOptions, drive_through, mapped_hall
from l2m_gtsam.studies.honesty.study import HONESTY
from l2m_gtsam.studies.honesty.summary import (
    NAMES,
    ConsistencyVerdict,
    HonestySummary,
    honesty_summary,
)
from l2m_gtsam.studies.methods import cramer_rao
from tests.support.inline_study import run_inline
from tests.worlds.quick_maps import quick

TINY = HonestyOptions(
    surveys=2,
    drives=1,
    noises=(0.2,),
    troubled_noises=(0.2,),
    readings=120,
    survey_readings=400,
    map=quick("harmonic"),
)
MADE_UP = HonestyOptions(surveys=20, drives=10, noises=(0.2,), troubled_noises=())
# Metres, ratios, microtesla, seconds, as calibrations have them.
SIGMAS = np.repeat([3e-3, 1e-3, 0.3, 2e-3], [3, 9, 3, 1])


def covariance(seed: int) -> FloatArray:
    """A covariance of all parameters with correlations."""
    root = np.eye(16) + 0.4 * np.random.default_rng(seed).normal(size=(16, 16)) / 4
    root /= np.linalg.norm(root, axis=1, keepdims=True)
    return np.asarray(SIGMAS[:, None] * (root @ root.T) * SIGMAS)


def made_up(told: float = 1.0, least: float = 1.0, shared: float = 0.0) -> list[HonestyCell]:
    """Cells of errors of a known covariance.

    Stated are covariances times ``told``; the bound is that of sigmas times ``least``, and
    ``shared`` the share of the variance that all drives of a survey have in common.
    """
    rng, P = np.random.default_rng(8), covariance(9)
    root, shape = np.linalg.cholesky(P), (MADE_UP.drives, 16)
    cells = []
    for survey in range(MADE_UP.surveys):
        own = np.sqrt(1 - shared) * rng.normal(size=shape)
        error = (own + np.sqrt(shared) * rng.normal(size=16)) @ root.T
        stated = Stated(error, np.tile(told * P, (len(error), 1, 1)))
        bound = np.tile(least**2 * P, (len(error), 1, 1))
        cells.append(HonestyCell(Condition.CLEAN, 0.2, survey, stated, stated, bound))
    return cells


def judged(cells: list[HonestyCell]) -> ConsistencyVerdict:
    return honesty_summary(MADE_UP, cells).of(Uncertainty.FULL)[0]


def test_true_covariances_are_found_true() -> None:
    verdict = judged(made_up())
    assert (verdict.wanted, verdict.solved, verdict.determined) == (200, 200, 200)
    assert [row.name for row in verdict.blocks] == ["t", "C, H", "all", "offset"]
    assert verdict.consistent
    assert tuple(row.name for row in verdict.parameters) == NAMES
    # Of 32 figures each is out of its 95 % band by chance once in 20: 1.6, and 6 once in 200.
    out = sum(row.z_std not in row.z_band for row in verdict.parameters)
    out += sum(0.95 not in row.interval for row in verdict.parameters)
    assert out <= 6
    for row in verdict.bounds:
        # 200 squares of three errors or more: their root mean is known to 3 %, of one to 5 %.
        assert row.ratio == pytest.approx(1.0, abs=0.15)
        assert row.interval.low < row.ratio < row.interval.high
    counts = {each.name: sum(each.counts) for each in verdict.histograms}
    assert counts == {"t": 600, "C": 1800, "H": 600, "offset": 200}


@pytest.mark.parametrize("told", [0.5, 2.0])
def test_covariances_of_wrong_size_are_called_out(told: float) -> None:
    true, verdict = judged(made_up()), judged(made_up(told))
    assert not verdict.consistent
    for row, right in zip(verdict.blocks, true.blocks, strict=True):
        assert row.honesty.nees == pytest.approx(right.honesty.nees / told)
        assert not row.honesty.consistent, row.name
    for one, right_one in zip(verdict.parameters, true.parameters, strict=True):
        assert one.z_std == pytest.approx(right_one.z_std / np.sqrt(told))
        assert (one.covered < right_one.covered) == (told < 1)
        assert one.z_std not in one.z_band, one.name
    side = "above it (sigmas too small)" if told < 1 else "below it (sigmas too large)"
    page = HONESTY.page(honesty_summary(MADE_UP, made_up(told)))
    assert f"NEES of t, (C, H), all together and the time offset {side}" in page


def test_bands_widen_where_drives_share_their_errors() -> None:
    """With errors common to ten drives, twenty surveys say no more than twenty drives."""
    apart, common = judged(made_up()), judged(made_up(shared=0.999))
    for name in range(3):
        wide, narrow = common.blocks[name].honesty, apart.blocks[name].honesty
        # sqrt(10) = 3.2 times as wide; the effective number is clipped to 20 at the least.
        assert wide.band.high - wide.band.low > 2 * (narrow.band.high - narrow.band.low)
        assert wide.narrow == narrow.narrow


def test_errors_are_held_against_the_bound() -> None:
    ratio = judged(made_up()).bounds[0].ratio
    far = judged(made_up(least=0.5)).bounds[0]
    assert far.ratio == pytest.approx(2 * ratio)
    page = HONESTY.page(honesty_summary(MADE_UP, made_up(least=0.5)))
    assert f"the error of t is {far.ratio:.2f} times the bound (" in page
    assert ", beyond the 1.3 aimed at" in page


def test_offsets_are_judged_where_they_are_known() -> None:
    """As on drives whose motion is not known: variance infinite, in cells null, then NaN."""
    cells = []
    for cell in made_up():
        covariances = cell.full.covariance.copy()
        covariances[:, 15, 15] = np.inf
        full = replace(cell.full, covariance=covariances)
        adapter = TypeAdapter(HonestyCell)
        cells.append(adapter.validate_json(adapter.dump_json(replace(cell, full=full))))
    verdict = judged(cells)
    assert [row.name for row in verdict.blocks] == ["t", "C, H", "all"]
    assert [row.name for row in verdict.bounds] == ["t", "C", "H"]
    assert len(verdict.parameters) == 15


def test_what_was_not_solved_or_determined_is_counted_and_left_out() -> None:
    cells = made_up()
    cells[0].full.error[0] = np.nan
    cells[0].full.covariance[0] = np.nan
    cells[1].full.covariance[2, 4, 4] = np.inf
    cells[2].bound[3] = np.nan
    cells[3].bound[4, 15, 15] = np.inf
    verdict = judged(cells)
    assert (verdict.wanted, verdict.solved, verdict.determined) == (200, 199, 197)
    assert sum(verdict.histograms[0].counts) == 3 * 197
    assert [row.name for row in verdict.bounds] == ["t", "C", "H"]


def test_one_survey_is_not_judged() -> None:
    verdict = judged(made_up()[:1])
    assert not verdict.blocks
    assert not verdict.consistent
    summary = HonestySummary(MADE_UP, (verdict,))
    assert "of too few surveys to judge" in HONESTY.page(summary)
    assert set(HONESTY.figures(summary)) == {"nees", "coverage", "zscores"}


def test_a_study_of_one_survey_is_refused() -> None:
    with pytest.raises(ValidationError, match="surveys"):
        HonestyOptions(surveys=1)


def test_a_map_that_does_not_know_its_errors_is_refused() -> None:
    with pytest.raises(ValidationError, match="accepted: harmonic"):
        HonestyOptions(map=quick("sliding_gp"))


def test_both_conditions_of_a_survey_share_its_map() -> None:
    names = HONESTY.keys(HonestyOptions())
    assert len(names) == len(set(names)) == 80
    places = [HONESTY.site(HonestyOptions(), name) for name in names]
    assert len(set(places)) == 60
    # Cells of one place come together, so that its map is made and let go once.
    changes = sum(a != b for a, b in pairwise(places))
    assert changes == 59


def test_the_study_runs_and_repeats_itself(tmp_path: Path) -> None:
    clean, troubled = run_inline(HONESTY, TINY, tmp_path).of(Uncertainty.FULL)
    assert (clean.condition, troubled.condition) == (Condition.CLEAN, Condition.TROUBLED)
    assert [row.name for row in clean.blocks] == ["t", "C, H", "all"]
    assert [row.name for row in troubled.blocks] == ["t", "C, H", "all", "offset"]
    for verdict in (clean, troubled):
        assert verdict.determined == verdict.wanted == 2
        # Two calibrations: chance alone makes t once in 10^4 errors 3.2 times their bound.
        assert verdict.bounds[0].ratio < 3.2
    assert {path.name for path in tmp_path.glob("*.png")} == {
        "nees.png",
        "coverage.png",
        "zscores.png",
    }
    key = HONESTY.keys(TINY)[1]
    cell = HONESTY.compute(TINY, key, HONESTY.prepare(TINY, HONESTY.site(TINY, key)))
    adapter = TypeAdapter(HonestyCell)
    kept = TypeAdapter(dict).validate_json((tmp_path / "cells" / f"{key}.json").read_bytes())
    assert adapter.dump_python(cell, mode="json") == kept["cell"]


def test_the_bound_is_what_the_solve_states_at_the_truth() -> None:
    """Solved from good data, sigmas come out within what the estimated noise leaves open.

    120 readings tell the noise to 1 / sqrt(2 * 360) = 4 %; linearised at the estimate in place of
    the truth they differ by a few per cent more.
    """
    # The bound knows of no bend of the frame.
    solve = TINY.solve.model_copy(update={"warp_m": 0.0})
    options = TINY.model_copy(update={"solve": solve})
    place = mapped_hall(options, 0.2, 0)
    cell = cell_of(options, place, Condition.CLEAN)
    stated, least = (
        np.sqrt(np.diagonal(each[0])[:15]) for each in (cell.full.covariance, cell.bound)
    )
    np.testing.assert_allclose(stated, least, rtol=0.2)
    drive = drive_through(TINY, place, Condition.CLEAN, 0)
    truth, readings = np.append(drive.drive.sensors[0].vector(), 0.0), drive.drive.readings
    bound = cramer_rao(readings, place.field_map, truth, 0.2, TINY.solve)
    np.testing.assert_allclose(np.sqrt(np.diagonal(bound)[:15]), least)
    # Half as many readings tell less of every parameter.
    spoilt = replace(drive, change=np.resize([0.0, 1.0], len(drive.change)))
    worse = np.sqrt(np.diagonal(bound_of(place, spoilt, TINY.solve))[:15])
    assert (worse > 1.1 * least).all()
