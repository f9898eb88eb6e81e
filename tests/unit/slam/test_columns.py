"""Dataclasses as arrays, column by column, and back."""

from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, IntArray, RigidTransform
from l2m_gtsam.slam.online.columns import packed, unpacked
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.scan_matching import KeptScan
from l2m_gtsam.slam.options import DriftOptions
from tests.support.records import assert_equal


@dataclass(frozen=True)
class Leaf:
    """Of every type that is kept as numbers."""

    whole: int
    real: float
    flag: bool
    text: str
    kind: EventKind
    numbers: IntArray


@dataclass(frozen=True)
class Tree:
    """Of every type that holds others, itself included."""

    leaves: tuple[Leaf, ...]
    pair: tuple[int, FloatArray] | None
    names: frozenset[str]
    by_key: dict[int, Leaf]
    groups: tuple[frozenset[int], ...]
    values: list[FloatArray] = field(default_factory=list)
    before: "Tree | None" = None


INTEGERS = st.integers(-(2**63), 2**63 - 1)
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=5)


def floats(axes: int) -> st.SearchStrategy[Any]:
    """Return arrays of floats, of no element in some."""
    shapes = array_shapes(min_dims=axes, max_dims=axes, min_side=0, max_side=3)
    return arrays(np.float64, shapes)


LEAVES = st.builds(
    Leaf,
    INTEGERS,
    st.floats(),
    st.booleans(),
    TEXTS,
    st.sampled_from(EventKind),
    arrays(np.int64, st.integers(0, 3)),
)


def trees(before: st.SearchStrategy[Tree | None]) -> st.SearchStrategy[Tree]:
    """Return trees with one of those before, or none."""
    return st.builds(
        Tree,
        st.lists(LEAVES, max_size=3).map(tuple),
        st.none() | st.tuples(INTEGERS, floats(2)),
        st.frozensets(TEXTS, max_size=3),
        st.dictionaries(INTEGERS, LEAVES, max_size=2),
        st.lists(st.frozensets(INTEGERS, max_size=2), max_size=2).map(tuple),
        st.lists(floats(1), max_size=3),
        before,
    )


ONE = trees(st.none())


@given(st.lists(ONE | trees(ONE), max_size=3))
def test_what_is_packed_comes_back(values: list[Tree]) -> None:
    """Bit for bit, of the same types, NaN and empty ones included."""
    kept = packed(Tree, values, "x")
    assert all(each.dtype.kind in "biuf" for each in kept.values())
    again = unpacked(Tree, kept, len(values), "x")
    assert_equal(tuple(again), tuple(values))


@given(st.integers(0, 2), st.data())
def test_wrong_arrays_are_refused(seed: int, data: st.DataObject) -> None:
    """Without one, or with one of another length or type, or with negative numbers of elements."""
    leaf = Leaf(seed, 0.5, seed > 0, "text", EventKind.RESUMED, np.arange(3))
    tree = Tree(
        (leaf,), (1, np.eye(2)), frozenset({"a"}), {3: leaf}, (frozenset({5}),), [np.ones(seed + 1)]
    )
    kept = packed(Tree, [tree], "x")
    name = data.draw(st.sampled_from(sorted(kept)))
    right = kept.pop(name)
    wrong = [right[:-1], right[..., None], right.astype(np.complex128), right[0]]
    if name[-1] in "#:":
        wrong += [-right, right + 2**62, right - 1]
    for each in (None, *wrong):
        arrays_of = kept if each is None else kept | {name: each}
        with pytest.raises((KeyError, ValueError, TypeError)):
            unpacked(Tree, arrays_of, 1, "x")


def test_poses_and_options_come_back() -> None:
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.arange(3.0))
    drift = DriftOptions(over_m=0.1 + 0.2)
    (found,) = unpacked(gtsam.Pose3, packed(gtsam.Pose3, [pose], "x"), 1, "x")
    np.testing.assert_array_equal(found.matrix(), pose.matrix())
    assert unpacked(DriftOptions, packed(DriftOptions, [drift], "x"), 1, "x") == [drift]


def test_a_type_that_is_no_numbers_is_named() -> None:
    with pytest.raises(TypeError, match="complex"):
        packed(complex, [1j], "x")


@pytest.mark.parametrize("count", [0, 1, 3])
def test_scans_come_back(count: int) -> None:
    """In single precision, of different sizes."""
    rng = np.random.default_rng(count)
    kept = tuple(
        KeptScan(
            7 * number,
            RigidTransform(Rotation.random(random_state=number).as_matrix(), rng.normal(size=3)),
            10**18 + number,
            rng.normal(size=(5 + number, 3)).astype(np.float32),
            1.5 * number,
        )
        for number in range(count)
    )
    again = unpacked(KeptScan, packed(KeptScan, kept, "x"), count, "x")
    assert_equal(tuple(again), kept)
    assert all(each.points.dtype == np.float32 for each in again)
