"""Which drives a fleet made: folders, manifests, and names that mean harm."""

import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from l2m_gtsam.batch.fleet_task import FleetDrive, FleetOrder, fleet_drives
from l2m_gtsam.errors import BagError, ConfigError
from l2m_gtsam.records.fleet import DATE
from l2m_gtsam.storage.drive_lists import ManifestEntry
from l2m_gtsam.storage.files import folder_names, printable

HOSTILE = ("../../etc", "/root", "..", ".", "", "a/b", "con\n", "\\x", "-rf", "fleet.csv", "\udcff")
NAMES = st.lists(st.text(max_size=80) | st.sampled_from(HOSTILE), max_size=12, unique=True)


@given(NAMES)
def test_folder_names_are_safe_and_no_two_alike(names: list[str]) -> None:
    made = folder_names(names, names, ("index.html", "fleet.csv"))
    assert len({each.casefold() for each in made}) == len(names)
    for each in made:
        assert each not in ("", ".", "..", "fleet.csv")
        assert not set("/\\\0\n") & set(each)
        assert not each.startswith((".", "-"))
        assert len(each.encode()) <= 255


@given(NAMES, st.text(max_size=80))
def test_a_folder_does_not_depend_on_the_others(names: list[str], more: str) -> None:
    """As long as they are not alike but for upper and lower case, as plain names here are."""
    plain = [f"truck_{k}" for k in range(len(names))]
    made = folder_names([*plain, *names], [*plain, *names])
    assert made[: len(plain)] == plain
    if more not in (*names, *plain):
        again = folder_names([more, *plain, *names], [more, *plain, *names])
        assert again[1 : len(plain) + 1] == plain


def test_names_that_differ_in_case_are_two_folders() -> None:
    one, other, third = folder_names(["Truck", "truck", "van"], ["1", "2", "3"])
    assert one.startswith("Truck-")
    assert other.startswith("truck-")
    assert third == "van"


def test_text_is_printable() -> None:
    assert printable("a\x1b[2Jb\u202ec\udcff") == "a\ufffd[2Jb\ufffdc?"


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def listed(folder: Path, source: Path | None = None) -> tuple[FleetDrive, ...]:
    order = FleetOrder(source or folder, Path("m.npz"), None, folder / "out")
    return fleet_drives(order)


def test_every_kind_of_bag_below_a_folder_is_found(tmp_path: Path) -> None:
    touch(
        tmp_path / "truck_1" / "a.bag",
        tmp_path / "truck_1" / "a.mcap",
        tmp_path / "truck_2" / "ros2" / "metadata.yaml",
        tmp_path / "truck_2" / "ros2" / "ros2_0.db3",
        tmp_path / "site" / "truck_3" / "b.db3",
        tmp_path / "loose.MCAP",
        tmp_path / "notes.txt",
        tmp_path / ".hidden" / "c.bag",
        tmp_path / "out" / "truck_1" / "d.bag",
    )
    found = listed(tmp_path)
    assert [(each.vehicle, each.bag.name) for each in found] == [
        (tmp_path.name, "loose.MCAP"),
        ("truck_3", "b.db3"),
        ("truck_1", "a.bag"),
        ("truck_1", "a.mcap"),
        ("truck_2", "ros2"),
    ]
    folders = [each.folder for each in found]
    assert len(set(folders)) == 5
    assert folders[1] == "truck_3/b"
    assert folders[2].startswith("truck_1/a-")
    assert folders[4] == "truck_2/ros2"


def test_a_loop_of_links_ends(tmp_path: Path) -> None:
    touch(tmp_path / "truck" / "a.bag")
    (tmp_path / "truck" / "loop").symlink_to(tmp_path)
    assert len(listed(tmp_path)) == 1


def test_the_vehicle_of_a_link_is_the_folder_that_the_link_lies_in(tmp_path: Path) -> None:
    touch(tmp_path / "archive" / "2026" / "a.bag", tmp_path / "archive" / "b" / "metadata.yaml")
    truck = tmp_path / "fleet" / "truck_1"
    truck.mkdir(parents=True)
    (truck / "a.bag").symlink_to(tmp_path / "archive" / "2026" / "a.bag")
    (truck / "b").symlink_to(tmp_path / "archive" / "b")
    assert [each.vehicle for each in listed(tmp_path / "fleet")] == ["truck_1", "truck_1"]


def test_a_bag_that_is_the_folder_itself_has_its_parent_for_a_vehicle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touch(tmp_path / "truck_1" / "ros2" / "metadata.yaml")
    monkeypatch.chdir(tmp_path / "truck_1" / "ros2")
    assert [each.vehicle for each in listed(Path())] == ["truck_1"]


def closed_to_os(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a folder be listed or looked into by nobody, as for a user without the right to.

    Root may read everything, so file modes would say nothing there.
    """
    scandir, stat = os.scandir, os.stat

    def refuse(path: Any, places: Sequence[Path]) -> None:
        if folder in places:
            raise PermissionError(13, "Permission denied", str(path))

    def no_scandir(path: Any = ".") -> Any:
        refuse(path, [Path(path)])
        return scandir(path)

    def no_stat(path: Any, **options: Any) -> Any:
        if isinstance(path, (str, os.PathLike)):
            refuse(path, list(Path(path).parents))
        return stat(path, **options)

    monkeypatch.setattr(os, "scandir", no_scandir)
    monkeypatch.setattr(os, "stat", no_stat)


def test_a_folder_that_cannot_be_read_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touch(tmp_path / "truck_1" / "a.bag", tmp_path / "truck_2" / "deep" / "b.bag")
    closed = tmp_path / "truck_2"
    closed_to_os(closed, monkeypatch)
    with pytest.raises(BagError) as error:
        listed(tmp_path)
    assert str(error.value).startswith(f"{closed}: cannot be read: Permission denied; allow ")
    with pytest.raises(BagError, match="cannot be read: Permission denied"):
        listed(closed / "deep")
    with pytest.raises(BagError, match="cannot be read: Permission denied"):
        listed(tmp_path, closed / "fleet.yaml")


def test_a_folder_that_cannot_be_listed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One may look for names in it, and not see which there are."""
    touch(tmp_path / "truck_1" / "a.bag", tmp_path / "truck_2" / "b.bag")
    stat = os.stat
    closed_to_os(tmp_path / "truck_2", monkeypatch)
    monkeypatch.setattr(os, "stat", stat)
    with pytest.raises(BagError, match=r"truck_2: cannot be read: Permission denied; allow "):
        listed(tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
@pytest.mark.parametrize("mode", [0o000, 0o300, 0o400])
def test_a_folder_that_is_closed_is_named(tmp_path: Path, mode: int) -> None:
    touch(tmp_path / "truck_1" / "a.bag", tmp_path / "truck_2" / "deep" / "b.bag")
    closed = tmp_path / "truck_2"
    closed.chmod(mode)
    try:
        with pytest.raises(BagError, match=r"truck_2.*: cannot be read: Permission denied; allow "):
            listed(tmp_path)
    finally:
        closed.chmod(0o700)


def test_the_folder_for_results_may_be_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touch(tmp_path / "truck_1" / "a.bag", tmp_path / "out" / "metadata.yaml")
    closed_to_os(tmp_path / "out", monkeypatch)
    assert [each.vehicle for each in listed(tmp_path)] == ["truck_1"]


def test_many_drives_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many vehicles of one drive each, and one vehicle of many drives."""
    many = 1000
    entries = [
        ManifestEntry(bag=tmp_path / f"{k}.bag", vehicle=vehicle)
        for k in range(many)
        for vehicle in (f"truck_{k}", "all")
    ]
    monkeypatch.setattr("l2m_gtsam.batch.fleet_task.read_manifest", lambda _: entries)
    found = listed(tmp_path, tmp_path / "fleet.yaml")
    assert len({each.folder for each in found}) == 2 * many


def test_a_manifest(tmp_path: Path) -> None:
    manifest = tmp_path / "fleet.yaml"
    manifest.write_text(
        "- {bag: drives/a.bag, vehicle: 7}\n"
        "- {bag: /far/b.mcap, vehicle: van, map: hall.npz, config: c.yaml, date: 2026-05-01}\n"
        "- {bag: c.bag, vehicle: van, date: 2026-05-01T08:00:00+02:00}\n"
    )
    one, two, three = listed(tmp_path, manifest)
    assert (one.vehicle, one.bag, one.map_path) == ("7", tmp_path / "drives/a.bag", Path("m.npz"))
    assert (two.bag, two.map_path) == (Path("/far/b.mcap"), tmp_path / "hall.npz")
    assert two.config == tmp_path / "c.yaml"
    assert (one.date, two.date) == ("", "2026-05-01T00:00:00Z")
    assert three.date == "2026-05-01T06:00:00Z"
    assert [each.folder for each in (one, two, three)] == ["7/a", "van/b", "van/c"]


def test_poses_in_files_of_their_own(tmp_path: Path) -> None:
    """One log with the poses of two SLAMs is two drives."""
    manifest = tmp_path / "fleet.yaml"
    manifest.write_text(
        "- {bag: a.csv, vehicle: van, poses: a.tum}\n"
        "- {bag: a.csv, vehicle: van, poses: kitti.txt, pose_times: times.txt}\n"
    )
    one, two = listed(tmp_path, manifest)
    assert (one.poses, one.pose_times) == (tmp_path / "a.tum", None)
    assert (two.poses, two.pose_times) == (tmp_path / "kitti.txt", tmp_path / "times.txt")
    assert one.folder != two.folder


@given(st.datetimes(timezones=st.none() | st.timezones()))
def test_every_date_is_read_back_or_refused(date: datetime) -> None:
    """What is read can be written as text of a table, and read from it."""
    try:
        entry = ManifestEntry(bag=Path("a.bag"), vehicle="v", date=date)
    except ValidationError:
        assert not 1971 <= date.year <= 2199
        return
    assert entry.date is not None
    again = datetime.strptime(entry.date.strftime(DATE), DATE).replace(tzinfo=UTC)
    assert again == entry.date.replace(microsecond=0)
    assert 1970 <= again.year <= 2200


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("bags: [a.bag]", "not a list of drives; accepted: - {bag: PATH, vehicle: NAME}"),
        ("[]", "at least 1 item"),
        ("- {bag: a.bag}", "drive 1: vehicle: Field required"),
        ("- {bag: a.bag, vehicle: ''}", "drive 1: vehicle: String should have at least 1"),
        ("- {bag: a.bag, vehicle: v}\n- {bag: a.bag, vehicel: v}", "drive 2: vehicle: Field"),
        ("- {bag: a.bag, vehicle: v, colour: red}", "drive 1: colour: unknown key; accepted here"),
        ("- {bag: a.bag, vehicle: v, pose_times: t.txt}", "drive 1: pose_times goes with poses"),
        ("- {bag: a.bag, vehicle: v, date: soon}", "drive 1: date: Input should be a valid date"),
        (
            "- {bag: a.bag, vehicle: v, date: 20260502}",
            "drive 1: date: 20260502 is a number; write",
        ),
        ("- {bag: a.bag, vehicle: v, date: '20260502'}", "date: 20260502 is a number; write a"),
        ("- {bag: a.bag, vehicle: v, date: 2026.5}", "date: 2026.5 is a number; write a date as"),
        ("- {bag: a.bag, vehicle: v, date: true}", "date: True is a number; write a date as"),
        ("- {bag: a.bag, vehicle: v, date: 0024-01-01}", "date: year 24; accepted: 1970 to 2200"),
        ("- {bag: a.bag, vehicle: v, date: 2201-01-01}", "date: year 2201; accepted: 1970 to"),
        (
            "- {bag: a.bag, vehicle: v, date: '0001-01-01T00:00:00+02:00'}",
            "drive 1: date: year 1; accepted: 1970 to 2200",
        ),
        (
            "- {bag: a.bag, vehicle: v, date: '9999-12-31T23:00:00-02:00'}",
            "drive 1: date: year 9999; accepted: 1970 to 2200",
        ),
        ("- {bag: a.bag, vehicle: v, date: 0001-01-01T00:00:00+02:00}", "accepted: "),
        ("- {bag: a.bag, vehicle: v}\n" * 2, "a.bag: listed twice for vehicle 'v'"),
        ("- {bag: a.bag", "not valid YAML"),
        ("- a.bag", "drive 1: names with values are expected"),
    ],
)
def test_a_wrong_manifest_is_one_line(tmp_path: Path, content: str, words: str) -> None:
    manifest = tmp_path / "fleet.yaml"
    manifest.write_text(content)
    with pytest.raises(ConfigError) as error:
        listed(tmp_path, manifest)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_other_wrong_input_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="no bags in it; accepted: "):
        listed(tmp_path)
    with pytest.raises(ConfigError, match="no such file"):
        listed(tmp_path, tmp_path / "absent.yaml")
    touch(tmp_path / "a.bag")
    with pytest.raises(BagError, match="is a bag; accepted: a folder of bags or a manifest"):
        listed(tmp_path, tmp_path / "a.bag")
    (tmp_path / "f.yaml").write_text("- {bag: a.bag, vehicle: v}")
    for source in (tmp_path, tmp_path / "f.yaml"):
        with pytest.raises(ConfigError, match="--map"):
            fleet_drives(FleetOrder(source, None, None, tmp_path / "out"))
