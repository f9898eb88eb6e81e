"""``calibration.yaml``: everything about each sensor, with formulas and units inside."""

from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import (
    Distortion,
    FloatArray,
    KnownSensor,
    RigidTransform,
    SourceFile,
    SyncCounts,
)
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.results import (
    CalibrationResult,
    Disagreement,
    FoundStart,
    ResidualFigures,
    Return,
    SensorCalibration,
    SensorStatus,
    Uncertainty,
)
from l2m_gtsam.storage.yaml_file import read_yaml, write_yaml

FORMAT = "l2m-calibration"
VERSION = 1
HEADER = """Calibration of magnetometers against a LiDAR, written by l2m_gtsam.
Formulas, frames and units stand under `model`; each sensor has its own entry under `sensors`."""

UNCERTAINTY = {
    Uncertainty.FULL: (
        "sigmas carry the map's errors as they are: shared by readings near each other and by all "
        "sensors; they hold as far as the map explains its own field (`l2m map info`)"
    ),
    Uncertainty.INDEPENDENT: (
        "sigmas count the map's errors as independent from reading to reading; where the map is "
        "less sure than the sensor they are too small"
    ),
}

MODEL = {
    "measurement": "B_meas = C @ B_lidar + H",
    "correction": "B_lidar = inv(C) @ (B_meas - H)",
    "units": {"B": "uT", "H": "uT", "C": "1", "t": "m", "rotation": "rad", "noise": "uT"},
    "frames": "lidar: frame of the poses' child after the fixed transform; mag: the sensor's axes",
    "t_lidar_mag": "position of the sensor in the lidar frame",
    "rotation": (
        "C = R_mag_lidar @ P with P symmetric positive (proper polar factor); "
        "R_lidar_mag is its transpose; quaternions are x, y, z, w"
    ),
    "rotation_covariance": "of the error e in the mag frame: true = exp(e) @ R_mag_lidar",
    "covariance_order": "t_x t_y t_z C_xx C_xy C_xz C_yx C_yy C_yz C_zx C_zy C_zz H_x H_y H_z",
    "disagreements": (
        "stretches over which readings fit neither map nor distortion and were rejected: stamps in "
        "ns, the lidar's way from p_from to p_to in m in the map, median residual (size) in uT"
    ),
    "infinite": "a variance of .inf marks what this drive and map do not determine",
}

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
Row15 = Annotated[list[float], Field(min_length=15, max_length=15)]


class _Lenient(BaseModel):
    """A part of a file; what is derived from the rest is ignored when read."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class _Known(_Lenient):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    t_lidar_mag: Vector
    C: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    H: Vector = (0.0, 0.0, 0.0)

    @field_validator("C")
    @classmethod
    def _invertible(cls, C: Matrix) -> Matrix:
        if np.linalg.cond(np.array(C)) > 1e6:  # gains a million apart are no magnetometer's
            raise ValueError("C cannot be inverted, so that its readings say nothing of the field")
        return C


class _KnownFile(_Lenient):
    sensors: dict[str, _Known] = Field(min_length=1)

    @field_validator("sensors", mode="before")
    @classmethod
    def _known_ones(cls, sensors: Any) -> Any:
        """Leave out what a calibration could not solve: it is not known."""
        if not isinstance(sensors, dict):
            return sensors
        solved = SensorStatus.SOLVED.value
        return {
            name: entry
            for name, entry in sensors.items()
            if not isinstance(entry, dict) or entry.get("status", solved) == solved
        }


class _Residuals(_Lenient):
    readings: int
    rms_axes: Vector
    rms: float
    median_norm: float
    p95_norm: float
    max_norm: float
    chi2_per_dof: float


class _Counts(_Lenient):
    received: int
    not_finite: int
    repeated: int
    outside_trajectory: int
    in_pose_gap: int
    thinned: int
    kept: int


class _Start(_Lenient):
    t_lidar_mag: Vector
    margin: float
    runner_up: Vector | None


class _Sensor(_Lenient):
    status: SensorStatus
    message: str
    t_lidar_mag: Vector
    C: Matrix
    H: Vector
    R_lidar_mag: Matrix
    covariance: Annotated[list[Row15], Field(min_length=15, max_length=15)]
    rotation_covariance: Matrix
    noise: float
    residuals: _Residuals | None
    undetermined: tuple[str, ...]
    readings: _Counts
    outside_map: int
    start: _Start | None = None
    rejected: int = 0


class _Disagreement(_Lenient):
    sensors: tuple[str, ...]
    start_ns: int
    end_ns: int
    p_from: Vector
    p_to: Vector
    length: float
    readings: int
    size: float
    passed_again: Return


class _Source(_Lenient):
    path: str
    sha256: str


class _CalibrationFile(_Lenient):
    format: Literal["l2m-calibration"]
    version: Literal[1]
    iterations: int
    # Files of the first version do not say; their sigmas are of this kind.
    uncertainty: Uncertainty = Uncertainty.INDEPENDENT
    doubts: tuple[str, ...] = ()
    disagreements: tuple[_Disagreement, ...] = ()
    bag: _Source | None
    map: _Source | None
    options: dict[str, Any]
    versions: dict[str, str]
    sensors: dict[str, _Sensor]


def write_calibration(path: Path, result: CalibrationResult) -> None:
    """Write a calibration; `read_calibration` gives it back equal."""
    content = {
        "format": FORMAT,
        "version": VERSION,
        "model": {"uncertainty": UNCERTAINTY[result.uncertainty], **MODEL},
        "uncertainty": str(result.uncertainty),
        "doubts": list(result.doubts),
        "disagreements": [_disagreement_entry(each) for each in result.disagreements],
        "bag": _source(result.bag),
        "map": _source(result.map),
        "versions": result.versions,
        "iterations": result.iterations,
        "sensors": {sensor.sensor: _sensor_entry(sensor) for sensor in result.sensors},
        "options": result.options,
    }
    write_yaml(path, content, HEADER)


def read_calibration(path: Path) -> CalibrationResult:
    """Return the calibration in a file.

    Raises
    ------
    CalibrationError
        The file is missing, damaged or something else.
    """
    parsed = _parse(path, _CalibrationFile)
    return CalibrationResult(
        sensors=tuple(_sensor(name, entry) for name, entry in parsed.sensors.items()),
        iterations=parsed.iterations,
        uncertainty=parsed.uncertainty,
        doubts=parsed.doubts,
        disagreements=tuple(_disagreement(each) for each in parsed.disagreements),
        bag=SourceFile(parsed.bag.path, parsed.bag.sha256) if parsed.bag else None,
        map=SourceFile(parsed.map.path, parsed.map.sha256) if parsed.map else None,
        options=parsed.options,
        versions=parsed.versions,
    )


def write_known_sensors(
    path: Path, sensors: tuple[KnownSensor, ...], facts: dict[str, Any], header: str
) -> None:
    """Write sensors whose place and distortion are known: a truth or a mapping suite.

    Parameters
    ----------
    path
        File to write.
    sensors
        The sensors.
    facts
        Plain values that stand above them (seed, options).
    header
        Comment on top.
    """
    entries = {
        sensor.sensor: {
            "t_lidar_mag": sensor.t_lidar_mag.tolist(),
            "C": sensor.distortion.C.tolist(),
            "H": sensor.distortion.H.tolist(),
        }
        for sensor in sensors
    }
    write_yaml(path, {**facts, "sensors": entries}, header)


def read_known_sensors(path: Path) -> dict[str, KnownSensor]:
    """Return the sensors of a truth, of a mapping suite or of a calibration, by name.

    Without C and H an entry is free of distortion: C = I, H = 0. Sensors that a calibration could
    not solve are left out.

    Raises
    ------
    CalibrationError
        The file is missing or is not of this form.
    """
    return {
        name: KnownSensor(name, np.array(s.t_lidar_mag), Distortion(np.array(s.C), np.array(s.H)))
        for name, s in _parse(path, _KnownFile).sensors.items()
    }


def _sensor_entry(sensor: SensorCalibration) -> dict[str, Any]:
    return {
        "status": sensor.status.value,
        "message": sensor.message,
        "t_lidar_mag": sensor.t_lidar_mag.tolist(),
        "t_sigma": sensor.t_sigma.tolist(),
        "C": sensor.distortion.C.tolist(),
        "C_sigma": sensor.C_sigma.tolist(),
        "H": sensor.distortion.H.tolist(),
        "H_sigma": sensor.H_sigma.tolist(),
        "R_lidar_mag": sensor.R_lidar_mag.tolist(),
        "rotation_sigma": np.sqrt(np.diag(sensor.rotation_covariance)).tolist(),
        "rotation_covariance": sensor.rotation_covariance.tolist(),
        "transforms": _transforms(sensor),
        "noise": sensor.noise,
        "undetermined": list(sensor.undetermined),
        "residuals": _residuals_entry(sensor.residuals),
        "readings": vars(sensor.sync).copy(),
        "outside_map": sensor.outside_map,
        "rejected": sensor.rejected,
        "start": _start_entry(sensor.start),
        "covariance": sensor.covariance.tolist(),
    }


def _transforms(sensor: SensorCalibration) -> dict[str, Any]:
    """Return both directions and a point in both frames, so that no convention is left to guess."""
    T_lidar_mag = RigidTransform(sensor.R_lidar_mag, sensor.t_lidar_mag)
    p_mag = np.array([0.1, 0.2, 0.3])
    p_lidar = T_lidar_mag.R @ p_mag + T_lidar_mag.t
    return {
        "T_lidar_mag": _transform_entry(T_lidar_mag),
        "T_mag_lidar": _transform_entry(T_lidar_mag.inverse()),
        "example": {
            "meaning": "one point in both frames: p_lidar = R_lidar_mag @ p_mag + t_lidar_mag",
            "p_mag": p_mag.tolist(),
            "p_lidar": p_lidar.tolist(),
        },
    }


def _transform_entry(transform: RigidTransform) -> dict[str, list[float]]:
    return {
        "translation": transform.t.tolist(),
        "quaternion_xyzw": _quaternion(transform.R),
    }


def _quaternion(R: FloatArray) -> list[float]:
    if not np.isfinite(R).all():
        return [float("nan")] * 4
    return [float(q) for q in Rotation.from_matrix(R).as_quat(canonical=True)]


def _start_entry(start: FoundStart | None) -> dict[str, Any] | None:
    if start is None:
        return None
    other = start.runner_up
    return {
        "t_lidar_mag": start.t_lidar_mag.tolist(),
        "margin": start.margin,
        "runner_up": None if other is None else other.tolist(),
    }


def _disagreement_entry(stretch: Disagreement) -> dict[str, Any]:
    return {
        **vars(stretch),
        "sensors": list(stretch.sensors),
        "p_from": stretch.p_from.tolist(),
        "p_to": stretch.p_to.tolist(),
        "passed_again": stretch.passed_again.value,
    }


def _disagreement(entry: _Disagreement) -> Disagreement:
    places = {"p_from": np.array(entry.p_from), "p_to": np.array(entry.p_to)}
    return Disagreement(**{**dict(entry), **places})


def _residuals_entry(figures: ResidualFigures | None) -> dict[str, Any] | None:
    if figures is None:
        return None
    return {**vars(figures), "rms_axes": figures.rms_axes.tolist()}


def _source(source: SourceFile | None) -> dict[str, str] | None:
    return None if source is None else {"path": source.path, "sha256": source.sha256}


def _start(entry: _Start | None) -> FoundStart | None:
    if entry is None:
        return None
    other = None if entry.runner_up is None else np.array(entry.runner_up)
    return FoundStart(np.array(entry.t_lidar_mag), entry.margin, other)


def _sensor(name: str, entry: _Sensor) -> SensorCalibration:
    figures = entry.residuals
    return SensorCalibration(
        sensor=name,
        status=entry.status,
        message=entry.message,
        t_lidar_mag=np.array(entry.t_lidar_mag),
        distortion=Distortion(np.array(entry.C), np.array(entry.H)),
        R_lidar_mag=np.array(entry.R_lidar_mag),
        covariance=np.array(entry.covariance),
        rotation_covariance=np.array(entry.rotation_covariance),
        noise=entry.noise,
        residuals=None
        if figures is None
        else ResidualFigures(**{**dict(figures), "rms_axes": np.array(figures.rms_axes)}),
        undetermined=entry.undetermined,
        sync=SyncCounts(**dict(entry.readings)),
        outside_map=entry.outside_map,
        start=_start(entry.start),
        rejected=entry.rejected,
    )


FileModel = TypeVar("FileModel", bound=BaseModel)


def _parse(path: Path, model: type[FileModel]) -> FileModel:
    content = read_yaml(path, CalibrationError)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        fault = error.errors()[0]
        key = ".".join(str(part) for part in fault["loc"]) or "the file"
        msg = f"{path}: not a calibration file of this program: {key}: {fault['msg']}"
        raise CalibrationError(msg) from error
