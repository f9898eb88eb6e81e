"""Paths in place of what is read from them: one line says what reads them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import l2m_gtsam
from l2m_gtsam.api.arguments import READERS
from l2m_gtsam.errors import InputError

BAG, MAP, FILE = "drive.bag", Path("map.npz"), "calibration.yaml"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda api: api.calibrate(BAG, None), r"recording: 'drive\.bag' .* `l2m_gtsam\.read_bag`"),
        (lambda api: api.calibrate([BAG], None), "recording: .* `l2m_gtsam.read_bag`"),
        (lambda api: api.calibrate(None, MAP), r"field_map: 'map\.npz' .*`l2m_gtsam\.load_map`"),
        (lambda api: api.localise(None, FILE), "calibration: .* `l2m_gtsam.read_calibration`"),
        (lambda api: api.build_map([BAG, BAG]), "surveys: .* `l2m_gtsam.read_bag`"),
        (lambda api: api.keep_map_up(None, BAG, []), "drives: .* `l2m_gtsam.read_bag`"),
    ],
)
def test_a_path_is_refused_with_what_reads_it(call: Callable[[Any], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        call(l2m_gtsam)


def test_what_reads_them_is_there() -> None:
    assert set(READERS.values()) <= set(l2m_gtsam.__all__)
