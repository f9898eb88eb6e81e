"""What the cells of Table I share."""

from typing import Any

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate.route import RouteShape
from l2m_gtsam.studies.methods import MethodResult
from l2m_gtsam.studies.naive_peer import NaiveMap
from l2m_gtsam.studies.site import surveyed
from l2m_gtsam.studies.table1.cells import SurveyedWarehouse, Table1Options, compute
from l2m_gtsam.studies.table1.methods import HARMONIC
from tests.worlds.study_sites import one_row_site

CELLS = "l2m_gtsam.studies.table1.cells"
NONE = np.full(15, np.nan)


def test_the_naive_map_is_the_same_whichever_cell_asks_for_it_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options = Table1Options(
        noises=(0.1, 0.5), paths=(RouteShape.CIRCLES,), bounds=1, site=one_row_site(0.1)
    )
    site, lines = surveyed(options.site), list[FloatArray]()

    def of_line(points: FloatArray, field: FloatArray, path: FloatArray, _: Any) -> NaiveMap:
        lines.append(path)
        return NaiveMap((), len(points))

    monkeypatch.setattr(f"{CELLS}.naive_map", of_line)
    monkeypatch.setattr(f"{CELLS}.naive_peer", lambda *_: NONE)
    monkeypatch.setattr(f"{CELLS}.one_key", lambda *_: MethodResult(NONE[None], 1, 0.0))
    monkeypatch.setattr(f"{CELLS}.other_ends", lambda *_: [])
    for level, number in ((0, 1), (1, 2)):
        maps: dict[str, Any] = {HARMONIC: None}
        compute(options, SurveyedWarehouse(site, maps), level, 0, number)
    np.testing.assert_array_equal(lines[0], lines[1])
