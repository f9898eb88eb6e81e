"""Finished cells of a study: one small file each, so that nothing that was computed is lost."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import TypeAdapter, ValidationError

from l2m_gtsam.errors import ConfigError
from l2m_gtsam.options import Options
from l2m_gtsam.storage.files import atomic_path
from l2m_gtsam.studies.study import Study

Cell = TypeVar("Cell")
CONDITIONS = "conditions.json"


@dataclass(frozen=True)
class Made(Generic[Cell]):
    """A cell, and what it took.

    Attributes
    ----------
    cell
        The cell.
    seconds
        Of one core.
    code, machine
        What computed it.
    """

    cell: Cell
    seconds: float
    code: str
    machine: str


@dataclass(frozen=True)
class CellFolder(Generic[Cell]):
    """The folder that holds the finished cells of one study under one set of conditions."""

    path: Path
    cell: type[Cell]

    @classmethod
    def opened(
        cls, path: Path, study: "Study[Any, Cell, Any]", options: Options
    ) -> "CellFolder[Cell]":
        """Return the folder of a study, made if it is not there.

        Raises
        ------
        ConfigError
            It holds cells of another study or made under other conditions.
        """
        path.mkdir(parents=True, exist_ok=True)
        wanted = {"study": study.name} | options.model_dump(mode="json", exclude=set(study.size))
        header = path / CONDITIONS
        if header.exists():
            if _read(header) != wanted:
                raise ConfigError(
                    f"{path}: holds cells of a study with other options; choose another --out"
                )
        else:
            _write(header, wanted)
        return cls(path, study.cell)

    def write(self, key: str, made: Made[Cell]) -> None:
        """Write a cell, whole or not at all."""
        # mypy: the class of the cells is a value here, known when a study is run.
        _write(self._file(key), TypeAdapter(Made[self.cell]).dump_python(made, mode="json"))  # type: ignore[name-defined]

    def read(self, key: str) -> Made[Cell] | None:
        """Return a cell; None where it is not there yet.

        Raises
        ------
        ConfigError
            The file is not a cell of this version of the study.
        """
        file = self._file(key)
        if not file.exists():
            return None
        try:
            return TypeAdapter(Made[self.cell]).validate_python(_read(file))  # type: ignore[name-defined]
        except ValidationError as error:
            raise ConfigError(f"{file}: not a cell of this study; remove it") from error

    def _file(self, key: str) -> Path:
        return self.path / f"{key}.json"


def _write(path: Path, content: Any) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")


def _read(path: Path) -> Any:
    """Return what a file holds.

    Raises
    ------
    ConfigError
        It is not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read as JSON; remove it") from error
