"""What records of `metrics.json` have in common."""

from dataclasses import dataclass
from typing import ClassVar

from pydantic import ConfigDict

Row = tuple[float, ...]
Rows = tuple[Row, ...]


@dataclass(frozen=True)
class Record:
    """A part of `metrics.json`."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(ser_json_inf_nan="strings")
