"""The most memory of a process is in MiB on every system."""

import resource
import sys
from types import SimpleNamespace

import pytest

from l2m_gtsam.batch import online_slam


@pytest.mark.parametrize(("system", "peak"), [("linux", 300 << 10), ("darwin", 300 << 20)])
def test_the_unit_of_the_system_counts(
    monkeypatch: pytest.MonkeyPatch, system: str, peak: int
) -> None:
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(resource, "getrusage", lambda _: SimpleNamespace(ru_maxrss=peak))
    assert online_slam.peak_mib() == 300
