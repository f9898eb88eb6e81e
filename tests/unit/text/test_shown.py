"""What strangers named, as text."""

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.text.shown import LONGEST_LINE, LONGEST_VALUE, shown, shown_value


@given(st.text(max_size=200))
def test_nothing_that_moves_the_cursor_is_left(text: str) -> None:
    made = shown(text)
    assert not any(unicodedata.category(each) in ("Cc", "Cf", "Cs", "Zl", "Zp") for each in made)
    made.encode()  # can be written


@given(st.text(st.characters(exclude_categories=["C", "Zl", "Zp"]), max_size=200))
def test_everything_else_stays(text: str) -> None:
    assert shown(text) == text


@pytest.mark.parametrize(
    ("text", "made"),
    [
        ("\x1b]0;title\x07", r"\x1b]0;title\x07"),
        ("a\u202eb", r"a\u202eb"),
        ("two\nlines", r"two\nlines"),
        ("\udcff", r"\udcff"),
        ("Größe 磁", "Größe 磁"),
    ],
)
def test_examples(text: str, made: str) -> None:
    assert shown(text) == made


def test_length() -> None:
    assert len(shown("x" * 10**6)) <= LONGEST_LINE + 3
    assert shown("ab" * 10, 5) == "aba … ab"


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.integers() | st.text() | st.binary(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
)
def test_values_are_told_shortly(value: object) -> None:
    assert len(shown_value(value)) <= 6 * LONGEST_VALUE


@pytest.mark.parametrize("sign", [1, -1])
def test_numbers_of_many_digits(sign: int) -> None:
    assert shown_value(sign * 10**5000) == "a number of many digits"
