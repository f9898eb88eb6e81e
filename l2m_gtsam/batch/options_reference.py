"""All options in words: pages of the documentation, made of the models that read them."""

import enum
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from l2m_gtsam.config import Config
from l2m_gtsam.options import Options, meanings
from l2m_gtsam.simulate.scenario import ScenarioOptions

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


def options_page(head: str, model: type[Options]) -> str:
    """Return a page in Markdown: a table for every model, under the full name of its key."""
    return GENERATED + head + "".join(_sections(model, "", model()))


def pages() -> dict[str, str]:
    """Return the pages by their paths in the documentation."""
    return {path: options_page(head, model) for path, (head, model) in PAGES.items()}


def _sections(model: type[BaseModel], prefix: str, values: BaseModel | None) -> Iterator[str]:
    """Yield the table of a model, then those of the models inside it.

    Defaults are those of the place where a model stands, which may differ from the model's own.
    """
    if prefix:
        # Names with dots get an anchor of their own: no two programs agree on that of a heading.
        anchor = f'<a id="{prefix}"></a>\n\n' if {".", "["} & set(prefix) else ""
        yield f"\n{anchor}## `{prefix}`\n\n{_text(model.__doc__ or '')}\n"
    nested = {name: inside_of(field) for name, field in model.model_fields.items()}
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
        value = getattr(values, name, None)
        yield from _sections(inside.model, key, value if isinstance(value, BaseModel) else None)


def _row(model: type[BaseModel], name: str, values: BaseModel | None) -> str:
    field = model.model_fields[name]
    kind = _cell(kind_of(field.annotation) + limits_of(field))
    default = "required" if field.is_required() else f"`{_cell(_default(field, name, values))}`"
    meaning = _text(meanings(model).get(name, ""))
    return f"| `{field.alias or name}` | {kind} | {default} | {meaning} |\n"


@dataclass(frozen=True)
class InnerModel:
    """A model that a field holds, and how its keys go on: by name, in a list."""

    model: type[BaseModel]
    through: str


def inside_of(field: FieldInfo) -> InnerModel | None:
    """Return the model that an option holds, if it holds one."""
    return _model_of(field.annotation)


def _model_of(annotation: Any) -> InnerModel | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return InnerModel(annotation, "")
    through = {dict: ".NAME", tuple: "[]", list: "[]"}.get(get_origin(annotation), "")
    for each in get_args(annotation):
        if inner := _model_of(each):
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


def _default(field: FieldInfo, name: str, values: BaseModel | None) -> str:
    own = field.get_default(call_default_factory=True)
    value = getattr(values, name) if values is not None else own
    if value is None:
        return "null"
    if isinstance(value, enum.Enum):
        return str(value.value)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(str, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _text(text: str) -> str:
    """Return a docstring on one line, as the cell of a table."""
    return _cell(" ".join(text.split()))


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")
