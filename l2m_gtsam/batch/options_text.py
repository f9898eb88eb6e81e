"""All options in words: as YAML that can be read again, and as pages of the documentation."""

import enum
import json
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from l2m_gtsam.config import Config
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.options import Options, meanings
from l2m_gtsam.simulate.scenario import ScenarioOptions

WIDTH = 96
HEAD = (
    "Every option with its default. A configuration has only what differs from these: copy the\n"
    "lines that you change, with the names above them."
)


def options_text(key: str | None = None) -> str:
    """Return the options of a configuration, or those under a key such as `calibration.solve`.

    Raises
    ------
    ConfigError
        There is no such key.
    """
    names = [] if key is None else key.split(".")
    lines = [f"# {line}" for line in HEAD.splitlines()]
    lines += _entries(Config, Config().model_dump(mode="json", by_alias=True), names, "")
    return "\n".join(lines) + "\n"


def _entries(
    model: type[BaseModel], values: dict[str, Any] | None, wanted: list[str], indent: str
) -> Iterator[str]:
    """Yield the lines of a model; of one that is not there by default, as comments."""
    keys = {field.alias or name: name for name, field in model.model_fields.items()}
    if wanted and wanted[0] not in keys:
        raise ConfigError(f"no option {wanted[0]!r}; there are: {', '.join(keys)}")
    for key, name in keys.items():
        if wanted and key != wanted[0]:
            continue
        field, meaning = model.model_fields[name], meanings(model)[name]
        value, given = None if values is None else values[key], values is not None
        yield from _entry(key, field, value, wanted[1:], indent, meaning, given=given)


def _entry(
    name: str,
    field: FieldInfo,
    value: Any,
    wanted: list[str],
    indent: str,
    meaning: str,
    *,
    given: bool,
) -> Iterator[str]:
    """Yield the lines of one option and, where it holds a model, of those inside."""
    inner = inside_of(field.annotation)
    kind = "" if inner else f" ({kind_of(field.annotation)}{limits_of(field)})"
    if not wanted:
        # A line without end would be no line: words of a name that has to stay whole.
        text = " ".join(meaning.split()) + kind.replace("`", "")
        yield from (f"{indent}# {line}" for line in wrap(text, WIDTH - len(indent)))
    if inner is not None and not inner.through and isinstance(value, dict):
        yield f"{indent}{name}:"
        yield from _entries(inner.model, value, wanted, f"{indent}  ")
        return
    if given:
        yield f"{indent}{name}: {_plain(value)}"
    elif field.is_required():
        yield f"{indent}# {name}: ...  (required)"
    else:
        default = field.get_default(call_default_factory=True)
        shown = default.model_dump(mode="json") if isinstance(default, BaseModel) else default
        yield f"{indent}# {name}: {_plain(shown)}"
    if inner is not None and not (not given and not inner.through):
        below = f"{indent}#   "
        yield f"{indent}#   each has{'' if inner.through else ', if it is given'}:"
        for line in _entries(inner.model, None, wanted, ""):
            yield below + line.removeprefix("# ")


def _plain(value: Any) -> str:
    """Return a value as YAML on one line, which JSON is."""
    return json.dumps(value, ensure_ascii=False, default=str)


CONFIGURATION = """# Configuration

Every key that a file given with `--config` may have, with its default. A file has only what differs
from the defaults; a key that is not known is refused, and the line says what is accepted. The
effective configuration is saved in every `calibration.yaml`. `l2m config` prints the same as YAML,
and `l2m config --for BAG` a configuration to start from.
"""
SIMULATION = """# Simulation

Every key that a file given with `l2m simulate --options` may have, with its default.
"""
GENERATED = "<!-- Made by `make reference`; change the docstrings of the options instead. -->\n\n"
PAGES: dict[str, tuple[str, type[Options]]] = {
    "reference/configuration.md": (CONFIGURATION, Config),
    "reference/simulation.md": (SIMULATION, ScenarioOptions),
}
LIMITS = {"gt": "> {}", "ge": "≥ {}", "lt": "< {}", "le": "≤ {}"}


def pages() -> dict[str, str]:
    """Return the pages in Markdown, a table for every model, by their paths in the docs."""
    return {
        path: GENERATED
        + head
        + "".join(_sections(model, "", model().model_dump(mode="json", by_alias=True)))
        for path, (head, model) in PAGES.items()
    }


def _sections(model: type[BaseModel], prefix: str, values: dict[str, Any]) -> Iterator[str]:
    """Yield the table of a model, then those of the models inside it.

    Defaults are those of the place where a model stands, which may differ from the model's own.
    """
    if prefix:
        # Names with dots get an anchor of their own: no two programs agree on that of a heading.
        anchor = f'<a id="{prefix}"></a>\n\n' if {".", "["} & set(prefix) else ""
        yield f"\n{anchor}## `{prefix}`\n\n{_text(model.__doc__ or '')}\n"
    nested = {name: inside_of(field.annotation) for name, field in model.model_fields.items()}
    rows = [_row(model, name, values) for name, inside in nested.items() if inside is None]
    if rows:
        yield f"\n| key | value | default | meaning |\n|---|---|---|---|\n{''.join(rows)}"
    below = {name: inside for name, inside in nested.items() if inside is not None}
    yield "\n"
    for name, inside in below.items():
        key = f"{prefix}.{name}{inside.through}".lstrip(".")
        yield f"- [`{key}`](#{key}): {_text(meanings(model).get(name, ''))}\n"
    for name, inside in below.items():
        key = f"{prefix}.{name}{inside.through}".lstrip(".")
        value = None if inside.through else values.get(name)
        yield from _sections(inside.model, key, value or {})


def _row(model: type[BaseModel], name: str, values: dict[str, Any]) -> str:
    field = model.model_fields[name]
    kind = _cell(kind_of(field.annotation) + limits_of(field))
    key, own = field.alias or name, field.get_default(call_default_factory=True)
    default = "required" if field.is_required() else f"`{_cell(_plain(values.get(key, own)))}`"
    meaning = _text(meanings(model).get(name, ""))
    return f"| `{key}` | {kind} | {default} | {meaning} |\n"


@dataclass(frozen=True)
class InnerModel:
    """A model that a field holds, and how its keys go on: by name, in a list."""

    model: type[BaseModel]
    through: str


def inside_of(annotation: Any) -> InnerModel | None:
    """Return the model that an option of this type holds, if it holds one."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return InnerModel(annotation, "")
    through = {dict: ".NAME", tuple: "[]", list: "[]"}.get(get_origin(annotation), "")
    for each in get_args(annotation):
        if inner := inside_of(each):
            return InnerModel(inner.model, through + inner.through)
    return None


def kind_of(annotation: Any) -> str:
    """Return what a value may be, in plain words."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is typing.Annotated:
        return kind_of(inner[0])
    if origin in (typing.Union, types.UnionType):
        return " or ".join(kind_of(each) for each in inner)
    if origin is typing.Literal:
        return ", ".join(f"`{each}`" for each in inner)
    if origin is dict:
        return f"by name: {kind_of(inner[1])}"
    if origin in (tuple, list):
        if Ellipsis in inner or origin is list:
            return f"list: {kind_of(inner[0])}"
        kinds = [kind_of(each) for each in inner]
        if get_origin(inner[0]) is typing.Literal:
            return f"{len(inner)} of {kinds[0]}"
        return f"[{', '.join(kinds)}]"
    if isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        return ", ".join(f"`{each.value}`" for each in annotation)
    names = {
        Path: "path",
        float: "number",
        int: "integer",
        str: "text",
        bool: "true, false",
        type(None): "null",
    }
    return names.get(annotation, getattr(annotation, "__name__", str(annotation)))


def limits_of(field: FieldInfo) -> str:
    """Return the limits of an option's value; empty where it has none."""
    found = [
        text.format(f"{getattr(each, name):g}")
        for each in field.metadata
        for name, text in LIMITS.items()
        if isinstance(getattr(each, name, None), int | float)
    ]
    return f", {', '.join(found)}" if found else ""


def _text(text: str) -> str:
    """Return a docstring on one line, as the cell of a table."""
    return _cell(" ".join(text.split()))


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")
