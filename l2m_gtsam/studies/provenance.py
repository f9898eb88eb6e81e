"""What made a study's numbers: version, commit, machine."""

import os
import platform
import subprocess
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from shutil import which

GIB = 2**30


@dataclass(frozen=True)
class Provenance:
    """What made a study's numbers.

    Attributes
    ----------
    command
        That makes them again.
    code
        Version, and commits where they are known, of the code that computed the cells.
    machines
        Classes of machine that computed them.
    cells
        How many there are.
    core_seconds
        That they took together.
    """

    command: str
    code: tuple[str, ...]
    machines: tuple[str, ...]
    cells: int
    core_seconds: float


@lru_cache(maxsize=1)
def code_version() -> str:
    """Return the version of this package, with the commit where it runs from a checkout."""
    git, folder = which("git"), Path(__file__).parents[1]
    released = version("l2m-gtsam")
    if git is None:
        return released
    # The folder of a checkout of something else would tell its commit.
    asked = [git, "-C", str(folder), "log", "-1", "--format=%h", "--", "."]
    said = subprocess.run(asked, capture_output=True, text=True, check=False)  # noqa: S603 - fixed words
    return f"{released} ({said.stdout.strip()})" if said.stdout.strip() else released


def machine_class() -> str:
    """Return processor architecture, number of cores and memory."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB
    python = platform.python_version()
    return f"{platform.machine()}, {os.cpu_count()} cores, {memory:.0f} GiB, Python {python}"
