"""``l2m batch`` once more: what is computed again, and what becomes of old results."""

import errno
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from l2m_gtsam.batch import fleet as batch_fleet
from l2m_gtsam.batch import fleet_task
from l2m_gtsam.batch.fleet import fleet_tasks, run_fleet
from l2m_gtsam.batch.fleet_task import (
    FleetTask,
    calibrated_drive,
    fleet_drives,
    lost_drive,
    open_map,
)
from l2m_gtsam.batch.reports import OUTCOME_FILE
from l2m_gtsam.errors import NoRoomError
from l2m_gtsam.parallel.cluster import ClusterOptions
from l2m_gtsam.progress import silent
from l2m_gtsam.records.fleet import DriveOutcome
from tests.drives.fleet_runs import FleetRun, table
from tests.drives.fleets import not_a_bag, vehicle
from tests.support.left_out import no_pages
from tests.support.one_process import computed_here

Spoil = Callable[[FleetRun], None]


def nothing(run: FleetRun) -> None:
    pass


def another_drive(run: FleetRun) -> None:
    vehicle(run.bags / "truck_1" / "day_0.bag", seed=8)


def mended_bag(run: FleetRun) -> None:
    vehicle(run.bags / "truck_2" / "day_1.bag", seed=8)


def another_map(run: FleetRun) -> None:
    with run.place.map.open("ab") as file:
        file.write(b" ")


def other_options(run: FleetRun) -> None:
    rewrite(run.place.config, "calibration", {"solve": {"uncertainty": "independent"}})


def other_verdicts(run: FleetRun) -> None:
    rewrite(run.place.config, "qa", {"halves": True})


def other_ways_to_map_and_plan(run: FleetRun) -> None:
    rewrite(run.place.config, "mapping", {"compare": {"folds": 5}})
    rewrite(run.place.config, "plan", {"rate_hz": 5})
    rewrite(run.place.config, "slam", {})


def other_outliers(run: FleetRun) -> None:
    rewrite(run.place.config, "fleet", {"outlier": 9})


def rewrite(path: Path, key: str, more: dict[str, object]) -> None:
    content = json.loads(path.read_text())
    content[key] = {**content.get(key, {}), **more}
    path.write_text(json.dumps(content))


def lost_report(run: FleetRun) -> None:
    (run.out / "truck_1/day_9/report.html").unlink()


def damaged_outcome(run: FleetRun) -> None:
    (run.out / "truck_1/day_9" / OUTCOME_FILE).write_text("{")


def edited_outcome(run: FleetRun) -> None:
    path = run.out / "truck_1/day_9" / OUTCOME_FILE
    content = json.loads(path.read_text())
    content["outcome"]["sensors"][0]["verdict"] = "splendid"
    path.write_text(json.dumps(content))


def outcome_of_another_version(run: FleetRun) -> None:
    path = run.out / "truck_1/day_9" / OUTCOME_FILE
    content = json.loads(path.read_text())
    content["outcome"]["key"]["program"] += ".post1"
    path.write_text(json.dumps(content))


def passing_failure(run: FleetRun) -> None:
    path = run.out / "truck_1/day_9" / OUTCOME_FILE
    content = json.loads(path.read_text())
    content["outcome"] |= {"lasting": False}
    path.write_text(json.dumps(content))


def new_bag(run: FleetRun) -> None:
    vehicle(run.bags / "truck_3" / "day_0.bag", seed=4)


@pytest.mark.parametrize(
    ("spoil", "again"),
    [
        (nothing, set()),
        (another_drive, {"truck_1/day_0.bag"}),
        (mended_bag, {"truck_2/day_1.bag"}),
        (other_outliers, set()),
        (other_ways_to_map_and_plan, set()),
        (lost_report, {"truck_1/day_9.mcap"}),
        (damaged_outcome, {"truck_1/day_9.mcap"}),
        (edited_outcome, {"truck_1/day_9.mcap"}),
        (outcome_of_another_version, {"truck_1/day_9.mcap"}),
        (passing_failure, {"truck_1/day_9.mcap"}),
        (new_bag, {"truck_3/day_0.bag"}),
        (another_map, None),
        (other_options, None),
        (other_verdicts, None),
    ],
)
def test_only_what_is_missing_or_changed_is_computed(
    fleet_run: FleetRun,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    spoil: Spoil,
    again: set[str] | None,
) -> None:
    """What would be computed is counted, not computed."""
    there = fleet_run.copied(tmp_path)
    before = (there.out / "fleet.csv").read_bytes()
    asked: list[FleetTask] = []

    def count(
        work: object, tasks: list[FleetTask], options: ClusterOptions
    ) -> Iterator[tuple[FleetTask, DriveOutcome]]:
        for task in tasks:
            asked.append(task)
            yield task, lost_drive(task, "counted")

    monkeypatch.setattr(batch_fleet, "computed", count)
    spoil(there)
    fleet = run_fleet(there.order, ClusterOptions(workers=1), silent)
    named = {f"{each.drive.vehicle}/{each.drive.bag.name}" for each in asked}
    everything = {f"{row['vehicle']}/{row['bag']}" for row in table(fleet_run.out)}
    assert named == (everything if again is None else again)
    assert fleet.computed == len(named)
    assert fleet.drives == len(everything | named)
    assert ((there.out / "fleet.csv").read_bytes() == before) == (not named)


def test_results_of_an_earlier_bag_do_not_stay(fleet_run: FleetRun, tmp_path: Path) -> None:
    """The bag is broken now: what the old one gave must not pass for its results."""
    there = fleet_run.copied(tmp_path)
    bag = there.bags / "truck_1" / "day_0.bag"
    not_a_bag(bag)
    tasks = fleet_tasks(fleet_drives(there.order), there.out)
    (task,) = (each for each in tasks if each.drive.folder == "truck_1/day_0")
    (task.out / ".report.html.12ab34cd.part").write_text("of a run that was killed")
    outcome = calibrated_drive(task, open_map(there.place.map))
    assert outcome.lasting
    assert {each.name for each in task.out.iterdir()} == {OUTCOME_FILE}


def test_a_full_disk_is_no_row(
    fleet_run: FleetRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It concerns all drives: the run ends, and old results stay, those of the drive included."""
    there = fleet_run.copied(tmp_path)
    vehicle(there.bags / "truck_1" / "day_0.bag", seed=8)
    before = contents(there.out)

    def full(*_: object) -> NoReturn:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(batch_fleet, "computed", computed_here)
    with monkeypatch.context() as patch:
        patch.setattr(fleet_task, "write_outcome", full)  # the last of a drive's results
        with (
            no_pages(),
            pytest.raises(NoRoomError, match=r"day_0: .* No space left on device; make room"),
        ):
            run_fleet(there.order, ClusterOptions(workers=1), silent)
    assert contents(there.out) == before
    with no_pages():
        fleet = run_fleet(there.order, ClusterOptions(workers=1), silent)
    assert fleet.computed == 1
    assert contents(there.out).keys() == before.keys()
    assert contents(there.out) != before


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files, hidden ones, too."""
    return {str(each): each.read_bytes() for each in folder.rglob("*") if each.is_file()}
