"""YAML that is small on the disk and endless in memory or time."""

from io import StringIO
from pathlib import Path
from time import process_time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from l2m_gtsam.config import load_config
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.storage.yaml_file import MAX_BYTES, MAX_DEPTH, BoundedYAML, TooMuchYAMLError
from tests.support.alarms import ends_within

MOST_S = 5.0  # of a core; the worst takes under 1 s here


def laughs(levels: int) -> str:
    """Return nested aliases that stand for 10 ** levels words."""
    anchors = ["&a0 [x, x, x, x, x, x, x, x, x, x]"]
    inside = [", ".join([f"*a{level}"] * 10) for level in range(levels - 1)]
    anchors += [f"&a{level + 1} [{each}]" for level, each in enumerate(inside)]
    return f"bag: [{', '.join(anchors)}]\n"


BAD = {
    "aliases": (laughs(12), "aliases counted in full"),
    "a hoard of aliases": (f"a: &a [{'x, ' * 5000}]\nb: [{'*a, ' * 5000}]\n", "counted in full"),
    "itself": ("a: &a [*a]\n", "holds itself"),
    "brackets": ("a: " + "[" * 5000, "levels deep"),
    "braces": ("a: " + "{b: " * 5000, "levels deep"),
    "indents": ("\n".join(" " * k + "a:" for k in range(1000)), "levels deep"),
    "dashes": ("- " * 5000, "levels deep"),
    "large": ("a: " + "x" * MAX_BYTES, "larger than 2 MB"),
    "digits": ("bag: " + "9" * 5000, "not valid YAML"),
    "tag": ("bag: !!python/object/apply:os.system [x]", "not valid YAML"),
}


@pytest.mark.parametrize("name", BAD)
def test_too_much_is_refused_in_time(tmp_path: Path, name: str) -> None:
    text, reason = BAD[name]
    path = tmp_path / "config.yaml"
    path.write_text(text)
    start = process_time()
    with ends_within(60), pytest.raises(ConfigError) as error:
        load_config(path)
    assert process_time() - start < MOST_S
    assert reason in str(error.value)
    assert len(str(error.value)) < 400 + len(str(path))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("bag: [" + "x, " * 1000 + "]\n", "got a list of 1000"),
        ("bag: " + "x" * 1000 + "\n", "got 'xxx"),
        ("bag: {fields: {a: 1}}\n", "got a table of 1"),
        ("bag: " + "9" * 4000 + "\n", "a number of many digits"),
        (f"{'x' * 900}: 1\n", "unknown key 'xxx"),
    ],
)
def test_what_was_given_is_told_shortly(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_config(path)
    assert told in str(error.value)
    assert len(str(error.value)) < 400 + len(str(path))


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.text("abc -#&*!%\"'", max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text("abc", min_size=1), inner),
    max_leaves=20,
)


@given(PLAIN)
def test_everything_else_is_read_as_before(content: object) -> None:
    into = StringIO()
    YAML(typ="safe", pure=True).dump(content, into)
    assert BoundedYAML().load(into.getvalue()) == YAML(typ="safe", pure=True).load(into.getvalue())


def test_aliases_and_depth_as_people_use_them() -> None:
    text = "base: &base {x: 1, y: [1, 2]}\nother: *base\n"
    assert BoundedYAML().load(text)["other"] == {"x": 1, "y": [1, 2]}
    deep = "[" * (MAX_DEPTH - 1) + "]" * (MAX_DEPTH - 1)
    assert BoundedYAML().load(deep) is not None
    with pytest.raises(TooMuchYAMLError):
        BoundedYAML().load("[" * 50 + "]" * 50)
    with pytest.raises(YAMLError):
        BoundedYAML().load("a: [")
