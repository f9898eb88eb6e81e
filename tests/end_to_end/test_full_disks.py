"""Disks that are full in the middle of a command: old results or new ones, one line, no parts."""

from pathlib import Path

import pytest

from tests.fuzz.corpus import make_demo
from tests.fuzz.full_disks import filled, may_mount
from tests.fuzz.trials import BAD, break_all, commands, table

DISKS = 20


@pytest.mark.study
def test_full_disks(tmp_path: Path) -> None:
    if not may_mount(tmp_path / "disk"):
        pytest.skip("a small file system cannot be mounted here")
    make_demo(tmp_path / "demo")
    found = break_all(filled, commands(tmp_path, tmp_path / "demo"), DISKS, tmp_path, seed=0)
    print(table(found))
    assert not {left for _, left in found} & set(BAD)
