"""Comparison of records, and those that the program writes and does not read."""

import json
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from l2m_gtsam.records.validation import Validation

VALIDATION = TypeAdapter(Validation)


def validation_in(path: Path) -> Validation:
    """Return the validation in a ``validation.json``."""
    return VALIDATION.validate_json(json.dumps(json.loads(path.read_text())["validation"]))


def assert_equal(a: object, b: object) -> None:
    """Compare records field by field, arrays bit by bit, NaN equal to NaN."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, dict) and isinstance(b, dict):
        assert_equal(tuple(a.items()), tuple(b.items()))
    elif isinstance(a, tuple | list) and isinstance(b, tuple | list):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    elif hasattr(a, "__dataclass_fields__"):
        for name, field in a.__dataclass_fields__.items():
            if field.compare:
                assert_equal(getattr(a, name), getattr(b, name))
    elif isinstance(a, float) and isinstance(b, float) and np.isnan(a):
        assert np.isnan(b)
    else:
        assert a == b
