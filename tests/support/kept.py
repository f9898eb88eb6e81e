"""Results that take long and that no test changes: computed once for all workers of a run."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

import pytest

from tests.support.made_once import made_once

Result = TypeVar("Result")
KEPT = "kept.pickle"
_factories: list[pytest.TempPathFactory] = []


def begin(factory: pytest.TempPathFactory) -> None:
    """Keep what is computed from now on in the folder of this run."""
    _factories[:] = [factory]


def kept(name: str, compute: Callable[[], Result]) -> Result:
    """Return a result by its name, a part of a path; the worker that asks first computes it."""
    if not _factories:
        raise RuntimeError("kept: no run of the tests has begun; tests/conftest.py begins one")
    here: list[Result] = []

    def make(folder: Path) -> None:
        here.append(compute())
        (folder / KEPT).write_bytes(pickle.dumps(here[0]))

    folder = made_once(_factories[0], f"kept-{name}", make)
    if here:
        return here[0]
    return cast("Result", pickle.loads((folder / KEPT).read_bytes()))  # noqa: S301 - our own
