"""Bags as records, to be changed and written again with sizes, offsets and checksums that fit."""

import bz2
import struct
from binascii import crc32
from collections.abc import Callable
from dataclasses import dataclass, replace

import lz4.frame

from l2m_gtsam.storage.rosbags_bounds import ZSTD

PACKERS: dict[str, Callable[[bytes], bytes]] = {
    "": bytes,
    "none": bytes,
    "bz2": bz2.compress,
    "lz4": lz4.frame.compress,
    "zstd": ZSTD.compress,
}
MAGIC_ROS1 = b"#ROSBAG V2.0\n"
MAGIC_MCAP = b"\x89MCAP0\r\n"
BAG, CHUNK_INFO, CHUNK = b"\x03", b"\x06", b"\x05"
MCAP_CHUNK, MCAP_FOOTER, MCAP_INDEX = 0x06, 0x02, 0x08


@dataclass(frozen=True)
class Ros1Record:
    """A record of a bag of ROS 1, and where it was."""

    fields: dict[str, bytes]
    data: bytes
    at: int = -1

    @property
    def header(self) -> bytes:
        """Its fields as they are written."""
        pairs = [name.encode() + b"=" + value for name, value in self.fields.items()]
        return b"".join(sized(pair) for pair in pairs)


def sized(data: bytes) -> bytes:
    """Return bytes after their number."""
    return struct.pack("<I", len(data)) + data


def ros1_records(bag: bytes) -> list[Ros1Record]:
    """Return the records of a whole bag of ROS 1; of chunks as they are packed."""
    at, found = len(MAGIC_ROS1), []
    while at < len(bag):
        begin = at
        header, at = _piece(bag, at)
        data, at = _piece(bag, at)
        found.append(Ros1Record(_fields(header), data, begin))
    return found


def ros1_bag(records: list[Ros1Record]) -> bytes:
    """Return a bag of records; positions of chunks and of the index follow them."""
    moved, size = dict[int, int](), len(MAGIC_ROS1)
    for record in records:
        moved.setdefault(record.at, size)
        size += 8 + len(record.header) + len(record.data)
    index = min((moved[r.at] for r in records if r.fields.get("op") == b"\x07"), default=size)
    parts = [MAGIC_ROS1]
    for record in records:
        fields = dict(record.fields)
        if fields.get("op") == BAG and "index_pos" in fields:
            fields["index_pos"] = struct.pack("<Q", index)
        if fields.get("op") == CHUNK_INFO and len(fields.get("chunk_pos", b"")) == 8:
            (before,) = struct.unpack("<Q", fields["chunk_pos"])
            fields["chunk_pos"] = struct.pack("<Q", moved.get(before, before))
        parts += [sized(replace(record, fields=fields).header), sized(record.data)]
    return b"".join(parts)


def ros1_repacked(record: Ros1Record, raw: bytes, packing: str) -> Ros1Record:
    """Return a chunk of other content, packed in some way."""
    fields = {
        **record.fields,
        "compression": packing.encode(),
        "size": struct.pack("<I", len(raw)),
    }
    return replace(record, fields=fields, data=PACKERS[packing](raw))


def _piece(data: bytes, at: int) -> tuple[bytes, int]:
    (length,) = struct.unpack_from("<I", data, at)
    return data[at + 4 : at + 4 + length], at + 4 + length


def _fields(header: bytes) -> dict[str, bytes]:
    at, found = 0, {}
    while at < len(header):
        pair, at = _piece(header, at)
        name, _, value = pair.partition(b"=")
        found[name.decode()] = value
    return found


@dataclass(frozen=True)
class McapRecord:
    """A record of an mcap file."""

    op: int
    data: bytes


@dataclass(frozen=True)
class McapChunk:
    """What a chunk holds, and what it says of that."""

    start_ns: int
    end_ns: int
    raw: bytes
    packing: str = ""
    declared: int | None = None
    """Size that it claims to unpack to; its own where there is none."""

    def record(self) -> McapRecord:
        """Return it as it is written, with a checksum that fits."""
        size = len(self.raw) if self.declared is None else self.declared
        data = struct.pack("<QQQI", self.start_ns, self.end_ns, size, crc32(self.raw))
        packed = PACKERS[self.packing](self.raw)
        data += sized(self.packing.encode()) + struct.pack("<Q", len(packed)) + packed
        return McapRecord(MCAP_CHUNK, data)


def mcap_records(file: bytes) -> list[McapRecord]:
    """Return the records of a whole mcap file, as they are packed."""
    at, found = len(MAGIC_MCAP), []
    while at < len(file) - len(MAGIC_MCAP):
        op, length = struct.unpack_from("<BQ", file, at)
        found.append(McapRecord(op, file[at + 9 : at + 9 + length]))
        at += 9 + length
    return found


def mcap_chunk(record: McapRecord) -> McapChunk:
    """Return a chunk that is not packed, or packed with zstd or lz4."""
    start, end, _, _ = struct.unpack_from("<QQQI", record.data)
    packing, at = _piece(record.data, 28)
    raw = record.data[at + 8 :]
    if packing == b"zstd":
        raw = ZSTD.decompress(raw)
    elif packing == b"lz4":
        raw = lz4.frame.decompress(raw)
    return McapChunk(start, end, raw, packing.decode())


def mcap_file(records: list[McapRecord]) -> bytes:
    """Return an mcap file without a summary: whoever reads it has to look at all records."""
    footer = McapRecord(MCAP_FOOTER, struct.pack("<QQI", 0, 0, 0))
    return mcap_as_it_is([*records, footer])


def mcap_as_it_is(records: list[McapRecord]) -> bytes:
    """Return records one after the other, whatever they say of each other's places."""
    body = b"".join(struct.pack("<BQ", each.op, len(each.data)) + each.data for each in records)
    return MAGIC_MCAP + body + MAGIC_MCAP


def mcap_body(file: bytes) -> list[McapRecord]:
    """Return the records of an mcap file up to the end of its data."""
    records = mcap_records(file)
    end = next(k for k, each in enumerate(records) if each.op == 0x0F)
    return records[: end + 1]
