"""Calibrations for other programs: written in their formats, and applied to bags."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from l2m_gtsam.batch.outputs import check_outputs, ensure_folder
from l2m_gtsam.errors import ConfigError, OutputError
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.exports.export import Export, export_of, left_out_notes
from l2m_gtsam.storage.exports.formats import FORMATS
from l2m_gtsam.storage.exports.urdf import edited_urdf
from l2m_gtsam.storage.files import atomic_path
from l2m_gtsam.storage.yaml_file import MAX_BYTES


@dataclass(frozen=True)
class Names:
    """What frames are called outside.

    Attributes
    ----------
    lidar
        The lidar's frame.
    sensors
        Frames of sensors that are not called like their sensor.
    """

    lidar: str = "lidar"
    sensors: Mapping[str, str] = field(default_factory=dict)


def export_calibration(
    calibration: Path, format_name: str, out: Path, names: Names, into: Path | None = None
) -> tuple[str, ...]:
    """Write a calibration for another program.

    Parameters
    ----------
    calibration
        A `calibration.yaml`.
    format_name
        One of ``FORMATS``.
    out
        File to write; the folder is made if it is missing.
    names
        Of frames.
    into
        A URDF that the sensors are put into; it stays as it is, the copy is written.

    Returns
    -------
    What is worth a warning: sensors that are left out, what a format loses.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line; nothing is written then.
    """
    if format_name not in FORMATS:
        accepted = ", ".join(FORMATS)
        raise ConfigError(f"--format: unknown format {format_name!r}; accepted: {accepted}")
    if into is not None and format_name != "urdf":
        raise ConfigError("--into: goes with --format urdf alone")
    _check_sources(out, calibration, into)
    chosen, result = FORMATS[format_name], read_calibration(calibration)
    export = export_of(result, chosen.fault, names.lidar, names.sensors)
    content = chosen.text(export).encode() if into is None else _edited(export, into)
    ensure_folder(out.parent)
    with atomic_path(out) as temporary:
        temporary.write_bytes(content)
    return (*left_out_notes(export.left_out), *chosen.notes(export))


def _check_sources(out: Path, *sources: Path | None) -> None:
    """Raise an OutputError if a result would take the place of what it is made from."""
    check_outputs(out)
    if any(each is not None and out.exists() and out.samefile(each) for each in sources):
        raise OutputError(f"{out}: is what is read; choose another --out")


def _edited(export: Export, urdf: Path) -> bytes:
    try:
        if urdf.stat().st_size > MAX_BYTES:
            raise ConfigError(f"{urdf}: larger than {MAX_BYTES // 1_000_000} MB, no URDF")
        return edited_urdf(export, str(urdf), urdf.read_bytes())
    except OSError as error:
        raise ConfigError(f"{urdf}: cannot be read: {error.strerror or error}") from error
