"""All options as a file of YAML that can be read again: each with its default and what it means."""

import json
from collections.abc import Iterator
from textwrap import wrap
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from l2m_gtsam.batch.options_reference import inside_of, kind_of, limits_of
from l2m_gtsam.config import Config
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.options import meanings

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
    fields = {field.alias or name: field for name, field in model.model_fields.items()}
    if wanted and wanted[0] not in fields:
        raise ConfigError(f"no option {wanted[0]!r}; there are: {', '.join(fields)}")
    texts = {
        field.alias or name: meanings(model)[name] for name, field in model.model_fields.items()
    }
    for name, field in fields.items():
        if wanted and name != wanted[0]:
            continue
        value, given = None if values is None else values[name], values is not None
        yield from _entry(name, field, value, wanted[1:], indent, texts[name], given=given)


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
    inner = inside_of(field)
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
