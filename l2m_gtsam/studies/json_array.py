"""Arrays within records that go through JSON, which has neither NaN nor infinity: null stands."""

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
