"""Results for those who work with them in Python: plain values, tables, and HTML for notebooks."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import TypeAdapter
from pydantic_core import to_jsonable_python
from scipy.spatial.transform import Rotation

from l2m_gtsam.errors import InputError
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.localisation import LocalisationResult
from l2m_gtsam.records.verdict import Verdict
from l2m_gtsam.storage.calibration_file import sensor_entry

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]
_VERDICT = TypeAdapter(Verdict)
MOST_ROWS = 50  # of HTML


class Shown(ABC):
    """A result that shows itself."""

    @abstractmethod
    def rows(self) -> list[Row]:
        """Return its table, a row each with plain values by column."""

    @abstractmethod
    def heading(self) -> str:
        """Return what it says in one line."""

    def to_frame(self) -> "pd.DataFrame":
        """Return its table as a data frame.

        Raises
        ------
        InputError
            pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise InputError("to_frame needs pandas: python -m pip install pandas") from error
        return pd.DataFrame(self.rows())

    def _repr_html_(self) -> str:
        rows = self.rows()
        names = list(rows[0]) if rows else []
        head = "".join(f"<th>{escape(name)}</th>" for name in names)
        body = "".join(
            f"<tr>{''.join(f'<td>{escape(_text(row[name]))}</td>' for name in names)}</tr>"
            for row in rows[:MOST_ROWS]
        )
        more = f"<p>and {len(rows) - MOST_ROWS} more</p>" if len(rows) > MOST_ROWS else ""
        table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        return f"<p>{escape(self.heading())}</p>{table}{more}"


@dataclass(frozen=True)
class JudgedCalibration(Shown):
    """A calibration and the verdict on it.

    Attributes
    ----------
    result
        The calibration; `calibration["name"]` is one of its sensors, and `list(calibration)` are
        their names.
    verdict
        PASS, WARN or FAIL, with reasons.
    """

    result: CalibrationResult
    verdict: Verdict

    def __getitem__(self, sensor: str) -> SensorCalibration:
        return self.result[sensor]

    def __iter__(self) -> Iterator[str]:
        return iter(self.result)

    def __contains__(self, sensor: object) -> bool:
        return sensor in self.result

    def heading(self) -> str:
        """Return the verdict."""
        return self.verdict.lines()[0]

    def rows(self) -> list[Row]:
        """Return a row per sensor: position, H and rotation with their sigmas; m, uT, degrees."""
        return [self._row(sensor) for sensor in self.result.sensors]

    def _row(self, sensor: SensorCalibration) -> Row:
        offset = sensor.time_offset
        return {
            "sensor": sensor.sensor,
            "verdict": self.verdict[sensor.sensor].level.value,
            "status": sensor.status.value,
            **_axes("t_{}_m", sensor.t_lidar_mag),
            **_axes("sigma_t_{}_m", sensor.t_sigma),
            **_axes("H_{}_ut", sensor.distortion.H),
            **_axes("sigma_H_{}_ut", sensor.H_sigma),
            **_axes("rotation_{}_deg", np.rad2deg(sensor.rotation_vector)),
            **_axes("sigma_rotation_{}_deg", sensor.turn_sigma_deg),
            "time_offset_s": 0.0 if offset is None else offset.seconds,
            "noise_ut": sensor.noise,
            "readings": sensor.used,
        }

    def to_dict(self) -> dict[str, Any]:
        """Return plain values: the sensors as in `calibration.yaml`, and the verdict."""
        plain: dict[str, Any] = to_jsonable_python(
            {
                "verdict": _VERDICT.dump_python(self.verdict, mode="json", by_alias=False),
                "doubts": self.result.doubts,
                "notes": self.result.notes,
                "sensors": {each.sensor: sensor_entry(each) for each in self.result.sensors},
                "options": self.result.options,
            }
        )
        return plain


@dataclass(frozen=True)
class LocalisedDrive(Shown):
    """Where a drive went.

    Attributes
    ----------
    result
        Key poses with their covariances, drift, what sensors and scans were worth.
    """

    result: LocalisationResult

    def heading(self) -> str:
        """Return how it ended."""
        return f"{self.result.status.value}: {self.result.message}"

    def rows(self) -> list[Row]:
        """Return a row per key pose: stamp, position, quaternion, sigmas of the position."""
        found = self.result.trajectory
        q = Rotation.from_matrix(found.R).as_quat(canonical=True)
        sigmas = np.full((len(found), 3), np.nan)
        if found.covariance is not None:
            in_map = found.R @ found.covariance[:, 3:, 3:] @ found.R.transpose(0, 2, 1)
            sigmas = np.sqrt(np.diagonal(in_map, axis1=1, axis2=2))
        return [
            {
                "stamp_ns": int(found.stamp_ns[k]),
                **dict(zip(("x_m", "y_m", "z_m"), found.p[k].tolist(), strict=True)),
                **dict(zip(("qx", "qy", "qz", "qw"), q[k].tolist(), strict=True)),
                **_axes("sigma_{}_m", sigmas[k]),
            }
            for k in range(len(found))
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "status": self.result.status.value,
            "message": self.result.message,
            "notes": list(self.result.notes),
            "frame": self.result.trajectory.frame,
            "poses": self.rows(),
        }


def _axes(name: str, values: Sequence[float] | Any) -> Row:
    return {name.format(axis): float(v) for axis, v in zip("xyz", values, strict=True)}


def _text(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
