"""Paths in place of what is read from them: one line says what reads them."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import l2m_gtsam
from l2m_gtsam.api.arguments import CALIBRATION, DRIVE, MAP, WHOLE_MAP
from l2m_gtsam.errors import InputError

BAG, FILE = "drive.bag", "calibration.yaml"
T, ROWS, B = np.arange(3.0), np.eye(3), 40 * np.eye(3)
RECORDING: Any = l2m_gtsam.drive(T, ROWS, np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)), {"m": (T, B)})
FIELD_MAP = SimpleNamespace(query=len, field_and_gradient=len, to_state=len)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda api: api.calibrate(BAG, None), r"recording: 'drive\.bag' .* `l2m_gtsam\.read_bag`"),
        (lambda api: api.calibrate([BAG], None), "recording: .* `l2m_gtsam.read_bag`"),
        (
            lambda api: api.calibrate(RECORDING, Path("map.npz")),
            r"field_map: 'map\.npz' .*`l2m_gtsam\.load_map`",
        ),
        (lambda api: api.localise(RECORDING, FILE), "calibration: .* `l2m_gtsam.read_calibration`"),
        (lambda api: api.build_map([BAG, BAG]), r"surveys\[0\]: .* `l2m_gtsam.read_bag`"),
        (lambda api: api.keep_map_up(FIELD_MAP, BAG, []), "drives: .* `l2m_gtsam.read_bag`"),
    ],
)
def test_a_path_is_refused_with_what_reads_it(call: Callable[[Any], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        call(l2m_gtsam)


def test_what_reads_them_is_there() -> None:
    assert {kind.reader for kind in (DRIVE, MAP, WHOLE_MAP, CALIBRATION)} <= set(l2m_gtsam.__all__)
