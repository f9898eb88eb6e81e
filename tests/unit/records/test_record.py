"""Arrays of records: those of one record have shapes that fit together."""

import json
import math
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pytest

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.records.metrics import MapPicture
from l2m_gtsam.records.record import Record, Shape
from l2m_gtsam.storage.record_files import read_metrics, read_slam

Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class _Example(Record):
    a: Annotated[Rows, Shape("N 3")]
    b: Annotated[tuple[float, ...], Shape("N")]
    c: Annotated[tuple[float, ...], Shape("N+1")]
    d: Annotated[Rows | None, Shape("M M")] = None


def test_shapes_that_fit() -> None:
    row = (1.0, 2.0, 3.0)
    _Example((row, row), (0.0, 0.0), (0.0, 0.0, 0.0), ((1.0, 2.0), (3.0, 4.0)))
    _Example((), (), (0.0,), ())
    _Example((row,), (math.inf,), (math.nan, 1e29))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"a": ((1.0, 2.0),)}, r"a must have the shape \(N 3\) with N = 1"),
        ({"b": ()}, r"b must have the shape \(N\) with N = 1"),
        ({"c": (0.0,)}, r"c must have the shape \(N\+1\) with N = 1"),
        ({"b": (-1e300,)}, r"b has 1e\+300, at most 1e\+30 can be"),
        ({"b": (10**400,)}, r"b has 1e\+300"),
        ({"a": ((1.0, 2.0, 1e31),)}, r"a has 1e\+31"),
        ({"d": ((1.0, 2.0),)}, r"d must have the shape \(M M\)"),
    ],
)
def test_arrays_that_are_wrong(changes: dict[str, Any], told: str) -> None:
    sound = {"a": ((1.0, 2.0, 3.0),), "b": (0.0,), "c": (0.0, 0.0)}
    _Example(**sound)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=told):
        _Example(**{**sound, **changes})


def _shortened(tree: Any) -> Iterator[Any]:
    """Yield the same with one number less in some list, for each kind of list of numbers."""

    def places(node: Any, at: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
        inner: Any = node.items() if isinstance(node, dict) else enumerate(node)
        if isinstance(node, list) and node and isinstance(node[0], list | int | float):
            yield at
            inner = list(enumerate(node))[:1]
        for key, value in inner:
            if isinstance(value, dict | list):
                yield from places(value, (*at, key))

    kinds = {tuple(key for key in at if isinstance(key, str)): at for at in places(tree, ())}
    for at in kinds.values():
        made = deepcopy(tree)
        node = made
        for key in at:
            node = node[key]
        node.pop()
        yield at, made


@pytest.mark.parametrize(
    "extent",
    [(0, 3e8, 0, 1), (1, 0, 0, 1), (0, 1, 1, 0), (0, math.nan, 0, 1), (-math.inf, 0, 0, 1)],
)
def test_places_that_cannot_be_drawn(extent: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="extent is"):
        MapPicture(extent, 0.0, ((1.0,),), ((1.0,),))


# Lists that may have any length: paths of a drive, options, angles that are drawn.
ANY_LENGTH = {"path", "options", "largest", "sensors", "poses", "odometry", "intensity"}


@pytest.mark.parametrize("name", ["metrics.json", "slam.json"])
def test_a_list_that_is_too_short_is_named(tmp_path: Path, repository: Path, name: str) -> None:
    content, path = json.loads((repository / "tests" / "files" / name).read_text()), tmp_path / name
    read: Callable[[Path], object] = read_metrics if name == "metrics.json" else read_slam
    refused = 0
    for at, made in _shortened(content):
        path.write_text(json.dumps(made))
        try:
            read(path)
        except CalibrationError:
            refused += 1
        else:
            assert ANY_LENGTH & set(at), at
    assert refused > 20
