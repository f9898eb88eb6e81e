"""A process of a drive is a warning where it has a share in what is not known."""

from dataclasses import replace
from pathlib import Path

import pytest

from l2m_gtsam.qa.verdict.uncertainty import disturbance_reasons
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.error_budget import Disturbance, DisturbanceKind, ErrorCause, VarianceShare
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.calibration_file import read_calibration

FILE = Path(__file__).parents[2] / "files" / "calibration.yaml"


def with_share(share: float | None) -> CalibrationResult:
    """Return a calibration with a field that has a share of H's variance; None if none is told."""
    found = Disturbance(DisturbanceKind.FIELD, {"noise_ut": 0.01}, gain=20.0)
    result = replace(read_calibration(FILE), disturbances=(found,))
    if share is None:
        return result
    shares = (
        VarianceShare(ErrorCause.NOISE, t=1.0, C=1.0, H=1.0 - share),
        VarianceShare(ErrorCause.FIELD, t=0.0, C=0.0, H=share),
    )
    sensors = tuple(replace(each, variance_shares=shares) for each in result.sensors)
    return replace(result, sensors=sensors)


@pytest.mark.parametrize(
    ("share", "level"), [(0.05, Level.PASS), (0.3, Level.WARN), (None, Level.WARN)]
)
def test_only_a_share_in_a_variance_is_a_warning(share: float | None, level: Level) -> None:
    (reason,) = disturbance_reasons(with_share(share))
    assert reason.level is level
    assert "steel or currents" in reason.text
