"""What tests of a calibration over a map that knows its errors share."""

import pytest

from l2m_gtsam.data import Readings
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from tests.drives.uncertain import surveyed, turning_drive


@pytest.fixture(scope="session")
def field_map() -> HarmonicMap:
    return surveyed()


@pytest.fixture(scope="session")
def readings() -> Readings:
    return turning_drive()
