"""What a calibration says of its drive is read as it was written."""

from dataclasses import replace
from pathlib import Path

import pytest

from l2m_gtsam.records.disturbance import Disturbance, DisturbanceKind
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from tests.support.repository import REPOSITORY


@pytest.mark.parametrize("sensor", [None, "mag"])
@pytest.mark.parametrize("kind", DisturbanceKind)
def test_disturbances(tmp_path: Path, kind: DisturbanceKind, sensor: str | None) -> None:
    known = read_calibration(REPOSITORY / "tests" / "files" / "calibration.yaml")
    found = Disturbance(kind, sensor, {"rotation_deg": 0.3, "lasting_s": 12.0}, 40.0)
    path = tmp_path / "calibration.yaml"
    write_calibration(path, replace(known, disturbances=(found,)))
    assert read_calibration(path).disturbances == (found,)
