"""``basin.json``: the options and all cells of a basin study, to count again or to go on from."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.studies.basin import BasinOptions, Cell

FORMAT = "l2m-basin"
# Cells do not depend on how many others there are.
SIZE = {"distortions", "rings"}


@dataclass(frozen=True)
class BasinStudy:
    """Options and the cells that are there, by distortion and ring."""

    options: BasinOptions
    cells: tuple[Cell, ...]


def write_study(path: Path, study: BasinStudy) -> None:
    """Write a study, whole or not at all."""
    content = {
        "format": FORMAT,
        "frame": "lidar, metres; null is no result",
        "options": study.options.model_dump(mode="json"),
        "cells": [to_plain(each) for each in study.cells],
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")


def read_study(path: Path) -> BasinStudy:
    """Return a study from its file.

    Raises
    ------
    ConfigError
        The file is not one of ``write_study``.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        options = BasinOptions.model_validate(content["options"])
        return BasinStudy(options, tuple(from_plain(each) for each in content["cells"]))
    except (OSError, ValueError, KeyError, TypeError, ValidationError) as error:
        raise ConfigError(f"{path}: not a basin study of this version") from error


def cells_to_keep(path: Path, options: BasinOptions) -> tuple[Cell, ...]:
    """Return the cells of a study that is to go on with these options; none without a file.

    Raises
    ------
    ConfigError
        The file holds a study under other conditions.
    """
    if not path.exists():
        return ()
    before = read_study(path)
    if before.options.model_dump(exclude=SIZE) != options.model_dump(exclude=SIZE):
        raise ConfigError(f"{path}: a study with other options; choose another --out")
    return tuple(
        each
        for each in before.cells
        if each.distortion < options.distortions and each.ring < options.rings
    )


def to_plain(cell: Cell) -> dict[str, Any]:
    """Return a cell as plain values."""
    return {
        "distortion": cell.distortion,
        "ring": cell.ring,
        "t_true": cell.t_true.tolist(),
        "t_start": cell.t_start.tolist(),
        "t_found": with_nulls(cell.t_found),
        "margin": with_nulls(cell.margin),
        "ambiguous": cell.ambiguous.tolist(),
        "t_one_key": with_nulls(cell.t_one_key),
        "t_lm": with_nulls(cell.t_lm),
    }


def from_plain(content: dict[str, Any]) -> Cell:
    """Return the cell that plain values stand for."""
    return Cell(
        distortion=int(content["distortion"]),
        ring=int(content["ring"]),
        t_true=np.array(content["t_true"]),
        t_start=np.array(content["t_start"]),
        t_found=np.array(content["t_found"], dtype=np.float64),
        margin=without_nulls(content["margin"], np.inf),
        ambiguous=np.array(content["ambiguous"], dtype=np.bool_),
        t_one_key=np.array(content["t_one_key"], dtype=np.float64),
        t_lm=np.array(content["t_lm"], dtype=np.float64),
    )


def with_nulls(values: FloatArray) -> Any:
    """Return an array as nested lists, null where it is not finite: JSON has no such numbers."""
    plain = values.astype(np.object_)
    plain[~np.isfinite(values)] = None
    return plain.tolist()


def without_nulls(values: list[float | None], missing: float) -> FloatArray:
    """Return the array of a list, shape (N,)."""
    return np.array([missing if value is None else value for value in values])
