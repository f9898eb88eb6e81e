"""What once broke the command line, attack by attack: each ends with one line and little memory.

The numbers are those of the table in `docs/untrusted.md`. Causes have tests of their own beside
the code; here whole commands run, each in a process of its own.
"""

import fcntl
import io
import json
import os
import shutil
import signal
import struct
import unicodedata
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import lz4.frame
import numpy as np
import pytest

from tests.drives.bags import Entry, ros, write
from tests.fuzz.runner import Ended, run_case, start_command
from tests.support.bag_records import MAGIC_ROS1, ros1_bag, ros1_records, ros1_repacked, sized

FILES = (Path(__file__).parents[1] / "files").resolve()
START = 1_700_000_000_000_000_000
LITTLE = 64 << 20  # bytes at the peak beside the program itself: 11 to 17 MiB were seen
SOON = 1.0  # seconds of a core; it takes 0.4
SHORT = 1000  # letters of a last line
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def refused(folder: Path, *words: object, most_bytes: int = LITTLE) -> str:
    """Run a command that has to be refused, and return its last line."""
    found = run(folder, *words)
    assert found.how == "refused", found
    assert found.peak_bytes < most_bytes
    last = found.said.strip().splitlines()[-1]
    assert last.startswith("l2m: ")
    assert len(last) < SHORT
    return last


def run(folder: Path, *words: object) -> Ended:
    """Run a command in a process of its own."""
    return run_case([str(each) for each in words], folder, folder / "out")


def drive(folder: Path, turn: tuple[float, ...] = UPRIGHT, topic: str = "/mag") -> Path:
    """Return a bag of two seconds, one of whose poses is turned in some way."""
    dialect, entries = ros("ros1"), []
    for k in range(40):
        stamp = START + 50_000_000 * k
        pose = dialect.pose_stamped(stamp, (0.05 * k, 0, 0), turn if k == 7 else UPRIGHT)
        field = dialect.magnetic(stamp, (2e-5 + 1e-7 * (k % 5), 0.0, 4e-5), "mag")
        entries += [
            Entry("/pose", "geometry_msgs/PoseStamped", stamp, pose),
            Entry(topic, "sensor_msgs/MagneticField", stamp, field),
        ]
    return write(folder, "ros1", entries)


def aliases(levels: int) -> str:
    """Return a configuration of under a kilobyte that stands for 10 ** levels words."""
    inside = [["x"] * 10, *([f"*a{level}"] * 10 for level in range(levels - 1))]
    anchors = [f"&a{level} [{', '.join(each)}]" for level, each in enumerate(inside)]
    return f"bag: [{', '.join(anchors)}]\n"


@pytest.mark.parametrize(
    "text", [aliases(12), "bag: 0x" + "f" * 5000, "bag: [" + "some words, " * 1000 + "]"]
)
def test_1_configurations_are_not_printed_in_full(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    assert "config.yaml" in refused(tmp_path, "inspect", drive(tmp_path), "--config", path)


def test_2_a_chunk_that_unpacks_to_gigabytes(tmp_path: Path) -> None:
    path = drive(tmp_path)
    records = ros1_records(path.read_bytes())
    at = next(k for k, each in enumerate(records) if each.fields["op"] == b"\x05")
    inner = ros1_records(MAGIC_ROS1 + records[at].data)
    message = next(each for each in inner if each.fields["op"] == b"\x02")
    size, packer = 100 << 24, lz4.frame.LZ4FrameCompressor()  # one message of 1.7 GB
    head = sized(message.header) + struct.pack("<I", size)
    zeros = (packer.compress(bytes(1 << 24)) for _ in range(100))
    packed = b"".join([packer.begin(), packer.compress(head), *zeros, packer.flush()])
    bomb = replace(ros1_repacked(records[at], b"", "lz4"), data=packed)
    path.write_bytes(ros1_bag([*records[:at], bomb, *records[at + 1 :]]))
    assert path.stat().st_size < 8 << 20
    # Parts of a chunk of the largest size, and three times the last of them, while the
    # decompressor's buffer grows: 352 MiB were seen.
    most = LITTLE + (1 << 28) * 3 // 2
    assert "unpacks to more than" in refused(tmp_path, "inspect", path, most_bytes=most)


@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "BAG", "--map", FILES / "map.npz", "--out", "OUT"),
        ("map", "build", "BAG", "--out", "OUT.npz"),
        ("plan", "BAG", "--map", FILES / "map.npz"),
    ],
)
def test_3_a_quaternion_of_1e200(tmp_path: Path, words: tuple[object, ...]) -> None:
    bag = str(drive(tmp_path, turn=(1e200, 0.0, 0.0, 1.0)))
    out = str(tmp_path / "out")
    made = [str(each).replace("BAG", bag).replace("OUT", out) for each in words]
    assert "an orientation is (1e+200, 0, 0, 1)" in refused(tmp_path, *made)
    looked = run(tmp_path, "inspect", bag)
    assert looked.how == "answer is no"
    assert "1e+200" in looked.said


def with_lzma(source: Path, path: Path) -> None:
    """Pack an archive with LZMA, and damage what is packed."""
    into = io.BytesIO()
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(into, "w", zipfile.ZIP_LZMA) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    data = bytearray(into.getvalue())
    for at in range(80, len(data) - 2000, 200):
        data[at] ^= 0xFF
    path.write_bytes(data)


def with_headers(source: Path, path: Path) -> None:
    """Damage the headers of the arrays in an archive, whose sums then fit."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            new.writestr(name, old.read(name).replace(b", }", b",  ", 1))


@pytest.mark.parametrize("damage", [with_lzma, with_headers])
def test_4_damaged_archives(tmp_path: Path, damage: object) -> None:
    assert callable(damage)
    damage(FILES / "map.npz", tmp_path / "map.npz")
    assert "map.npz" in refused(tmp_path, "map", "info", tmp_path / "map.npz")
    np.savez(tmp_path / "sound.npz", points=np.random.default_rng(1).normal(size=(9000, 3)))
    damage(tmp_path / "sound.npz", tmp_path / "cloud.npz")
    build = ("map", "build", drive(tmp_path), "--structure", tmp_path / "cloud.npz")
    assert "cloud.npz" in refused(tmp_path, *build, "--out", tmp_path / "out.npz")


def test_4_names_that_are_too_long(tmp_path: Path) -> None:
    for words in (("inspect",), ("map", "info"), ("report",)):
        assert "too long" in refused(tmp_path, *words, "x" * 300)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no full device")
def test_4_output_to_a_full_disk(tmp_path: Path) -> None:
    log = tmp_path / "said.log"
    log.symlink_to("/dev/full")
    number = start_command(["inspect", str(drive(tmp_path))], tmp_path, log, 20)
    assert os.waitstatus_to_exitcode(os.waitpid(number, 0)[1]) == 2


@pytest.mark.parametrize("text", ["a: [" + "x, " * 700_000 + "]", "- " * 5000, "[" * 10_000])
def test_5_yaml_that_takes_minutes(tmp_path: Path, text: str) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text(text)
    assert run(tmp_path, "inspect", bag).cpu_s < SOON
    refused(tmp_path, "inspect", bag)
    config = tmp_path / "config.yaml"
    config.write_text(text)
    refused(tmp_path, "inspect", drive(tmp_path), "--config", config)


def test_5_yaml_of_50_mb(tmp_path: Path) -> None:
    config = tmp_path / "config.yaml"
    config.write_text("bag:\n" + "- some words in a row\n" * 2_400_000)
    assert "larger than 2 MB" in refused(tmp_path, "inspect", drive(tmp_path), "--config", config)


@pytest.mark.parametrize("words", [("report", "RESULT"), ("export", "FILE", "--format", "json")])
def test_6_a_foreign_calibration_in_a_result(tmp_path: Path, words: tuple[str, ...]) -> None:
    """As a disk that is full in the middle left it, or somebody's copy."""
    known, result = str(FILES / "calibration.yaml"), tmp_path / "result"
    compared = ("validate", "--calibration", known, "--compare", known)
    assert run(tmp_path, *compared, "--out", result).how == "done"
    shutil.copy(known, result)
    for name in ("calibration.yaml", "metrics.json"):
        shutil.copy(FILES / name, result)
    listed = result / "results.json"
    assert listed.exists(), "results are no set"
    content = json.loads(listed.read_text())
    content["files"] |= {"calibration.yaml": "0" * 64, "metrics.json": "1" * 64}
    listed.write_text(json.dumps(content))
    (result / "validation.json").unlink()
    made = [str(result) if each == "RESULT" else each for each in words]
    made = [str(result / "calibration.yaml") if each == "FILE" else each for each in made]
    out = () if words[0] == "report" else ("--out", tmp_path / "out.json")
    last = refused(tmp_path, *made, *out)
    assert "is not of the run that" in last


def test_7_two_batches_into_one_folder(tmp_path: Path) -> None:
    bags, out = tmp_path / "bags", tmp_path / "results"
    for each in (bags, out):
        each.mkdir()
    drive(bags)
    words = ("batch", bags, "--map", FILES / "map.npz", "--out", out, "--workers", "1")
    handle = os.open(out, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)  # as the other batch does
    try:
        last = refused(tmp_path, *words)
    finally:
        os.close(handle)
    assert "another run is writing its results there" in last
    assert not list(out.iterdir())


@pytest.mark.parametrize("row", ["map", "sensors"])
def test_8_lists_of_different_lengths(tmp_path: Path, row: str) -> None:
    shutil.copy(FILES / "calibration.yaml", tmp_path)
    content = json.loads((FILES / "metrics.json").read_text())
    if row == "map":
        content["metrics"]["map"]["strength"].pop()
    else:
        content["metrics"]["sensors"][0]["series"]["map"].pop()
    (tmp_path / "metrics.json").write_text(json.dumps(content))
    assert "must have the shape" in refused(tmp_path, "report", ".")


def test_9_control_characters_in_the_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    bag = drive(tmp_path, topic="/mag\x1b]0;title\x07\x1b[31m\u202e")
    said = run(tmp_path, "inspect", bag).said
    assert "\\x1b]0;title\\x07" in said
    hidden = {each for each in said if unicodedata.category(each) in ("Cc", "Cf")}
    assert hidden <= {"\n"}


def test_11_what_a_killed_run_left_is_swept(tmp_path: Path) -> None:
    """A run that is killed while it writes leaves a hidden part; the next one removes it."""
    known, out = str(FILES / "calibration.yaml"), tmp_path / "result"
    words = ["validate", "--calibration", known, "--compare", known, "--out", str(out)]
    hidden: list[Path] = []
    for _ in range(20):
        number = start_command(words, tmp_path, tmp_path / "said.log", 60)
        while (
            not hidden and os.waitid(os.P_PID, number, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None
        ):
            hidden = [each for each in out.glob(".*") if each.name != ".ready"]
        os.kill(number, signal.SIGKILL)
        os.waitpid(number, 0)
        hidden = list(out.glob(".*"))
        if hidden:
            break
    assert hidden, "never killed while it wrote"
    assert run(tmp_path, *words).how == "done"
    assert not list(out.glob(".*"))


@contextmanager
def pipe(path: Path) -> Iterator[Path]:
    """Give a pipe that nobody writes to."""
    os.mkfifo(path)
    yield path
    path.unlink()


def test_12_pipes_and_devices(tmp_path: Path) -> None:
    bag = drive(tmp_path)
    with pipe(tmp_path / "a.bag") as path:
        assert "is a pipe" in refused(tmp_path, "inspect", path)
    with pipe(tmp_path / "map.npz") as path:
        assert "is a pipe" in refused(tmp_path, "map", "info", path)
    assert "is a device" in refused(tmp_path, "inspect", bag, "--config", "/dev/zero")


def test_12_a_map_that_unpacks_to_gigabytes(tmp_path: Path) -> None:
    """Within what a map may hold: it is read into its memory once."""
    path, numbers = tmp_path / "map.npz", 60_000_000
    head = io.BytesIO()
    declared = {"descr": "<f8", "fortran_order": False, "shape": (numbers,)}
    np.lib.format.write_array_header_1_0(head, declared)
    with (
        zipfile.ZipFile(FILES / "map.npz") as old,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as new,
    ):
        *others, largest = sorted(old.infolist(), key=lambda each: each.file_size)
        for each in others:
            new.writestr(each.filename, old.read(each))
        with new.open(largest.filename, "w") as into:
            into.write(head.getvalue())
            for _ in range(60):
                into.write(bytes(8 * numbers // 60))
    assert path.stat().st_size < 8 << 20
    found = run(tmp_path, "map", "info", path)
    assert found.how == "refused", found
    # Once: twice would be 960 MB. 67 MiB more were seen, of modules that the command loads.
    assert found.peak_bytes < 1.5 * 8 * numbers
