"""Values and their standard deviations as a person reads them."""

from math import inf, nan

import pytest

from l2m_gtsam.text.rounded import (
    by_sigma,
    limit,
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
