"""Text that others wrote, made fit to be shown: the one place for names and values of strangers.

Names of topics, frames, sensors and files come from bags and file systems. Shown as they are, they
would move the cursor, change colours or turn the direction of the text around them.
"""

import unicodedata
from typing import Any

LONGEST_LINE = 2000  # letters of a message; the longest of ours list the sensors of a vehicle
LONGEST_VALUE = 80  # letters of a value in a message
# Control characters, those that change the direction of others, lone surrogates, ends of lines.
HIDDEN = ("Cc", "Cf", "Cs", "Zl", "Zp")


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
