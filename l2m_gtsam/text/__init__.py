"""Text as a person reads it: numbers with the digits that they deserve, and what others wrote.

A standard deviation has two significant digits, its value ends at the same decimal, and zeros at
the end stay. Entries of a vector end at one decimal, that of the smallest. Exponents are for what
is below 1e-5 or above 1e7 only.

Names of topics, frames, sensors and files come from bags and file systems. Shown as they are, they
would move the cursor, change colours or turn the direction of the text around them: here is the one
place that makes them fit to be shown.
"""

import unicodedata
from collections.abc import Iterable
from math import inf, isfinite
from typing import Any

OF_SIGMA = 2  # significant digits of a standard deviation
LEAST, MOST = -5, 7  # decades between which no number has an exponent
NONE = "–"
OPEN = "not determined"
LONGEST_LINE = 2000  # letters of a message; the longest of ours list the sensors of a vehicle
LONGEST_VALUE = 80  # letters of a value in a message
# Control characters, those that change the direction of others, lone surrogates, ends of lines.
HIDDEN = ("Cc", "Cf", "Cs", "Zl", "Zp")


def significant(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits; a dash where it is none or infinite.

    All digits before the point stay.
    """
    if not isfinite(value):
        return NONE
    if value == 0:
        return "0"
    decade = _decade(value, digits)
    if not LEAST <= decade < MOST:
        return f"{value:.{digits - 1}e}"
    return _ending_at(value, max(digits - 1 - decade, 0))


def limit(value: float) -> str:
    """Return a number that was chosen, of which zeros at the end say nothing."""
    text = significant(value)
    return text.rstrip("0").rstrip(".") if "." in text and "e" not in text else text


def sigma_alone(sigma: float) -> str:
    """Return a standard deviation; a dash where it is infinite."""
    places = _places(sigma)
    return significant(sigma, OF_SIGMA) if places is None else _ending_at(sigma, places)


def by_sigma(value: float, sigma: float, unit: str = "", *, signed: bool = False) -> str:
    """Return a value that ends where its standard deviation does; "not determined" if infinite.

    What is exact, with a standard deviation of zero, has at most six significant digits.
    """
    if not isfinite(value) or not isfinite(sigma):
        return OPEN
    places = _places(sigma)
    text = f"{value:g}" if places is None else _ending_at(value, places)
    return in_unit(f"+{text}" if signed and not text.startswith("-") else text, unit)


def with_sigma(value: float, sigma: float, unit: str = "", *, signed: bool = False) -> str:
    """Return a value with its standard deviation and unit; "not determined" if that is infinite."""
    text = by_sigma(value, sigma, signed=signed)
    if text == OPEN:
        return text
    return in_unit(f"{text} ± {sigma_alone(sigma)}", unit)


def in_unit(number: str, unit: str) -> str:
    """Return a number with its unit, with a space between unless the unit is that of an angle."""
    return f"{number}{'' if unit in ('', '°', '%') else ' '}{unit}"


def entries_by_sigma(values: Iterable[float], sigmas: Iterable[float]) -> list[str]:
    """Return the entries of a vector, all ending where the smallest standard deviation does."""
    own = list(sigmas)
    least = _least(own)
    return [by_sigma(v, least if _counts(s) else s) for v, s in zip(values, own, strict=True)]


def sigma_entries(sigmas: Iterable[float]) -> list[str]:
    """Return standard deviations of a vector's entries; a dash for each that is infinite."""
    own = list(sigmas)
    places = _places(_least(own))
    return [
        sigma_alone(s) if places is None or not _counts(s) else _ending_at(s, places) for s in own
    ]


def vector_by_sigma(values: Iterable[float], sigmas: Iterable[float]) -> str:
    """Return a vector in brackets, its entries as ``entries_by_sigma`` has them."""
    return f"({', '.join(entries_by_sigma(values, sigmas))})"


def vector_of_sigmas(sigmas: Iterable[float]) -> str:
    """Return standard deviations in brackets; a dash for each that is infinite."""
    return f"({', '.join(sigma_entries(sigmas))})"


def _counts(sigma: float) -> bool:
    return isfinite(sigma) and sigma > 0


def _least(sigmas: Iterable[float]) -> float:
    """Return the smallest standard deviation that counts; infinite without one."""
    return min(filter(_counts, sigmas), default=inf)


def _decade(value: float, digits: int) -> int:
    """Return the power of ten of the first digit, once it is rounded to so many."""
    return int(f"{value:.{digits - 1}e}".partition("e")[2])


def _places(sigma: float) -> int | None:
    """Return the decimal at which a standard deviation ends, below zero before the point."""
    if not isfinite(sigma) or sigma <= 0:
        return None
    return OF_SIGMA - 1 - _decade(sigma, OF_SIGMA)


def _ending_at(value: float, places: int) -> str:
    # adding zero takes the sign from a zero
    rounded = round(float(value), places) + 0.0
    decade = _decade(rounded, 1) if rounded else 0
    if not LEAST <= decade < MOST:
        return f"{rounded:.{max(decade + places, 0)}e}"
    return f"{rounded:.{max(places, 0)}f}"


def shown(text: str, longest: int | None = LONGEST_LINE) -> str:
    """Return text with control characters in words, and not longer than so many letters.

    Parameters
    ----------
    text
        Any text.
    longest
        Letters; what lies between the beginning and the end of a longer text is left out. None
        leaves nothing out.
    """
    if longest is not None and len(text) > longest:
        half = longest // 2
        text = f"{text[: longest - half]} … {text[-half:]}"
    if text.isprintable():
        return text
    return "".join(_in_words(each) if _is_hidden(each) else each for each in text)


def shown_lines(text: str) -> str:
    """Return text whose lines are as ``shown`` has them, in full."""
    return text if text.isprintable() else "\n".join(shown(line, None) for line in text.split("\n"))


def shown_value(value: Any) -> str:
    """Return a value as Python writes it, within ``LONGEST_VALUE`` letters and with few steps.

    A number of thousands of digits, or a list of lists of lists, is described by its kind.
    """
    if isinstance(value, str):
        return shown(repr(value[: LONGEST_VALUE + 1]), LONGEST_VALUE)
    if value is None or isinstance(value, bool | float):
        return repr(value)
    if isinstance(value, int):
        return repr(value) if abs(value) < 10**LONGEST_VALUE else "a number of many digits"
    if isinstance(value, list | tuple | set | frozenset):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return f"a table of {len(value)}"
    return shown(type(value).__name__, LONGEST_VALUE)


def _is_hidden(letter: str) -> bool:
    return unicodedata.category(letter) in HIDDEN


def _in_words(letter: str) -> str:
    return letter.encode("unicode_escape").decode("ascii")
