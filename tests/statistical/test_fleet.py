"""A fleet of 200 bags, five of them broken: whole, and killed at half and started again."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from l2m_gtsam.batch.reports import OUTCOME_FILE
from tests.drives.fleets import BROKEN, Place, make_place, vehicle
from tests.support.command_line import l2m_process

pytestmark = pytest.mark.study

VEHICLES, DRIVES = 10, 20
TIMEOUT_S = 3600
MOST_BYTES = 3_000_000


def make_fleet(folder: Path) -> None:
    """Write a vehicle's bags into a folder each; one bag of every other vehicle is broken."""
    for number in range(VEHICLES):
        own = folder / f"truck_{number}"
        for day in range(DRIVES):
            suffix = "bag" if number % 2 else "mcap"
            vehicle(own / f"day_{day:02d}.{suffix}", seed=100 * number + day, day=day)
    for number, break_it in enumerate(BROKEN):
        path = folder / f"truck_{2 * number + 1}" / "day_07.bag"
        path.unlink()
        break_it(path)


def arguments(place: Place, bags: Path, out: Path) -> list[str]:
    """Return the command."""
    command = ["batch", bags, "--map", place.map, "--config", place.config, "--out", out]
    return [*map(str, command), "--workers", "2"]


def kill_at_half(command: list[str], out: Path) -> set[Path]:
    """Start a run, kill it with its workers when half is done, and return what was done."""
    program = [sys.executable, "-c", "from l2m_gtsam.cli.app import main; main()", *command]
    started = subprocess.Popen(program, stderr=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + TIMEOUT_S
    while len(done(out)) < VEHICLES * DRIVES // 2:
        assert time.monotonic() < deadline
        assert started.poll() is None
        time.sleep(0.2)  # between looks at the folder: the run shows its progress by files alone
    os.killpg(started.pid, signal.SIGKILL)
    started.wait()
    return done(out)


def done(out: Path) -> set[Path]:
    """Return the drives that have an outcome."""
    return {path.relative_to(out) for path in out.glob(f"*/*/{OUTCOME_FILE}")}


def content(out: Path) -> dict[str, Any]:
    """Return every file of a run by its name, without the dates and times of computing."""
    files: dict[str, Any] = {}
    for path in out.rglob("*"):
        if path.is_file():
            name = path.relative_to(out).as_posix()
            files[name] = path.read_bytes()
            if path.name == OUTCOME_FILE:
                files[name] = json.loads(files[name])
                assert files[name]["outcome"].pop("made").keys() == {"date", "seconds"}
    return files


def test_two_hundred_bags_killed_at_half(tmp_path: Path) -> None:
    place, bags = make_place(tmp_path / "place"), tmp_path / "bags"
    make_fleet(bags)
    drives = VEHICLES * DRIVES

    whole = tmp_path / "whole"
    begun = time.monotonic()
    said = l2m_process(*arguments(place, bags, whole), timeout=TIMEOUT_S).out
    print(f"whole: {time.monotonic() - begun:.0f} s; {said}")
    assert said.startswith(f"{drives} drives of {VEHICLES} vehicles: {drives - len(BROKEN)} cal")
    assert said.count("not calibrated: ") == len(BROKEN)
    lines = (whole / "fleet.csv").read_text().splitlines()
    assert len(lines) == 1 + drives
    reasons = [line for line in lines if ",error," in line]
    assert len(set(reasons)) == len(BROKEN)
    assert (whole / "index.html").stat().st_size < MOST_BYTES

    cut = tmp_path / "cut"
    before = kill_at_half(arguments(place, bags, cut), cut)
    assert drives // 2 <= len(before) < drives
    stamps = {path: (cut / path).stat().st_mtime_ns for path in before}
    said = l2m_process(*arguments(place, bags, cut), timeout=TIMEOUT_S).out
    print(f"killed after {len(before)}; {said}")
    assert f"; {drives - len(before)} computed now" in said
    assert {path: (cut / path).stat().st_mtime_ns for path in before} == stamps
    first, second = content(whole), content(cut)
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
