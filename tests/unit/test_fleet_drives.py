"""Which drives a fleet made: folders, manifests, and names that mean harm."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.batch.fleet_drives import FleetDrive, FleetOrder, fleet_drives
from l2m_gtsam.errors import BagError, ConfigError
from l2m_gtsam.storage.folder_names import folder_names, printable

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


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("bags: [a.bag]", "not a list of drives; accepted: - {bag: PATH, vehicle: NAME}"),
        ("[]", "at least 1 item"),
        ("- {bag: a.bag}", "drive 1: vehicle: Field required"),
        ("- {bag: a.bag, vehicle: ''}", "drive 1: vehicle: String should have at least 1"),
        ("- {bag: a.bag, vehicle: v}\n- {bag: a.bag, vehicel: v}", "drive 2: vehicle: Field"),
        ("- {bag: a.bag, vehicle: v, colour: red}", "drive 1: colour: unknown key; accepted here"),
        ("- {bag: a.bag, vehicle: v, date: soon}", "drive 1: date: Input should be a valid date"),
        ("- {bag: a.bag, vehicle: v}\n" * 2, "a.bag: listed twice for vehicle 'v'"),
        ("- {bag: a.bag", "not valid YAML"),
        ("- a.bag", "drive 1: Input should be a valid dictionary"),
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
