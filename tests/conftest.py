"""Fixtures shared by all tests."""

import gc
import os
from pathlib import Path

import pytest
from hypothesis import settings

from tests.support import kept
from tests.support.browser_tools import find_tools
from tests.support.repository import REPOSITORY

# Machines are as fast as they are, and the first call of a compiled function compiles it.
# Each run draws its own examples: fewer of them in a run, and many over the runs.
settings.register_profile("l2m", deadline=None, max_examples=40)
settings.load_profile("l2m")


def pytest_collection_finish() -> None:
    """Take what was imported out of the garbage collector's rounds: a twentieth of the time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _kept_by_this_run(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Let all workers of a run find what one of them has computed."""
    kept.begin(tmp_path_factory)


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Recordings that others made; they are not part of the project and may be absent."""
    path = Path(os.environ.get("L2M_SHARED_DATA", REPOSITORY.parent / "shared" / "data"))
    if not (path / "bags").is_dir():
        reason = f"no shared recordings at {path}; set L2M_SHARED_DATA to their folder"
        if os.environ.get("L2M_REQUIRE_SHARED") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return path


@pytest.fixture(scope="session")
def browser() -> str:
    """Path of a browser that can be told what to do."""
    return find_tools()
