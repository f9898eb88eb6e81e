"""The harmonic map that tests of several files ask, and the bound on what a test may learn."""

import pytest

from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from tests.worlds.harmonic import fitted_map, refuse_large_windows


@pytest.fixture(scope="session")
def harmonic() -> HarmonicMap:
    return fitted_map()


@pytest.fixture
def affordable(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_large_windows(monkeypatch)
