"""``l2m study``: a small study through the command line, and what it says to wrong input."""

import json
from pathlib import Path

import pytest

from l2m_gtsam.simulate.floor_plan import FloorPlanOptions
from l2m_gtsam.storage.yaml_file import write_yaml
from l2m_gtsam.studies import run
from tests.support.command_line import complaint_here, l2m
from tests.support.one_process import computed_here
from tests.worlds.halls import SMALL_HALL
from tests.worlds.study_sites import TINY_BASIN as TINY


def test_a_study_from_options_to_page_and_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One cell, in another process; the second run has one more to do, the third nothing."""
    hall = TINY.site.scenario.model_copy(
        update={"floor_plan": FloorPlanOptions.model_validate(SMALL_HALL["floor_plan"])}
    )
    site = TINY.site.model_copy(update={"scenario": hall})
    small = {"starts": 1, "few_starts": 1, "rings": 1, "site": site}
    one_start = TINY.model_copy(update=small)
    options, out = tmp_path / "tiny.yaml", tmp_path / "out"
    command = ("study", "basin", "--options", options, "--out", out, "--workers")
    write_yaml(options, one_start.model_dump(mode="json"), "Small.")
    first = l2m(*command, "1")
    assert "| 0.00-1.50 | 1 |" in first.out
    (cell,) = (out / "cells").glob("distortion-*.json")
    written = cell.stat().st_mtime_ns
    more = one_start.model_copy(update={"distortions": 2})
    write_yaml(options, more.model_dump(mode="json"), "Small.")
    monkeypatch.setattr(run, "computed", computed_here)
    second = l2m(*command, "1")
    assert "| 0.00-1.50 | 2 |" in second.out
    assert cell.stat().st_mtime_ns == written
    page = (out / "basin.md").read_text()
    assert second.out.splitlines()[0] in page
    assert "--seed 1`: 2 cells" in page
    assert (out / "basin.png").stat().st_size > 1000
    content = json.loads((out / "study.json").read_text())
    assert content["summary"]["rows"][0]["one_key"]["medium"] == {"successes": 2, "trials": 2}
    assert l2m(*command, "1").out == second.out


@pytest.mark.parametrize(
    ("options", "arguments", "words"),
    [
        ("{}", ["table2"], "study 'table2' is not known; accepted: table1, basin, ablation"),
        ("{rigns: 3}", ["basin"], "unknown key 'rigns'; accepted here: "),
        ("{rings: -3}", ["basin"], "rings: Input should be greater than or equal to 1"),
        ("{}", ["basin", "--scheduler", "pigeon://home"], "--scheduler pigeon://home: "),
    ],
)
def test_wrong_input_is_one_line(
    tmp_path: Path, options: str, arguments: list[str], words: str
) -> None:
    path = tmp_path / "options.yaml"
    path.write_text(options)
    line = complaint_here("study", *arguments, "--options", path, "--out", tmp_path / "out")
    assert words in line
