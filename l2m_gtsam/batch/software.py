"""What computed a result: versions, and the commit where the program knows it."""

import json
import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path

from l2m_gtsam.calibration.calibrate import VERSIONED

PACKAGE = "l2m-gtsam"
TIMEOUT_S = 10
CHANGED = "-dirty"


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    packages = [(name, version(name)) for name in VERSIONED]
    found = commit_of(Path(__file__).parents[2]) or _installed_commit()
    commit = [("commit", found)] if found else []
    return (*packages, ("python", platform.python_version()), *commit)


def versions() -> dict[str, str]:
    """Return versions of the packages that compute, of Python, and the commit if it is known."""
    return dict(_versions())


def commit_of(checkout: Path) -> str:
    """Return the commit of a git checkout, and whether files are others; empty for no checkout."""
    if not (checkout / ".git").exists():
        return ""
    command = ["git", "-C", str(checkout), "describe", "--always", "--abbrev=40", "--exclude=*"]
    try:
        run = subprocess.run(  # noqa: S603 - all of it is ours
            [*command, f"--dirty={CHANGED}"],
            capture_output=True,
            check=True,
            timeout=TIMEOUT_S,
            text=True,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    commit = run.stdout.strip()
    if commit.endswith(CHANGED):
        return f"{commit.removesuffix(CHANGED)} with files changed since"
    return commit


def _installed_commit() -> str:
    """Return the commit that pip installed, if it did so from a repository (PEP 610)."""
    try:
        text = distribution(PACKAGE).read_text("direct_url.json")
        commit = json.loads(text or "{}").get("vcs_info", {}).get("commit_id", "")
    except (PackageNotFoundError, OSError, ValueError, AttributeError):
        return ""
    return commit if isinstance(commit, str) else ""
