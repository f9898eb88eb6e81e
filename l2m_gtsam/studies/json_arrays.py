"""Arrays within records that go through JSON, which has neither NaN nor infinity: null instead."""

import base64
import zlib
from typing import Annotated, Any

import numpy as np
from pydantic import PlainSerializer, PlainValidator

from l2m_gtsam.data import BoolArray, FloatArray


def plain_floats(values: FloatArray) -> Any:
    """Return an array as nested lists, null where it is not finite."""
    plain = values.astype(np.object_)
    plain[~np.isfinite(values)] = None
    return plain.tolist()


def floats(values: Any) -> FloatArray:
    """Return the array of nested lists, NaN for null."""
    return np.array(values, dtype=np.float64)


def bools(values: Any) -> BoolArray:
    """Return the array of nested lists."""
    return np.array(values, dtype=np.bool_)


JsonFloats = Annotated[FloatArray, PlainValidator(floats), PlainSerializer(plain_floats)]
"""An array of numbers; what is not finite comes back as NaN."""

JsonBools = Annotated[BoolArray, PlainValidator(bools), PlainSerializer(lambda v: v.tolist())]
"""An array of truth values."""


STEP = 0.01
"""What values are rounded to, in their unit."""
NOTHING = np.iinfo(np.int32).min


def pack(values: FloatArray) -> dict[str, Any]:
    """Return an array as its shape and text: whole hundredths, 32 bits, deflated, base 64."""
    known = np.isfinite(values)
    steps = np.where(known, np.round(np.where(known, values, 0.0) / STEP), NOTHING)
    packed = zlib.compress(steps.astype("<i4").tobytes(), 9)
    return {"shape": list(values.shape), "hundredths": base64.b64encode(packed).decode("ascii")}


def unpack(packed: Any) -> FloatArray:
    """Return the array that ``pack`` was given, rounded; what was not finite is NaN."""
    if isinstance(packed, np.ndarray):
        return packed
    content = zlib.decompress(base64.b64decode(packed["hundredths"]))
    steps = np.frombuffer(content, "<i4").reshape(packed["shape"])
    return np.where(steps == NOTHING, np.nan, steps * STEP)


Packed = Annotated[FloatArray, PlainValidator(unpack), PlainSerializer(pack)]
"""An array of which hundredths are enough, for pictures."""
