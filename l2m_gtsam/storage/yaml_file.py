"""YAML in and out: counted while it is parsed, plain values only, checked against a model."""

import re
from collections.abc import Callable, Iterable
from enum import StrEnum
from io import StringIO
from pathlib import Path
from secrets import token_hex
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    CollectionEndEvent,
    CollectionStartEvent,
    DocumentStartEvent,
    Event,
    NodeEvent,
)
from ruamel.yaml.parser import Parser
from ruamel.yaml.representer import SafeRepresenter

from l2m_gtsam.errors import CalibrationError, L2MError
from l2m_gtsam.options import first_fault
from l2m_gtsam.storage.bounded import read_content
from l2m_gtsam.storage.files import atomic_path

MAX_BYTES = 2_000_000  # a calibration of a hundred sensors is half of it; ten seconds
MAX_DEPTH = 40  # ours are nested in ten levels
# With aliases in full: they are shared in memory, but not by what walks over the content.
MAX_NODES = 400_000


class TooMuchYAMLError(YAMLError):
    """A document that is nested too deep, or that has too many nodes with its aliases in full."""


class _BoundedParser(Parser):
    """Counts the nodes that come, with aliases in full, and how deep they are nested."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._open: list[tuple[str | None, int]] = []  # anchor, and nodes before it
        self._sizes: dict[str, int] = {}
        self._nodes = 0

    def get_event(self) -> Any:
        """Return the next event; a TooMuchYAMLError beyond the bounds."""
        event = super().get_event()
        if event is not None:
            self._count(event)
        return event

    def _count(self, event: Event) -> None:
        if isinstance(event, DocumentStartEvent):
            self._open, self._sizes = [], {}
        elif isinstance(event, CollectionEndEvent):
            anchor, before = self._open.pop()
            if anchor is not None:
                self._sizes[anchor] = self._nodes - before
        elif isinstance(event, AliasEvent):
            if event.anchor in (anchor for anchor, _ in self._open):
                raise TooMuchYAMLError(f"&{event.anchor} holds itself")
            self._nodes += self._sizes.get(event.anchor, 1)
        elif isinstance(event, NodeEvent):
            if isinstance(event, CollectionStartEvent):
                self._open.append((event.anchor, self._nodes))
            elif event.anchor is not None:
                self._sizes[event.anchor] = 1
            self._nodes += 1
        if len(self._open) > MAX_DEPTH:
            raise TooMuchYAMLError(f"nested more than {MAX_DEPTH} levels deep")
        if self._nodes > MAX_NODES:
            raise TooMuchYAMLError(f"more than {MAX_NODES:,} values, aliases counted in full")


class BoundedYAML(YAML):
    """A reader of plain values, whatever it is asked to be, within bounds."""

    def __init__(self, **_: Any) -> None:
        super().__init__(typ="safe", pure=True)
        self.Parser = _BoundedParser

    def load(self, stream: Any) -> Any:
        """Return the content of a text, or of a file.

        Raises
        ------
        YAMLError
            It is not YAML, or there is too much of it.
        """
        if isinstance(stream, Path):
            stream = read_content(stream, MAX_BYTES)
        elif not isinstance(stream, str | bytes):
            stream = stream.read(MAX_BYTES + 1)
        if len(stream) > MAX_BYTES:
            raise TooMuchYAMLError(f"larger than {MAX_BYTES / 1e6:g} MB")
        try:
            return super().load(stream)
        except OverflowError as reason:  # moved to UTC, year 1 or 9999 may be left
            why = "has a date that no calendar holds; accepted: years 2 to 9998"
            raise YAMLError(why) from reason
        except (ValueError, TypeError, AttributeError, KeyError, IndexError) as reason:
            raise YAMLError(" ".join(str(reason).split())[:100]) from reason
        except RecursionError as reason:
            raise TooMuchYAMLError("nested too deep") from reason


Content = TypeVar("Content")


class _Representer(SafeRepresenter):
    """Plain values, and enumerations as their text."""


def _text(writer: SafeRepresenter, text: str) -> Any:
    """Represent text; in quotes what would be read as something else: `?b`, the control NEL."""
    style = '"' if text.startswith("?") or "\x85" in text else None
    return writer.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Representer.add_representer(str, _text)
_Representer.add_multi_representer(StrEnum, lambda writer, each: _text(writer, each.value))

LONGEST = 100  # characters of what is wrong with a file, of a stranger's own words
MOST_IN_ROW = 64  # numbers, which take less than a line
LINE = 4096


class _List(list[Any]):
    """A list that takes a line for each of its items."""


class _Mapping(dict[str, Any]):
    """A mapping that does."""


_SEQ, _MAP = "tag:yaml.org,2002:seq", "tag:yaml.org,2002:map"
_Representer.add_representer(
    _List, lambda writer, each: writer.represent_sequence(_SEQ, each, flow_style=False)
)
_Representer.add_representer(
    _Mapping, lambda writer, each: writer.represent_mapping(_MAP, each, flow_style=False)
)


class _Rows:
    """Lists of numbers, written beside the emitter, which takes 50 us for each number.

    In the content a mark stands for each of them, which no text of a bag can have guessed.
    """

    def __init__(self) -> None:
        self._mark, self._writer = f"row{token_hex(16)}-", _Representer()
        self._texts: list[str] = []

    def marked(self, content: Any) -> Any:
        """Return content with a mark in the place of each list of numbers."""
        if isinstance(content, dict):
            whole = {key: self.marked(value) for key, value in content.items()}
            return _Mapping(whole) if _nested(content.values()) else whole
        if not isinstance(content, list | tuple):
            return content
        if 0 < len(content) <= MOST_IN_ROW and {*map(type, content)} <= {int, float}:
            row = ", ".join(self._writer.represent_data(each).value for each in content)
            self._texts.append(f"[{row}]")
            return f"{self._mark}{len(self._texts) - 1}-"
        items = [self.marked(each) for each in content]
        return _List(items) if _nested(content) else items

    def filled(self, text: str) -> str:
        """Return text with the lists in the place of their marks."""
        return re.sub(f"{self._mark}([0-9]+)-", lambda mark: self._texts[int(mark[1])], text)


def _nested(items: Iterable[Any]) -> bool:
    return any(isinstance(each, dict | list | tuple) for each in items)


def read_yaml(path: Path, error: type[L2MError]) -> Any:
    """Return the plain content of a YAML file.

    Parameters
    ----------
    error
        What to raise, with one line that names the file, if it cannot be read.
    """
    raw = read_content(path, MAX_BYTES, error)
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as reason:
        raise error(f"{path}: not a text; a YAML file is needed here") from reason
    try:
        return BoundedYAML().load(text)
    except TooMuchYAMLError as reason:
        raise error(f"{path}: {reason}; not a file of this program") from reason
    except YAMLError as reason:
        mark = getattr(reason, "problem_mark", None)
        where = "" if mark is None else f", line {mark.line + 1}"
        told = reason.problem if isinstance(reason, MarkedYAMLError) else None if mark else reason
        why = f": {' '.join(str(told).split())[:LONGEST]}" if told else ""
        raise error(f"{path}: not valid YAML{where}{why}") from reason


def write_yaml(path: Path, plain: dict[str, Any], header: str) -> None:
    """Write plain content with a comment on top; short lists of numbers stay on one line."""
    with atomic_path(path) as temporary:
        temporary.write_text(yaml_text(plain, header), encoding="utf-8")


def yaml_text(content: dict[str, Any], header: str) -> str:
    """Return plain content as YAML, with a comment on top."""
    yaml: Any = YAML(typ="safe", pure=True)
    yaml.Representer = _Representer
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False
    yaml.width = LINE
    stream, rows = StringIO(), _Rows()
    stream.write("".join(f"# {line}\n" for line in header.splitlines()))
    yaml.dump(rows.marked(content), stream)
    return rows.filled(stream.getvalue())


def checked(
    path: Path,
    plain: Any,
    adapter: TypeAdapter[Content],
    prepare: Callable[[Any], Any] = lambda content: content,
    added: tuple[str, ...] = (),
) -> Content:
    """Return the plain content of a YAML file about sensors as a type.

    Parameters
    ----------
    plain
        Its content, see ``read_yaml``.
    adapter
        Of the type.
    prepare
        Brings the plain content into the form of the type, if it is a mapping.
    added
        Levels that ``prepare`` adds: they are left out of messages.

    Raises
    ------
    CalibrationError
        The content is not of this form; the line names the first fault.
    """
    try:
        return adapter.validate_python(prepare(plain) if isinstance(plain, dict) else plain)
    except ValidationError as error:
        fault = first_fault(error, hidden=added)
        msg = f"{path}: not a calibration file of this program: {fault}"
        raise CalibrationError(msg) from error
