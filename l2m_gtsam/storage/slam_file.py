"""``slam.json``: how a localisation ended, in figures, and the covariance of every pose."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from l2m_gtsam.records.localisation_file import LocalisationRecord
from l2m_gtsam.records.metrics import Record
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.storage.record_file import read_record

FORMAT: Literal["l2m-slam"] = "l2m-slam"
VERSION: Literal[4] = 4
LEGEND = {
    "poses": "T_map_lidar at key poses: stamp_ns, p in metres, quaternion_xyzw",
    "covariance": "of a right perturbation, T_true = T_map_lidar Exp(error): rotation (rad), then "
    "translation (m), along the axes of the lidar",
    "odometry": "alone, from where the drive is said to begin; sigma along x, y, z of the map (m), "
    "and about them (deg)",
    "drift": "odometry alone less the localised poses, in m and deg",
    "chi2_per_dof": "mean square of whitened residuals; 1 is consistent",
    "scale": "longer: share by which all ways are longer than odometry has them, with its sigma; "
    "null where odometry's scale counts as right",
    "steps": "the same of what steps between poses differ by from odometry's",
    "truth": "errors against a trajectory that was given, nothing aligned; nees of 6 is honest",
    "start": "where the drive may have begun, looked for all over the map, the likeliest first; "
    "margin: natural logarithm of how much likelier the first is than the second, null without one",
}


@dataclass(frozen=True)
class _Head(Record):
    format: Literal["l2m-slam"]
    version: Literal[4]
    legend: dict[str, str]


@dataclass(frozen=True)
class _SlamFile(LocalisationRecord, _Head):
    """A head, and the record after it."""


_ADAPTER = TypeAdapter(_SlamFile)


def write_slam(path: Path, record: LocalisationRecord) -> None:
    """Write a localisation; `read_slam` gives it back equal.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    content = {each.name: getattr(record, each.name) for each in fields(LocalisationRecord)}
    file = _SlamFile(format=FORMAT, version=VERSION, legend=LEGEND, **content)
    with atomic_path(path) as temporary:
        temporary.write_bytes(_ADAPTER.dump_json(file) + b"\n")


def read_slam(path: Path) -> LocalisationRecord:
    """Return the localisation in a file.

    Raises
    ------
    CalibrationError
        The file is missing, damaged or something else.
    """
    file = read_record(path, _ADAPTER, "localisation", "`l2m slam` writes it")
    content = {each.name: getattr(file, each.name) for each in fields(LocalisationRecord)}
    return LocalisationRecord(**content)
