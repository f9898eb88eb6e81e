"""Versions and the commit of what computes."""

import platform
import subprocess
from pathlib import Path

from l2m_gtsam.batch.software import commit_of, versions
from l2m_gtsam.calibration.calibrate import VERSIONED


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=a", "-c", "user.email=a@b")
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_packages_and_python_are_named() -> None:
    found = versions()
    assert {*VERSIONED, "python"} <= found.keys()
    assert found["python"] == platform.python_version()
    found.clear()
    assert versions()


def test_the_commit_of_a_checkout(tmp_path: Path) -> None:
    assert commit_of(tmp_path) == ""
    git(tmp_path, "init", "-q")
    assert commit_of(tmp_path) == ""
    (tmp_path / "a.py").write_text("1")
    git(tmp_path, "add", "a.py")
    git(tmp_path, "commit", "-qm", "first")
    commit = git(tmp_path, "rev-parse", "HEAD")
    assert commit_of(tmp_path) == commit
    (tmp_path / "a.py").write_text("2")
    assert commit_of(tmp_path) == f"{commit} with files changed since"
