"""A command shows its first bar before it loads what it computes with."""

import json
import os
import subprocess
import sys

import pytest

HEAVY = (
    "dask",
    "gtsam",
    "jinja2",
    "l2m_gtsam.batch",
    "l2m_gtsam.config",
    "matplotlib",
    "numba",
    "numpy",
    "rosbags",
    "ruamel",
    "scipy",
    "sklearn",
)
LOADED = f"import json, sys; print(json.dumps([each for each in {HEAVY} if each in sys.modules]))"
# Each command in a fork of a process that has loaded the command line and nothing else: at its
# first bar it says what is loaded, and ends.
AT_THE_FIRST_BAR = f"""
import json
import os
import sys
from rich.progress import Progress
from l2m_gtsam.cli.app import main

def start(self):
    exec({LOADED!r})
    sys.stdout.flush()
    os._exit(0)

Progress.start = start
for words in json.loads(sys.argv[1]):
    sys.stdout.flush()
    child = os.fork()
    if not child:
        sys.argv = ["l2m", *words]
        main()
        os._exit(1)
    if os.waitpid(child, 0)[1]:
        sys.exit(f"{{words}} has no bar")
"""
COMMANDS = {
    "apply": "a.mcap --calibration c.yaml --out b.mcap",
    "batch": "bags --map m.npz --out out",
    "calibrate": "a.mcap --map m.npz --out out",
    "demo": "--out out",
    "inspect": "a.mcap",
    "map build": "a.mcap --out m.npz",
    "map compare": "a.mcap",
    "map info": "m.npz",
    "map plot": "m.npz --out m.png",
    "map suite": "a.mcap --out s.yaml",
    "map update": "m.npz a.mcap --out n.npz",
    "plan": "a.mcap --map m.npz",
    "report": "out",
    "simulate": "--out out",
    "slam": "a.mcap --calibration c.yaml --out out",
    "study": "table1 --out out",
    "validate": "a.mcap --calibration c.yaml --map m.npz",
}


def said(code: str, *arguments: str) -> list[list[str]]:
    """What a program prints, line by line."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "FORCE_COLOR": "1"},  # as a terminal: elsewhere stages are lines
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.fixture(scope="module")
def loaded() -> dict[str, list[str]]:
    """What is loaded at the first bar of each command."""
    words = [[*name.split(), *arguments.split()] for name, arguments in COMMANDS.items()]
    return dict(zip(COMMANDS, said(AT_THE_FIRST_BAR, json.dumps(words)), strict=True))


def test_the_command_line_loads_nothing_heavy() -> None:
    assert said(f"import l2m_gtsam.cli.app; {LOADED}") == [[]]


@pytest.mark.parametrize("command", COMMANDS)
def test_the_first_bar_comes_before_all_that_is_heavy(
    loaded: dict[str, list[str]], command: str
) -> None:
    assert loaded[command] == []


def test_calibrations_and_slam_load_no_statistics_and_no_other_peers() -> None:
    """They take half a second for a quantile, or are for studies only."""
    loaded = "[each for each in ('scipy.stats', 'sklearn', 'dask') if each in sys.modules]"
    named = ("drives", "fleet", "online_slam", "reports", "slam", "validation")
    modules = ", ".join(f"l2m_gtsam.batch.{each}" for each in named)
    needed = f"import json, sys, {modules}"
    assert said(f"{needed}; print(json.dumps({loaded}))") == [[]]
