"""Values and their standard deviations as a person reads them, and what strangers named."""

import unicodedata
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.text import (
    LONGEST_LINE,
    LONGEST_VALUE,
    by_sigma,
    limit,
    shown,
    shown_value,
    sigma_alone,
    significant,
    vector_by_sigma,
    with_sigma,
)


@pytest.mark.parametrize(
    ("value", "sigma", "shown"),
    [
        (0.00083133, 0.0085, "0.0008 ± 0.0085"),
        (-9.9999, 0.0797, "-10.000 ± 0.080"),
        (6.8, 0.25, "6.80 ± 0.25"),
        (43.2, 11.3, "43 ± 11"),
        (2109.0, 213.0, "2110 ± 210"),
        (0.4382, 0.0996, "0.44 ± 0.10"),  # rounding adds a digit before the point
        (123456.7, 2345.0, "123500 ± 2300"),
        (-0.0001, 0.2, "0.00 ± 0.20"),  # never minus zero
        (0.5, 0.0, "0.5 ± 0"),
        (1.0, inf, "not determined"),
        (nan, 1.0, "not determined"),
        (-2e8, 3e7, "-2.00e+08 ± 3.0e+07"),
    ],
)
def test_a_value_ends_where_its_sigma_does(value: float, sigma: float, shown: str) -> None:
    assert with_sigma(value, sigma) == shown
    assert by_sigma(value, sigma) == shown.partition(" ± ")[0]


def test_units_and_signs_are_kept() -> None:
    assert with_sigma(6.8, 0.25, "°", signed=True) == "+6.80 ± 0.25°"
    assert with_sigma(-43.2, 11.3, "A m²", signed=True) == "-43 ± 11 A m²"
    assert with_sigma(1.0, inf, "mm") == "not determined"
    assert vector_by_sigma((1.0, -2.0, 3.0), (0.1, 0.02, inf)) == "(1.000, -2.000, not determined)"


@pytest.mark.parametrize(
    ("value", "digits", "shown"),
    [
        (1.0, 2, "1.0"),
        (0.0996, 2, "0.10"),
        (2100.0, 2, "2100"),
        (12345.6, 3, "12346"),
        (1e-7, 2, "1.0e-07"),
        (0.0, 3, "0"),
        (inf, 3, "–"),
    ],
)
def test_significant_digits_have_no_exponent(value: float, digits: int, shown: str) -> None:
    assert significant(value, digits) == shown


def test_a_sigma_has_two_digits_and_a_limit_no_zeros_at_its_end() -> None:
    assert [sigma_alone(each) for each in (0.0072, 0.0093, 20.4, 199.6, inf)] == [
        "0.0072",
        "0.0093",
        "20",
        "200",
        "–",
    ]
    assert [limit(each) for each in (10.0, 0.5, 100 / 3, 2000.0)] == ["10", "0.5", "33.3", "2000"]


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
