"""Commands that are killed: the results are those of before or of after, and the next run is well.

A few kills of a quick command in the gate; hundreds of all in the studies.
"""

import hashlib
import json
from pathlib import Path
from random import Random

import pytest

from l2m_gtsam.storage.result_set import SET_FILE
from tests.fuzz.corpus import make_demo
from tests.fuzz.kills import killed
from tests.fuzz.trials import BAD, Command, break_all, commands, files, prepared, table

FILES = Path(__file__).parents[1] / "files"
KILLS = 4  # of a command that takes half a second
ALL = 200  # in the studies


def test_a_killed_comparison_is_the_old_one_or_the_new_one(tmp_path: Path) -> None:
    names = ("calibration.yaml", "metrics.json")
    other = ("validate", "--calibration", "HERE/calibration.yaml")
    compared = (*other, "--compare", "HERE/calibration.yaml", "--out", "OUT")
    command = Command("validate", compared, compared, tuple(FILES / each for each in names))
    trial = prepared(command, tmp_path / "validate")
    left = [killed(trial, Random(seed)) for seed in range(KILLS)]  # noqa: S311 - repeatable
    assert not [each for each in left if each[0] in BAD]


def test_seconds_of_a_run_are_no_results(tmp_path: Path) -> None:
    """Two runs that took the same tenth of a second made a third one look like other results."""
    found = []
    for name, seconds, cells in (("a", 3.5, 1), ("b", 4.4, 1), ("c", 4.4, 2)):
        folder = tmp_path / name
        folder.mkdir()
        text = f'{{"made": {{"cells": {cells}, "core_seconds": {seconds}}}}}'
        (folder / "study.json").write_text(text)
        digest = hashlib.sha256(text.encode()).hexdigest()
        (folder / SET_FILE).write_text(json.dumps({"files": {"study.json": digest}}))
        found.append(files(folder))
    assert found[0] == found[1]
    assert found[1] != found[2]


@pytest.mark.study
def test_kills_at_random_moments(tmp_path: Path) -> None:
    make_demo(tmp_path / "demo")
    found = break_all(killed, commands(tmp_path, tmp_path / "demo"), ALL, tmp_path, seed=0)
    print(table(found))
    assert not {left for _, left in found} & set(BAD)
