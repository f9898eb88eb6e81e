"""``l2m batch``: a small fleet through the command line, and what is computed again after it."""

import csv
import errno
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn, cast

import numpy as np
import pyarrow.parquet as pq
import pytest

from l2m_gtsam.batch import fleet as batch_fleet
from l2m_gtsam.batch import fleet_task
from l2m_gtsam.batch.files import SavedMap
from l2m_gtsam.batch.fleet import fleet_tasks, run_fleet
from l2m_gtsam.batch.fleet_task import (
    RESULTS,
    FleetOrder,
    FleetTask,
    calibrated_drive,
    fleet_drives,
    lost_drive,
    open_map,
)
from l2m_gtsam.batch.reports import OUTCOME_FILE
from l2m_gtsam.errors import NoRoomError
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.parallel.cluster import ClusterOptions, Work
from l2m_gtsam.records.fleet import DriveOutcome
from l2m_gtsam.storage.result_set import SET_FILE
from l2m_gtsam.storage.trajectory_files import write_tum
from tests.drives.degenerate import eight
from tests.drives.fleets import Place, make_place, not_a_bag, truncated, vehicle
from tests.support.command_line import Finished, complaint_here, l2m

HOSTILE = "<img src=x onerror=alert(1)>.bag"


@dataclass(frozen=True)
class Run:
    """A fleet that was run: its files, and what was printed."""

    place: Place
    bags: Path
    out: Path
    said: Finished

    def copied(self, folder: Path) -> "Run":
        """Return the same elsewhere, to be spoiled."""
        for name in ("bags", "out", "place"):
            shutil.copytree(self.out.parent / name, folder / name)
        place = Place(folder / "place" / "map.npz", folder / "place" / "fleet.yaml")
        return Run(place, folder / "bags", folder / "out", self.said)

    @property
    def order(self) -> FleetOrder:
        """What was wanted."""
        return FleetOrder(self.bags, self.place.map, self.place.config, self.out)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Three bags of two vehicles and two that are broken."""
    folder = tmp_path_factory.mktemp("fleet")
    place, bags, out = make_place(folder / "place"), folder / "bags", folder / "out"
    vehicle(bags / "truck_1" / "day_0.bag", seed=1)
    vehicle(bags / "truck_1" / "day_9.mcap", seed=2, day=9)
    vehicle(bags / "truck_2" / "day_0.bag", seed=3)
    truncated(bags / "truck_2" / "day_1.bag")
    not_a_bag(bags / "truck_2" / HOSTILE)
    where = ("--map", place.map, "--config", place.config, "--out", out)
    return Run(place, bags, out, l2m("batch", bags, *where, "--workers", "1"))


def table(out: Path) -> list[dict[str, str]]:
    with (out / "fleet.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_every_bag_is_a_row(run: Run) -> None:
    rows = table(run.out)
    assert [(row["vehicle"], row["bag"], row["verdict"]) for row in rows] == [
        ("truck_1", "day_0.bag", "warn"),
        ("truck_1", "day_9.mcap", "warn"),
        ("truck_2", HOSTILE, "error"),
        ("truck_2", "day_1.bag", "error"),
        ("truck_2", "day_0.bag", "warn"),
    ]
    assert [row["date"] for row in rows[:2]] == ["2023-11-14T22:13:20Z", "2023-11-23T22:13:20Z"]
    for row in rows:
        if row["verdict"] == "error":
            assert "not a readable bag" in row["reason"]
        else:
            # A sliding GP counts errors of readings in one place as independent: drives find out.
            assert "Parts of the drive disagree" in row["reason"]
            # where the vehicle carries it, to five of its sigmas
            assert abs(float(row["t_x_m"]) - 0.2) < 5 * float(row["t_x_sigma_m"])
    parquet = pq.read_table(run.out / "fleet.parquet").to_pylist()
    assert [row["bag"] for row in parquet] == [row["bag"] for row in rows]


def test_one_line_sums_up_and_failures_are_named(run: Run) -> None:
    lines = run.said.out.splitlines()
    assert lines[0].startswith(
        "5 drives of 2 vehicles: 3 calibrated, 2 not; sensors: 0 pass, 3 warn"
    )
    assert sum(line.startswith("not calibrated: truck_2, ") for line in lines) == 2
    assert lines[-1].startswith("written: ")


def test_the_page_links_to_reports_that_are_there(run: Run) -> None:
    page = (run.out / "index.html").read_text()
    for path in ("truck_1/day_0", "truck_1/day_9", "truck_2/day_0"):
        assert f'href="{path}/report.html"' in page
        assert (run.out / path / "report.html").is_file()
    assert "<img" not in page
    assert "&lt;img src=x" in page


NUMBER = re.compile(r"(?<![\w#])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")


# A report's number is a hash of its results, to the last digit.
REPORT_ID = re.compile(r"\b[0-9a-f]{10}\b")


def without_numbers(path: Path) -> str:
    return NUMBER.sub("#", REPORT_ID.sub("#", path.read_text()))


def test_a_drive_has_what_calibrate_writes(run: Run, tmp_path: Path) -> None:
    bag = run.bags / "truck_1" / "day_0.bag"
    l2m("calibrate", bag, "--map", run.place.map, "--config", run.place.config, "--out", tmp_path)
    assert {each.name for each in tmp_path.iterdir()} == {*RESULTS, SET_FILE}
    for name in RESULTS:
        ours, own = ((folder / name) for folder in (run.out / "truck_1/day_0", tmp_path))
        if ours.suffix == ".png":
            assert ours.stat().st_size > 10_000
            continue
        assert without_numbers(ours) == without_numbers(own)
        # Another process, another memory: BLAS kernels round by the alignment of their arrays, and
        # t differs by 1e-11 m on some machines. Pictures in pages have coordinates of a few digits.
        if ours.suffix != ".html":
            found, wanted = (
                np.array(NUMBER.findall(each.read_text()), dtype=np.float64) for each in (ours, own)
            )
            np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-8)


Spoil = Callable[[Run], None]


def nothing(run: Run) -> None:
    pass


def another_drive(run: Run) -> None:
    vehicle(run.bags / "truck_1" / "day_0.bag", seed=8)


def mended_bag(run: Run) -> None:
    vehicle(run.bags / "truck_2" / "day_1.bag", seed=8)


def another_map(run: Run) -> None:
    with run.place.map.open("ab") as file:
        file.write(b" ")


def other_options(run: Run) -> None:
    rewrite(run.place.config, "calibration", {"solve": {"uncertainty": "independent"}})


def other_verdicts(run: Run) -> None:
    rewrite(run.place.config, "qa", {"halves": True})


def other_ways_to_map_and_plan(run: Run) -> None:
    rewrite(run.place.config, "mapping", {"compare": {"folds": 5}})
    rewrite(run.place.config, "plan", {"rate_hz": 5})
    rewrite(run.place.config, "slam", {})


def other_outliers(run: Run) -> None:
    rewrite(run.place.config, "fleet", {"outlier": 9})


def rewrite(path: Path, key: str, more: dict[str, object]) -> None:
    content = json.loads(path.read_text())
    content[key] = {**content.get(key, {}), **more}
    path.write_text(json.dumps(content))


def lost_report(run: Run) -> None:
    (run.out / "truck_1/day_9/report.html").unlink()


def damaged_outcome(run: Run) -> None:
    (run.out / "truck_1/day_9" / OUTCOME_FILE).write_text("{")


def edited_outcome(run: Run) -> None:
    path = run.out / "truck_1/day_9" / OUTCOME_FILE
    content = json.loads(path.read_text())
    content["outcome"]["sensors"][0]["verdict"] = "splendid"
    path.write_text(json.dumps(content))


def outcome_of_another_version(run: Run) -> None:
    path = run.out / "truck_1/day_9" / OUTCOME_FILE
    content = json.loads(path.read_text())
    content["outcome"]["key"]["program"] += ".post1"
    path.write_text(json.dumps(content))


def passing_failure(run: Run) -> None:
    path = run.out / "truck_1/day_9" / OUTCOME_FILE
    content = json.loads(path.read_text())
    content["outcome"] |= {"lasting": False}
    path.write_text(json.dumps(content))


def new_bag(run: Run) -> None:
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
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    spoil: Spoil,
    again: set[str] | None,
) -> None:
    """What would be computed is counted, not computed."""
    there = run.copied(tmp_path)
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
    fleet = run_fleet(there.order, ClusterOptions(workers=1), lambda *_: None)
    named = {f"{each.drive.vehicle}/{each.drive.bag.name}" for each in asked}
    everything = {f"{row['vehicle']}/{row['bag']}" for row in table(run.out)}
    assert named == (everything if again is None else again)
    assert fleet.computed == len(named)
    assert fleet.drives == len(everything | named)
    assert ((there.out / "fleet.csv").read_bytes() == before) == (not named)


def test_results_of_an_earlier_bag_do_not_stay(run: Run, tmp_path: Path) -> None:
    """The bag is broken now: what the old one gave must not pass for its results."""
    there = run.copied(tmp_path)
    bag = there.bags / "truck_1" / "day_0.bag"
    not_a_bag(bag)
    tasks = fleet_tasks(fleet_drives(there.order), there.out)
    (task,) = (each for each in tasks if each.drive.folder == "truck_1/day_0")
    (task.out / ".report.html.12ab34cd.part").write_text("of a run that was killed")
    outcome = calibrated_drive(task, open_map(there.place.map))
    assert outcome.lasting
    assert {each.name for each in task.out.iterdir()} == {OUTCOME_FILE}


def test_a_full_disk_is_no_row(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It concerns all drives: the run ends, and old results stay, those of the drive included."""
    there = run.copied(tmp_path)
    vehicle(there.bags / "truck_1" / "day_0.bag", seed=8)
    before = contents(there.out)

    def serial(
        work: Work[FleetTask, Path, DriveOutcome], tasks: list[FleetTask], _: ClusterOptions
    ) -> Iterator[tuple[FleetTask, DriveOutcome]]:
        for task in tasks:
            yield task, work.task(task, work.prepare(work.place(task)))

    def full(*_: object) -> NoReturn:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(batch_fleet, "computed", serial)
    with monkeypatch.context() as patch:
        patch.setattr(fleet_task, "write_outcome", full)  # the last of a drive's results
        with pytest.raises(NoRoomError, match=r"day_0: .* No space left on device; make room"):
            run_fleet(there.order, ClusterOptions(workers=1), lambda *_: None)
    assert contents(there.out) == before
    fleet = run_fleet(there.order, ClusterOptions(workers=1), lambda *_: None)
    assert fleet.computed == 1
    assert contents(there.out).keys() == before.keys()
    assert contents(there.out) != before


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files, hidden ones, too."""
    return {str(each): each.read_bytes() for each in folder.rglob("*") if each.is_file()}


def test_what_nobody_expects_is_a_row_too(run: Run, tmp_path: Path) -> None:
    there = run.copied(tmp_path)
    tasks = fleet_tasks(fleet_drives(there.order), there.out)
    shared = open_map(there.place.map)
    assert shared.opened is not None
    nothing_like_a_map = cast("FieldMap", object())
    none = replace(shared, opened=replace(shared.opened, field_map=nothing_like_a_map))
    outcome = calibrated_drive(tasks[0], none)
    assert "unexpected AttributeError" in outcome.error
    assert not outcome.lasting
    missing = replace(tasks[0], drive=replace(tasks[0].drive, bag=tmp_path / "absent.bag"))
    assert "absent.bag: no such file" in calibrated_drive(missing, shared).error
    blocked = replace(tasks[0], out=there.place.map / "below")
    assert not calibrated_drive(blocked, shared).lasting
    bad_map = calibrated_drive(tasks[0], open_map(tmp_path / "absent.npz"))
    assert "absent.npz" in bad_map.error


def test_poses_of_a_file_are_those_of_a_drive(run: Run, tmp_path: Path) -> None:
    """Those of a point 1 cm before the lidar: the sensor is 1 cm less before it."""
    there = run.copied(tmp_path)
    way, d = eight(), np.array([0.01, 0.0, 0.0])
    poses = tmp_path / "poses.tum"
    write_tum(poses, replace(way, p=way.p + way.R @ d))
    manifest = tmp_path / "fleet.yaml"
    manifest.write_text("- {bag: bags/truck_1/day_0.bag, vehicle: v, poses: poses.tum}\n")
    order = replace(there.order, source=manifest)
    (task,) = fleet_tasks(fleet_drives(order), there.out)
    outcome = calibrated_drive(task, open_map(there.place.map))
    assert outcome.error == ""
    before = next(row for row in table(there.out) if row["bag"] == "day_0.bag")
    (found,) = outcome.sensors
    # A tenth of a millimetre for how both solves end.
    assert found.t[0] == pytest.approx(float(before["t_x_m"]) - 0.01, abs=1e-4)
    same = fleet_tasks(fleet_drives(order), there.out)[0]
    assert same.config_digest == task.config_digest
    write_tum(poses, way)
    assert fleet_tasks(fleet_drives(order), there.out)[0].config_digest != task.config_digest


@pytest.mark.parametrize("error", [MemoryError("no room"), np.linalg.LinAlgError("Singular")])
def test_a_map_that_cannot_be_opened_is_the_reason_of_its_drives(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    there = run.copied(tmp_path)

    def fail(*_: object) -> NoReturn:
        raise error

    monkeypatch.setattr(SavedMap, "open", fail)
    shared = open_map(there.place.map)
    outcome = calibrated_drive(fleet_tasks(fleet_drives(there.order), there.out)[0], shared)
    assert outcome.error.startswith(f"{there.place.map}: unexpected {type(error).__name__}: ")
    assert not outcome.lasting


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["absent"], "absent: no such file"),
        (["bags"], "give it with --map"),
        (["bags", "--map", "absent.npz"], "absent.npz"),
        (["bags", "--map", "place/map.npz", "--config", "absent.yaml"], "absent.yaml: no such"),
        (["bags/truck_1/day_0.bag"], "is a bag; accepted"),
        (["bags", "--map", "place/map.npz", "--scheduler", "pigeon://home"], "--scheduler pigeon"),
    ],
)
def test_wrong_input_is_one_line(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], words: str
) -> None:
    monkeypatch.chdir(run.out.parent)
    line = complaint_here("batch", *arguments, "--out", tmp_path / "out")
    assert words in line
    assert not (tmp_path / "out" / "fleet.csv").exists()


def test_the_script_is_the_command(repository: Path, tmp_path: Path) -> None:
    """`scripts/calibrate_bags.py` takes the same options."""
    script = repository / "scripts" / "calibrate_bags.py"
    command = [sys.executable, str(script), str(tmp_path), "--out", str(tmp_path / "out")]
    ended = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=600, env=dict(os.environ)
    )
    assert ended.returncode == 2
    assert "no bags in it" in ended.stderr
