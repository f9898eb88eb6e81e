"""What is written as YAML is what is read, and its lists of numbers are written in one piece."""

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from l2m_gtsam.storage.yaml_file import yaml_text

NUMBER = st.integers(-(10**20), 10**20) | st.floats()
LEAF = st.none() | st.booleans() | NUMBER | st.text("ab0-", max_size=6)
TREE = st.recursive(
    LEAF | st.lists(NUMBER, max_size=70),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text("ab", min_size=1, max_size=2), inner)
    ),
    max_leaves=12,
)


@settings(max_examples=30, deadline=None)
@given(st.dictionaries(st.text("ab", min_size=1, max_size=3), TREE))
def test_content_comes_back(content: dict[str, Any]) -> None:
    found = YAML(typ="safe", pure=True).load(yaml_text(content, "Comment."))
    assert _same(found, content)


def test_lists_of_numbers_stay_on_one_line_and_others_do_not() -> None:
    content = {"t": [1, 2.5, math.inf], "C": [[1.0, -1e-7], [0.0, math.nan]], "names": ["a", "b"]}
    lines = yaml_text(content, "One.\nTwo.").splitlines()
    head = ["# One.", "# Two.", "t: [1, 2.5, .inf]", "C:"]
    assert lines == [*head, "- [1.0, -1e-07]", "- [0.0, .nan]", "names: [a, b]"]


def test_a_text_like_a_mark_stays_a_text() -> None:
    mark = "row00000000000000000000000000000000-0-"
    assert yaml_text({"a": mark, "b": [1, 2]}, "") == f"a: {mark}\nb: [1, 2]\n"


def _same(found: Any, content: Any) -> bool:
    """Return whether values are equal, where not a number equals itself."""
    if isinstance(content, dict):
        return found.keys() == content.keys() and all(_same(found[k], content[k]) for k in content)
    if isinstance(content, list):
        return len(found) == len(content) and all(map(_same, found, content))
    if isinstance(content, float):
        return bool(found == pytest.approx(content, rel=0, abs=0, nan_ok=True))
    return type(found) is type(content) and bool(found == content)
