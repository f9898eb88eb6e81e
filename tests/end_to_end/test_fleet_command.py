"""``l2m batch``: a small fleet through the command line."""

import re
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from typing import NoReturn, cast

import numpy as np
import pyarrow.parquet as pq
import pytest

from l2m_gtsam.batch.files import OpenMap, SavedMap
from l2m_gtsam.batch.fleet import fleet_tasks
from l2m_gtsam.batch.fleet_task import RESULTS, calibrated_drive, fleet_drives, open_map
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.storage.result_set import SET_FILE
from l2m_gtsam.storage.trajectory_files import write_tum
from tests.drives.degenerate import eight
from tests.drives.fleet_runs import HOSTILE, FleetRun, table
from tests.support.command_line import complaint_here, l2m
from tests.support.left_out import no_pages


def test_every_bag_is_a_row(fleet_run: FleetRun) -> None:
    rows = table(fleet_run.out)
    assert [(row["vehicle"], row["bag"], row["verdict"]) for row in rows] == [
        ("truck_1", "day_0.bag", "warn"),
        ("truck_1", "day_9.mcap", "warn"),
        ("truck_2", HOSTILE, "error"),
        ("truck_2", "day_1.bag", "error"),
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
    parquet = pq.read_table(fleet_run.out / "fleet.parquet").to_pylist()
    assert [row["bag"] for row in parquet] == [row["bag"] for row in rows]


def test_one_line_sums_up_and_failures_are_named(fleet_run: FleetRun) -> None:
    lines = fleet_run.said.out.splitlines()
    assert lines[0].startswith(
        "4 drives of 2 vehicles: 2 calibrated, 2 not; sensors: 0 pass, 2 warn"
    )
    assert sum(line.startswith("not calibrated: truck_2, ") for line in lines) == 2
    assert lines[-1].startswith("written: ")


def test_the_page_links_to_reports_that_are_there(fleet_run: FleetRun) -> None:
    page = (fleet_run.out / "index.html").read_text()
    for path in ("truck_1/day_0", "truck_1/day_9"):
        assert f'href="{path}/report.html"' in page
        assert (fleet_run.out / path / "report.html").is_file()
    assert "<img" not in page
    assert "&lt;img src=x" in page


NUMBER = re.compile(r"(?<![\w#])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")


# A report's id, whole or its first digits, is a hash of its results to the last digit, and the name
# of a clipped or a repeated part of a picture one of its coordinates.
HASH = re.compile(r"\b(?:[0-9a-f]{64}|[0-9a-f]{16}|[Cmp]?[0-9a-f]{10})\b")


def without_numbers(path: Path) -> str:
    return NUMBER.sub("#", HASH.sub("#", path.read_text()))


def test_a_drive_has_what_calibrate_writes(fleet_run: FleetRun, tmp_path: Path) -> None:
    bag = fleet_run.bags / "truck_1" / "day_0.bag"
    l2m(
        "calibrate",
        bag,
        "--map",
        fleet_run.place.map,
        "--config",
        fleet_run.place.config,
        "--out",
        tmp_path,
    )
    assert {each.name for each in tmp_path.iterdir()} == {*RESULTS, SET_FILE}
    for name in RESULTS:
        ours, own = ((folder / name) for folder in (fleet_run.out / "truck_1/day_0", tmp_path))
        if ours.suffix == ".png":
            assert ours.stat().st_size > 10_000
            continue
        assert without_numbers(ours) == without_numbers(own)
        # Another process, another memory: BLAS kernels round by the alignment of their arrays, and
        # t differs by 1e-11 m on some machines. Pictures in pages have coordinates of a few digits.
        if ours.suffix != ".html":
            found, wanted = (
                np.array(NUMBER.findall(HASH.sub("#", each.read_text())), dtype=np.float64)
                for each in (ours, own)
            )
            np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-8)


def test_what_nobody_expects_is_a_row_too(fleet_run: FleetRun, tmp_path: Path) -> None:
    there = fleet_run.copied(tmp_path)
    tasks = fleet_tasks(fleet_drives(there.order), there.out)
    shared = open_map(there.place.map)
    assert isinstance(shared, OpenMap)
    none = replace(shared, field_map=cast("FieldMap", object()))
    outcome = calibrated_drive(tasks[0], none)
    assert "unexpected AttributeError" in outcome.error
    assert not outcome.lasting
    missing = replace(tasks[0], drive=replace(tasks[0].drive, bag=tmp_path / "absent.bag"))
    assert "absent.bag: no such file" in calibrated_drive(missing, shared).error
    blocked = replace(tasks[0], out=there.place.map / "below")
    assert not calibrated_drive(blocked, shared).lasting
    bad_map = calibrated_drive(tasks[0], open_map(tmp_path / "absent.npz"))
    assert "absent.npz" in bad_map.error


def test_poses_of_a_file_are_those_of_a_drive(fleet_run: FleetRun, tmp_path: Path) -> None:
    """Those of a point 1 cm before the lidar: the sensor is 1 cm less before it."""
    there = fleet_run.copied(tmp_path)
    way, d = eight(), np.array([0.01, 0.0, 0.0])
    poses = tmp_path / "poses.tum"
    write_tum(poses, replace(way, p=way.p + way.R @ d))
    manifest = tmp_path / "fleet.yaml"
    manifest.write_text("- {bag: bags/truck_1/day_0.bag, vehicle: v, poses: poses.tum}\n")
    order = replace(there.order, source=manifest)
    (task,) = fleet_tasks(fleet_drives(order), there.out)
    with no_pages():
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
    fleet_run: FleetRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    there = fleet_run.copied(tmp_path)

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
    fleet_run: FleetRun,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(fleet_run.out.parent)
    line = complaint_here("batch", *arguments, "--out", tmp_path / "out")
    assert words in line
    assert not (tmp_path / "out" / "fleet.csv").exists()


def test_the_script_is_the_command(
    repository: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`scripts/calibrate_bags.py` takes the same options."""
    script = str(repository / "scripts" / "calibrate_bags.py")
    monkeypatch.setattr(sys, "argv", [script, str(tmp_path), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(script, run_name="__main__")
    assert end.value.code == 2
    assert "no bags in it" in capsys.readouterr().err
