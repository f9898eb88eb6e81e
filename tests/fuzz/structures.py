"""Changes inside containers: what is packed is changed, and sizes and checksums fit again."""

import io
import sqlite3
import struct
import tempfile
import zipfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from l2m_gtsam.errors import MapError
from l2m_gtsam.storage.map_file import load_map, save_map
from l2m_gtsam.storage.rosbags_bounds import ZSTD
from tests.fuzz.changes import NUMBERS, VALUES, WORDS, changed_bytes, changed_tree
from tests.support.bag_records import (
    CHUNK,
    MCAP_CHUNK,
    McapRecord,
    Ros1Record,
    mcap_body,
    mcap_chunk,
    mcap_file,
    ros1_bag,
    ros1_records,
    ros1_repacked,
)


def changed_ros1(data: bytes, random: Random) -> bytes:
    """Return a bag of ROS 1 with records changed."""
    records = ros1_records(data)
    for _ in range(random.choice((1, 1, 2, 4))):
        place = random.randrange(len(records))
        how = random.randrange(8)
        if how == 0:
            del records[place]
        elif how == 1:
            records.insert(place, records[place])
        elif how == 2:
            records[place] = _other_fields(records[place], random)
        else:
            chunks = [k for k, each in enumerate(records) if each.fields.get("op") == CHUNK]
            if how < 7 and chunks:
                place = random.choice(chunks)
                raw = _inner(records[place].data, random)
                packing = random.choice(("none", "bz2", "lz4"))
                records[place] = ros1_repacked(records[place], raw, packing)
            else:
                other = changed_bytes(records[place].data, random)
                records[place] = replace(records[place], data=other)
        if not records:
            break
    return ros1_bag(records)


def _other_fields(record: Ros1Record, random: Random) -> Ros1Record:
    fields = dict(record.fields)
    name = random.choice(list(fields) or [""])
    size = len(fields.get(name, b"")) or 4
    how = random.randrange(4)
    if how == 0:
        fields.pop(name, None)
    elif how == 1:
        number = random.choice(NUMBERS) % (1 << 8 * min(size, 8))
        fields[name] = number.to_bytes(min(size, 8), "little")
    elif how == 2:
        fields[name] = random.choice(WORDS).encode("utf-8", "replace")
    else:
        fields[name] = changed_bytes(fields.get(name, b""), random)
    return replace(record, fields=fields)


def _inner(raw: bytes, random: Random) -> bytes:
    """Change numbers or bytes without changing the length, so that indices still fit."""
    made = bytearray(raw)
    for _ in range(random.choice((1, 3, 10))):
        if len(made) < 8:
            break
        at = random.randrange(len(made) - 7)
        if random.random() < 0.5:
            value = random.choice((float("nan"), float("inf"), 1e200, -1e308, 0.0, 1e-310, 1e9))
            made[at : at + 8] = struct.pack("<d", value)
        else:
            made[at : at + 4] = struct.pack("<I", random.choice(NUMBERS))
    return bytes(made)


def changed_mcap(data: bytes, random: Random) -> bytes:
    """Return an mcap file with records changed, whose chunks have checksums that fit."""
    records = mcap_body(data)
    for _ in range(random.choice((1, 1, 2, 4))):
        chunks = [k for k, each in enumerate(records) if each.op == MCAP_CHUNK]
        place, how = random.randrange(len(records)), random.randrange(8)
        if how == 0:
            del records[place]
        elif how == 1:
            records.insert(place, records[place])
        elif how == 2:
            records[place] = replace(
                records[place], data=changed_bytes(records[place].data, random)
            )
        elif how == 3:
            records[place] = McapRecord(random.choice(range(16)), records[place].data)
        elif chunks:
            place = random.choice(chunks)
            try:
                chunk = mcap_chunk(records[place])
            except (RuntimeError, struct.error, ValueError, EOFError, ZSTD.ZstdError):
                continue
            raw = (_inner if random.random() < 0.7 else changed_bytes)(chunk.raw, random)
            packing = random.choice(("", "lz4", "zstd"))
            declared = random.choice((None, None, None, 0, 2**31, 2**63))
            made = replace(chunk, raw=raw, packing=packing, declared=declared)
            records[place] = made.record()
        if not records:
            break
    return mcap_file(records)


def changed_db3(data: bytes, random: Random) -> bytes:
    """Return a bag in SQLite with cells changed."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag.db3"
        path.write_bytes(data)
        base = sqlite3.connect(path)
        try:
            for _ in range(random.choice((1, 2, 5, 20))):
                _change_cell(base, random)
            base.commit()
        finally:
            base.close()
        return path.read_bytes()


def _change_cell(base: sqlite3.Connection, random: Random) -> None:
    table = random.choice(("messages", "messages", "messages", "topics", "schema", "metadata"))
    try:
        rows = base.execute(f"SELECT rowid, * FROM {table}")  # noqa: S608 - of our own words
        names, found = [each[0] for each in rows.description][1:], rows.fetchall()
        if not found:
            return
        row, column = random.choice(found), random.randrange(len(names))
        before = row[column + 1]
        made: Any = random.choice((None, 0, -1, 2**62, "x", b"", "\x1b[31m", 1.5))
        if isinstance(before, bytes) and random.random() < 0.9:
            made = (
                _inner(before, random) if random.random() < 0.7 else changed_bytes(before, random)
            )
        elif isinstance(before, str) and random.random() < 0.5:
            made = random.choice(WORDS)
        command = f"UPDATE {table} SET {names[column]} = ? WHERE rowid = ?"  # noqa: S608
        base.execute(command, (made, row[0]))
    except (sqlite3.Error, OverflowError, UnicodeEncodeError):
        return


def changed_map(data: bytes, random: Random) -> bytes:
    """Return a map with other numbers, whose checksum fits."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.npz"
        path.write_bytes(data)
        state = load_map(path)
        arrays = dict(state.arrays)
        if random.random() < 0.3:
            state = replace(state, options=changed_tree(state.options, random))
        for _ in range(random.choice((1, 1, 3))):
            name = random.choice(list(arrays))
            if random.random() < 0.1:
                del arrays[name]
                break
            arrays[name] = _other_array(arrays[name], random)
        with suppress(MapError):  # what cannot be written, as no JSON
            save_map(path, replace(state, arrays=arrays))
        return path.read_bytes()


def changed_cloud(data: bytes, random: Random) -> bytes:
    """Return an archive of points with other numbers, shapes or types."""
    points = np.load(io.BytesIO(data))["points"]
    into = io.BytesIO()
    np.savez(into, points=_other_array(points, random))
    return into.getvalue()


def _other_array(array: Any, random: Random) -> Any:
    made = np.array(array)
    how = random.randrange(6)
    if how < 3 and made.size and made.dtype.kind in "fiu":
        flat = made.reshape(-1)
        for _ in range(random.choice((1, 5))):
            value = random.choice((np.nan, np.inf, 1e200, -1e200, 0.0, 1e-310, -1.0, 1e15))
            if made.dtype.kind != "f":
                value = float(random.choice((0, 1, 100, 2**30)))
            flat[random.randrange(flat.size)] = value
        return made
    if how == 3 and made.ndim:
        return made[: random.randrange(len(made) + 1)]
    if how == 4:
        return made[None]
    return made.astype(random.choice(("<f4", "<i8", "<c16", "|b1")), casting="unsafe")


def changed_archive(data: bytes, random: Random) -> bytes:
    """Return an archive with members changed, dropped or packed in other ways, with right CRCs."""
    into = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(into, "w") as target:
        names = source.namelist()
        chosen = random.choice(names)
        for name in names:
            content, how = source.read(name), random.randrange(4)
            packing = zipfile.ZIP_STORED
            if name == chosen:
                if how == 0:
                    continue
                if how == 1:
                    content = changed_bytes(content, random)
                elif how == 2:
                    packing = random.choice((8, 12, 14))
                else:
                    name = str(random.choice(VALUES))[:100] or "x"
            target.writestr(name, content, packing)
    return into.getvalue()
