"""A drive in a map that is localised on line, for tests of several files."""

import pytest

from l2m_gtsam.slam.online.replay import messages
from tests.drives.online import Hall, OnlineRun, driven, in_map, online_hall


@pytest.fixture(scope="session")
def hall() -> Hall:
    return online_hall()


@pytest.fixture(scope="session")
def plain(hall: Hall) -> OnlineRun:
    """Return the drive as it is localised without faults."""
    return driven(in_map(hall), messages(hall[1].recording))
