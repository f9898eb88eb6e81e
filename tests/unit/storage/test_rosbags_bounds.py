"""Bags of some kilobytes whose chunks unpack to more than any recorder writes."""

import bz2
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import lz4.frame
import pytest
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader

from l2m_gtsam.errors import BagError
from l2m_gtsam.storage import rosbags_bounds
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.inspect import inspect_bag
from l2m_gtsam.storage.open_bag import typestore
from l2m_gtsam.storage.rosbags_bounds import (
    MEBIBYTE,
    MOST_CHUNK,
    REPLACED,
    UNPACKERS,
    ZSTD,
    UnpackingError,
    unpack_bz2,
    unpack_lz4,
    unpack_zstd,
)
from tests.drives.bags import Entry, ros, write
from tests.support.bag_records import (
    MCAP_CHUNK,
    MCAP_INDEX,
    McapRecord,
    mcap_as_it_is,
    mcap_body,
    mcap_chunk,
    mcap_file,
    mcap_records,
    ros1_bag,
    ros1_records,
    ros1_repacked,
    sized,
)

PIECES = MOST_CHUNK // (16 * MEBIBYTE) + 1  # of 16 MiB of zeros each: more than a chunk may hold
ZEROS = bytes(16 * MEBIBYTE)
PACK: dict[str, Callable[[bytes], bytes]] = {
    "bz2": bz2.compress,
    "lz4": lz4.frame.compress,
    "zstd": ZSTD.compress,
}
UNPACK = {"bz2": unpack_bz2, "lz4": unpack_lz4, "zstd": unpack_zstd}


def small(folder: Path, kind: str) -> Path:
    """Return a bag with a few readings."""
    dialect = ros(kind)
    stamps = [10**9 + k for k in range(5)]
    entries = [
        Entry("/mag", "sensor_msgs/MagneticField", stamp, dialect.magnetic(stamp, (1, 0, 0)))
        for stamp in stamps
    ]
    return write(folder, kind, entries)


def refused(path: Path) -> str:
    """Return the one line that a bag is refused with."""
    with pytest.raises(BagError) as error:
        inspect_bag(path, BagOptions())
    return str(error.value)


def test_all_places_in_rosbags_are_there_and_taken() -> None:
    for module, name, function in REPLACED:
        assert getattr(module, name) is function
    for table, name, function in UNPACKERS:
        assert table[name] is function


@pytest.mark.parametrize("packing", PACK)
def test_unpacking(packing: str) -> None:
    pack, unpack = PACK[packing], UNPACK[packing]
    assert unpack(pack(b"content")) == b"content"
    assert unpack(pack(b"two ") + pack(b"frames")) == b"two frames"
    with pytest.raises(UnpackingError, match="ends too early"):
        unpack(pack(b"content")[:-3])
    with pytest.raises(UnpackingError, match="unpacks to more than"):
        unpack(pack(ZEROS) * PIECES)


@pytest.mark.parametrize("packing", PACK)
@pytest.mark.parametrize("at_once", [1, 7, 64, 999, 1000, 1001])
def test_what_is_larger_than_a_part_is_whole(
    packing: str, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rosbags_bounds, "MOST_AT_ONCE", at_once)
    pack, unpack, content = PACK[packing], UNPACK[packing], bytes(range(250)) * 4
    assert unpack(pack(content)) == content
    assert unpack(pack(content[:600]) + pack(content[600:])) == content
    with pytest.raises(UnpackingError, match="ends too early"):
        unpack(pack(content)[:-3])


@pytest.mark.parametrize("packing", ["bz2", "lz4"])
def test_a_bomb_of_ros1(tmp_path: Path, packing: str) -> None:
    path = small(tmp_path, "ros1")
    records = ros1_records(path.read_bytes())
    index = next(k for k, each in enumerate(records) if each.fields["op"] == b"\x05")
    chunk = ros1_repacked(records[index], b"", packing)
    bomb = replace(chunk, data=PACK[packing](ZEROS) * PIECES)
    path.write_bytes(ros1_bag([*records[:index], bomb, *records[index + 1 :]]))
    assert path.stat().st_size < 2 * MEBIBYTE
    assert "unpacks to more than the 268,435,456 bytes" in refused(path)


@pytest.mark.parametrize("packing", ["", "bz2"])
def test_what_is_written_again_is_the_same_bag(tmp_path: Path, packing: str) -> None:
    path = small(tmp_path, "ros1")
    records = ros1_records(path.read_bytes())
    if packing:
        records = [
            ros1_repacked(each, each.data, packing) if each.fields["op"] == b"\x05" else each
            for each in records
        ]
    path.write_bytes(ros1_bag(records))
    with Ros1Reader(path) as reader:
        assert [stamp for _, stamp, _ in reader.messages()] == [10**9 + k for k in range(5)]


@pytest.mark.parametrize("packing", ["lz4", "zstd"])
@pytest.mark.parametrize("declared", [PIECES * len(ZEROS), 1000])
def test_a_bomb_of_mcap(tmp_path: Path, packing: str, declared: int) -> None:
    path = next(small(tmp_path, "mcap").glob("*.mcap"))
    bomb, word = PACK[packing](ZEROS) * PIECES, packing.encode()
    records = []
    for record in mcap_body(path.read_bytes()):
        data = record.data
        if record.op == MCAP_CHUNK:
            head = data[:16] + struct.pack("<QI", declared, 0)
            data = head + sized(word) + struct.pack("<Q", len(bomb)) + bomb
        records.append(McapRecord(record.op, data))
    path.write_bytes(mcap_file(records))
    most = min(declared, MOST_CHUNK)
    assert f"unpacks to more than the {most:,} bytes" in refused(path)


@pytest.mark.parametrize(
    ("declared", "copies", "reason"),
    [
        (PIECES * len(ZEROS), 1, "declares a chunk of 285,212,672 bytes"),
        (200 * MEBIBYTE, 3, "chunks of more than 402,653,184 bytes that overlap in time"),
    ],
)
def test_what_an_index_declares(tmp_path: Path, declared: int, copies: int, reason: str) -> None:
    path = next(small(tmp_path, "mcap").glob("*.mcap"))
    records = []
    for record in mcap_records(path.read_bytes()):
        if record.op == MCAP_INDEX:
            index = replace(record, data=record.data[:-8] + struct.pack("<Q", declared))
            records += [index] * copies
        else:
            records.append(record)
    path.write_bytes(mcap_as_it_is(records))
    assert reason in refused(path)


@pytest.mark.parametrize("packing", ["", "lz4", "zstd"])
def test_mcap_is_read_as_it_is_written_again(tmp_path: Path, packing: str) -> None:
    path = next(small(tmp_path, "mcap").glob("*.mcap"))
    records = [
        replace(mcap_chunk(each), packing=packing).record() if each.op == MCAP_CHUNK else each
        for each in mcap_body(path.read_bytes())
    ]
    path.write_bytes(mcap_file(records))
    with Ros2Reader(path) as reader:
        assert [stamp for _, stamp, _ in reader.messages()] == [10**9 + k for k in range(5)]


def test_definitions_that_repeat_nothing_or_too_much(tmp_path: Path) -> None:
    from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

    def made(text: str) -> object:
        definition = MessageDefinition(MessageDefinitionFormat.MSG, text)
        return typestore(False, "a_msgs/msg/B", definition)

    rule = "=" * 80
    assert made("float64[3] x\n")
    with pytest.raises(ValueError, match="repeats a type without content"):
        made(f"a_msgs/C[] x\n{rule}\nMSG: a_msgs/C\n")
    with pytest.raises(ValueError, match="repeats a_msgs/msg/C 1000000 times"):
        made(f"a_msgs/C[1000000] x\n{rule}\nMSG: a_msgs/C\nuint8 y\n")
    with pytest.raises(ValueError, match="letters"):
        made("#" * 300_000)
