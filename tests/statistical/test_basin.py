"""The basin study: its counts, that it repeats itself, and (`make study`) what it promises."""

import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.stats import binomtest

from l2m_gtsam.calibration.one_key import solve_one_key
from l2m_gtsam.calibration.start.global_start import find_starts
from l2m_gtsam.parallel.cluster import ClusterOptions
from l2m_gtsam.studies.basin.cells import (
    DRIVE,
    BasinOptions,
    DistortionCells,
    RingCell,
    basin_table,
    cells_of,
)
from l2m_gtsam.studies.basin.study import BASIN
from l2m_gtsam.studies.run import run_study
from l2m_gtsam.studies.site import mapped_site, random_drive
from l2m_gtsam.studies.statistics import Share
from tests.worlds.study_sites import TINY_BASIN as TINY


@lru_cache
def tiny_cells() -> tuple[RingCell, ...]:
    return cells_of(TINY, mapped_site(TINY.site), 0).rings


def made_up(distortion: int, ring: int, errors: list[float]) -> RingCell:
    """A cell where one-key ends with these errors, LM never moves, and published leaves the map."""
    count = len(errors)
    t_start = np.full((count, 3), 1.0)
    return RingCell(
        distortion=distortion,
        ring=ring,
        t_true=np.zeros(3),
        t_start=t_start,
        t_found=t_start,
        ambiguous=np.arange(count) == 0,
        t_one_key=np.array(errors)[:, None] * np.array([1.0, 0.0, 0.0]),
        t_published=np.full((min(count, TINY.few_starts), 3), np.nan),
        t_lm=t_start[: TINY.few_starts],
    )


def test_one_key_finds_the_sensor_from_every_start() -> None:
    table = basin_table(TINY, tiny_cells())
    assert [(row.inner, row.outer) for row in table.rows] == [(0.0, 1.5), (1.5, 3.0)]
    for row in table.rows:
        assert row.one_key.medium == Share(3, 3)
        assert row.lm.medium.trials == 2
    assert table.all_medium == Share(1, 1)


def test_starts_lie_in_their_ring() -> None:
    for each in tiny_cells():
        offset = each.error(each.t_start) / TINY.width
        assert ((offset >= each.ring) & (offset < each.ring + 1)).all()


def test_a_ring_repeats_itself_also_without_the_others() -> None:
    alone = TINY.model_copy(update={"rings": 1})
    (again,) = cells_of(alone, mapped_site(TINY.site), 0).rings
    for name, value in vars(tiny_cells()[0]).items():
        # Descents go in step with those of other starts: sums over other batches round otherwise.
        np.testing.assert_allclose(getattr(again, name), value, rtol=1e-9, atol=1e-9)


def test_a_start_is_solved_as_the_product_does() -> None:
    site = mapped_site(TINY.site)
    rng = np.random.default_rng([TINY.seed, 0, 0, DRIVE])
    readings = random_drive(site, TINY.site, rng).readings
    for each in tiny_cells():
        found = find_starts(readings, site.field_map, each.t_start[2], TINY.search)[0]
        assert found is not None
        solution = solve_one_key(readings, site.field_map, found.t_lidar_mag[None], TINY.solve)
        # Rounding, as above; the solve ends where its steps are far below a micrometre.
        np.testing.assert_allclose(each.t_found[2], found.t_lidar_mag, rtol=0, atol=1e-9)
        np.testing.assert_allclose(each.t_one_key[2], solution.estimate.t[0], rtol=0, atol=1e-6)


def test_all_cells_of_a_distortion_share_its_sensor_and_no_two_their_starts() -> None:
    near, far = tiny_cells()
    np.testing.assert_array_equal(near.t_true, far.t_true)
    assert not np.allclose(near.t_start - near.t_true, far.t_start - far.t_true)


def test_the_table_counts_what_cells_hold() -> None:
    cells = [made_up(0, 0, [0.01, 0.03, np.nan]), made_up(1, 0, [0.06, 0.02])]
    (row,) = basin_table(TINY, cells).rows
    assert (row.one_key.small, row.one_key.medium) == (Share(2, 5), Share(3, 5))
    assert (row.lm.small, row.lm.medium) == (Share(0, 4), Share(0, 4))
    assert row.published.medium == Share(0, 4)  # off the map: no result
    # Ambiguous are the first of both cells; of the others 3 cm and the missing one are wrong.
    assert (row.ambiguous, row.unwarned) == (2, 2)


def test_a_distortion_counts_where_every_start_of_every_ring_succeeded() -> None:
    good, fair, bad, none = [0.01, 0.02], [0.01, 0.04], [0.06, 0.01], [np.nan, 0.01]
    outcomes = [(good, good), (good, fair), (bad, good), (good, none)]
    cells = [
        made_up(d, ring, e) for d, rings in enumerate(outcomes) for ring, e in enumerate(rings)
    ]
    table = basin_table(TINY, cells)
    assert (table.all_small, table.all_medium) == (Share(1, 4), Share(2, 4))
    assert "1 of 4" in BASIN.page(table)


def test_table_and_figure_say_how_many_starts_each_method_got() -> None:
    cells = [made_up(0, 0, [0.01, 0.01, 0.01]), made_up(1, 0, [0.01, 0.01])]
    table = basin_table(TINY, cells)
    line = re.search("^[|] 0.00.*", BASIN.page(table), flags=re.M)
    assert line is not None
    cells_of_line = line[0].split(" | ")
    assert (cells_of_line[1], cells_of_line[6]) == ("5", "4")
    (axes,) = BASIN.figures(table)["basin"].axes
    _, legend = axes.get_legend_handles_labels()
    assert "LM, within 2 cm (4 starts a ring)" in legend
    assert "one-key, within 2 cm (5 starts a ring)" in legend


@pytest.mark.parametrize(("successes", "trials"), [(0, 20), (7, 20), (1995, 2000), (2000, 2000)])
def test_intervals_are_wilsons(successes: int, trials: int) -> None:
    expected = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    assert Share(successes, trials).interval == pytest.approx((expected.low, expected.high))


def test_cells_come_back_from_json() -> None:
    lost = replace(tiny_cells()[0], t_one_key=np.full((3, 3), np.nan))
    adapter = TypeAdapter(DistortionCells)
    cells = DistortionCells((lost, tiny_cells()[1]))
    back = adapter.validate_json(adapter.dump_json(cells))
    for before, after in zip(cells.rings, back.rings, strict=True):
        for name, value in vars(before).items():
            np.testing.assert_array_equal(getattr(after, name), value)


@pytest.mark.study
def test_the_global_start_forgives_any_guess_within_three_metres(tmp_path: Path) -> None:
    """The paper's protocol: 99.5 % within 2 cm in every ring, where plain LM falls off."""
    cluster = ClusterOptions(workers=2)
    table = run_study(BASIN, BasinOptions(), tmp_path, cluster, lambda *_: None, "").summary
    assert len(table.rows) == 12
    for row in table.rows:
        assert row.one_key.small.trials == 2000
        assert row.one_key.small.rate >= 0.995, str(row)
        assert row.lm.small.trials == 400
    assert table.rows[-1].lm.medium.rate < 0.5
