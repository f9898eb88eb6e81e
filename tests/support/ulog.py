"""A writer of ULogs, by PX4's description of the format."""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from l2m_gtsam.data import FloatArray

MAGIC = b"ULog\x01\x12\x35\x01"


def _message(kind: str, payload: bytes) -> bytes:
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def write_ulog(
    path: Path, topics: Sequence[tuple[str, int, Mapping[str, int], FloatArray, FloatArray]]
) -> Path:
    """Write topics to a ULog.

    Parameters
    ----------
    path
        File to write.
    topics
        Of each its name, its instance, its fields of float32 with the length of an array (1 for a
        number), times in microseconds, shape (N,), and values in order of the fields, shape (N, K).
    """
    parts = [MAGIC + struct.pack("<Q", 0), _message("B", bytes(40))]
    written = set()
    for name, _, fields, _, _ in topics:
        if name not in written:
            kinds = [f"float{f'[{n}]' if n > 1 else ''} {field}" for field, n in fields.items()]
            layout = f"{name}:{';'.join(['uint64_t timestamp', *kinds])};"
            parts.append(_message("F", layout.encode()))
            written.add(name)
    for index, (name, instance, *_) in enumerate(topics):
        parts.append(_message("A", struct.pack("<BH", instance, index) + name.encode()))
    for index, (_, _, _, stamps, values) in enumerate(topics):
        for stamp, row in zip(stamps, np.asarray(values, dtype="<f4"), strict=True):
            parts.append(_message("D", struct.pack("<HQ", index, int(stamp)) + row.tobytes()))
    path.write_bytes(b"".join(parts))
    return path
