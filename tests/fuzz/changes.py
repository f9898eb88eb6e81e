"""Changes of files: of bytes, of words, and of values in trees."""

import json
import re
from collections.abc import Callable
from io import StringIO
from random import Random
from typing import Any

from ruamel.yaml import YAML

NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
WORDS = (
    *("nan", "inf", "-inf", "0", "-0.0", "1e999", "-1e308", "1e-320", "9" * 400, "1e18", "-1"),
    *("", "x", "'", '"', "\x00", "\x1b[31m", "\u202e", "\ud7ff", "a" * 3000, "../../etc/passwd"),
    *("{{7*7}}", "<script>alert(1)</script>", "!!python/object:os.system", "*a", "&a", "null"),
)
VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 1e308, -1e308, 1e-320, float("nan"), float("inf"), 2**63, 10**30),
    *("", "x", "\x1b]0;t\x07", "a" * 3000, [], {}, [[]], [0], [1e200] * 3, {"x": 1}),
)
Change = Callable[[bytes, Random], bytes]


def changed_bytes(data: bytes, random: Random) -> bytes:
    """Return bytes changed at one to eight places."""
    found = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 4, 8))):
        random.choice(BYTE_CHANGES)(found, random)
    return bytes(found)


def _flip(data: bytearray, random: Random) -> None:
    if data:
        data[random.randrange(len(data))] ^= 1 << random.randrange(8)


def _number(data: bytearray, random: Random) -> None:
    size, at = random.choice((1, 2, 4, 8)), random.randrange(len(data) + 1)
    value = random.choice(NUMBERS) % (1 << 8 * size)
    data[at : at + size] = value.to_bytes(size, random.choice(("little", "big")))


def _cut(data: bytearray, random: Random) -> None:
    del data[random.randrange(len(data) + 1) :]


def _remove(data: bytearray, random: Random) -> None:
    at = random.randrange(len(data) + 1)
    del data[at : at + random.randrange(1, 200)]


def _insert(data: bytearray, random: Random) -> None:
    at = random.randrange(len(data) + 1)
    data[at:at] = random.randbytes(random.randrange(1, 64))


def _repeat(data: bytearray, random: Random) -> None:
    at = random.randrange(len(data) + 1)
    piece = data[at : at + random.randrange(1, 500)]
    data[at:at] = piece * random.choice((1, 2, 50))


def _zero(data: bytearray, random: Random) -> None:
    at = random.randrange(len(data) + 1)
    piece = data[at : at + random.randrange(1, 100)]
    data[at : at + len(piece)] = bytes(len(piece))


BYTE_CHANGES = (_flip, _flip, _number, _number, _cut, _remove, _insert, _repeat, _zero)


def changed_words(data: bytes, random: Random) -> bytes:
    """Return a text with some words replaced, or lines dropped, repeated or put elsewhere."""
    lines = data.decode("utf-8", "replace").split("\n")
    for _ in range(random.choice((1, 1, 2, 5))):
        row, how = random.randrange(len(lines)), random.randrange(6)
        if how == 0:
            del lines[row:]
            lines.append("")
        elif how == 1:
            lines[row:row] = [lines[row]] * random.choice((1, 3, 200))
        elif how == 2:
            other = random.randrange(len(lines))
            lines[row], lines[other] = lines[other], lines[row]
        else:
            lines[row] = _with_other_word(lines[row], random)
    return "\n".join(lines).encode("utf-8", "replace")


def _with_other_word(line: str, random: Random) -> str:
    words = list(re.finditer(r"[^\s,;:\[\]{}]+", line))
    if not words:
        return random.choice(WORDS)
    word = random.choice(words)
    return line[: word.start()] + random.choice(WORDS) + line[word.end() :]


def changed_yaml(data: bytes, random: Random) -> bytes:
    """Return a YAML whose values were changed."""
    into = StringIO()
    YAML(typ="safe", pure=True).dump(changed_tree(YAML(typ="safe").load(data), random), into)
    return into.getvalue().encode("utf-8", "replace")


def changed_json(data: bytes, random: Random) -> bytes:
    """Return a JSON whose values were changed."""
    return json.dumps(changed_tree(json.loads(data), random)).encode()


def changed_tree(tree: Any, random: Random) -> Any:
    """Return plain values of which some were changed, dropped, repeated or added."""
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        tree = _changed_once(tree, random)
    return tree


def _changed_once(tree: Any, random: Random) -> Any:
    """Change one value, at a depth that is drawn step by step."""
    if not isinstance(tree, dict | list) or not tree or random.random() < 0.08:
        return _other_value(tree, random)
    keys: list[Any] = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
    key = random.choice(keys)
    if random.random() < 0.12:
        _change_place(tree, key, random)
    else:
        tree[key] = _changed_once(tree[key], random)
    return tree


def _change_place(tree: Any, key: Any, random: Random) -> None:
    """Drop, repeat or add something."""
    how = random.randrange(3)
    if how == 0:
        del tree[key]
    elif isinstance(tree, list):
        tree[key:key] = [tree[key]] * random.choice((1, 2, 100))
    elif how == 1:
        tree[random.choice(WORDS)] = tree[key]
    else:
        tree[random.choice(list(tree))] = tree[key]


def _other_value(value: Any, random: Random) -> Any:
    if isinstance(value, float | int) and random.random() < 0.5:
        return random.choice((-value, value * 1e6, value + 1, value * 1e300, -1e-300, 0.0))
    if isinstance(value, list) and value and random.random() < 0.5:
        return value[: random.randrange(len(value))]
    return random.choice(VALUES)
