"""What is asked by the name of a sensor goes through names, as a dict does."""

import pytest

from l2m_gtsam.errors import NoSuchNameError
from l2m_gtsam.records.verdict import SensorVerdict, Verdict


def test_names_are_gone_through_and_looked_for() -> None:
    verdict = Verdict.of([], [SensorVerdict.of(name, []) for name in ("mag_00", "mag_01")])
    assert list(verdict) == ["mag_00", "mag_01"]
    assert [verdict[name] for name in verdict] == list(verdict.sensors)
    assert "mag_00" in verdict
    assert "mag_02" not in verdict
    assert 0 not in verdict
    with pytest.raises(NoSuchNameError, match="'mag_02'; there are mag_00, mag_01"):
        verdict["mag_02"]
