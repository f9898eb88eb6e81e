"""``calibration.yaml``: everything about each sensor, with formulas and units inside."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from l2m_gtsam.data import Distortion, RigidTransform, SourceFile, SyncCounts
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    Disagreement,
    FoundStart,
    ResidualFigures,
    Return,
    SensorCalibration,
    SensorStatus,
    TimeOffset,
    Uncertainty,
)
from l2m_gtsam.storage.calibration_legend import MODEL, UNCERTAINTY
from l2m_gtsam.storage.file_model import Lenient, Matrix, Vector, read_model
from l2m_gtsam.storage.model_entry import (
    ModelsEntry,
    MovingEntry,
    models_entry,
    models_of,
    moving_entry,
    moving_of,
)
from l2m_gtsam.storage.transform_entry import transform_entry
from l2m_gtsam.storage.yaml_file import write_yaml

FORMAT = "l2m-calibration"
VERSION = 1
HEADER = """Calibration of magnetometers against a LiDAR, written by l2m_gtsam.
Formulas, frames and units stand under `model`; each sensor has its own entry under `sensors`."""

Row15 = Annotated[list[float], Field(min_length=15, max_length=15)]


class _Residuals(Lenient):
    readings: int
    rms_axes: Vector
    rms: float
    median_norm: float
    p95_norm: float
    max_norm: float
    chi2_per_dof: float


class _Counts(Lenient):
    received: int
    not_finite: int
    repeated: int
    outside_trajectory: int
    in_pose_gap: int
    thinned: int
    kept: int
    without_regressor: int = 0


class _Start(Lenient):
    t_lidar_mag: Vector
    margin: float
    runner_up: Vector | None


class _TimeOffset(Lenient):
    seconds: float
    sigma: float
    cross_covariance: Row15
    held: str


class _Sensor(Lenient):
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
    from_priors: tuple[str, ...] = ()
    readings: _Counts
    outside_map: int
    start: _Start | None = None
    rejected: int = 0
    # Files of the first version do not speak of it.
    time_offset: _TimeOffset | None = None
    models: ModelsEntry | None = None
    not_compared: str = ""
    moving: dict[str, MovingEntry] = Field(default_factory=dict)
    missing_in: tuple[str, ...] = ()


class _Disagreement(Lenient):
    sensors: tuple[str, ...]
    start_ns: int
    end_ns: int
    p_from: Vector
    p_to: Vector
    length: float
    readings: int
    size: float
    passed_again: Return
    bag: str = ""


class _Source(Lenient):
    path: str
    sha256: str


class _CalibrationFile(Lenient):
    format: Literal["l2m-calibration"]
    version: Literal[1]
    iterations: int
    # Files of the first version do not say; their sigmas are of this kind.
    uncertainty: Uncertainty = Uncertainty.INDEPENDENT
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    disagreements: tuple[_Disagreement, ...] = ()
    bag: _Source | None
    # Of several drives together; files of one do not have it.
    bags: tuple[_Source, ...] = ()
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
        **({"notes": list(result.notes)} if result.notes else {}),
        "disagreements": [_disagreement_entry(each) for each in result.disagreements],
        **bag_entries(result),
        "map": source_entry(result.map),
        "versions": result.versions,
        "iterations": result.iterations,
        "sensors": {sensor.sensor: sensor_entry(sensor) for sensor in result.sensors},
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
    parsed = read_model(path, _CalibrationFile)
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
        bags=tuple(SourceFile(each.path, each.sha256) for each in parsed.bags),
        notes=parsed.notes,
    )


def sensor_entry(sensor: SensorCalibration) -> dict[str, Any]:
    """Return all that is known of a sensor as plain values."""
    missing = {"missing_in": list(sensor.missing_in)} if sensor.missing_in else {}
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
        "transforms": transform_entry(RigidTransform(sensor.R_lidar_mag, sensor.t_lidar_mag)),
        "noise": sensor.noise,
        "undetermined": list(sensor.undetermined),
        "from_priors": list(sensor.from_priors),
        "residuals": _residuals_entry(sensor.residuals),
        "readings": vars(sensor.sync).copy(),
        "outside_map": sensor.outside_map,
        "rejected": sensor.rejected,
        "start": _start_entry(sensor.start),
        "time_offset": _time_offset_entry(sensor),
        "moving": moving_entry(sensor.moving),
        "models": None if sensor.models is None else models_entry(sensor.models),
        "not_compared": sensor.not_compared,
        **missing,
        "covariance": sensor.covariance.tolist(),
    }


def _time_offset_entry(sensor: SensorCalibration) -> dict[str, Any] | None:
    offset = sensor.time_offset
    if offset is None:
        return None
    return {
        "seconds": offset.seconds,
        "sigma": offset.sigma,
        "correlation_with_t": sensor.offset_correlation.tolist(),
        "held": offset.held,
        "cross_covariance": offset.cross_covariance.tolist(),
    }


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
    fields = {name: value for name, value in vars(stretch).items() if name != "bag" or value}
    return {
        **fields,
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


def bag_entries(result: CalibrationResult) -> dict[str, Any]:
    """Return which drives were calibrated: one under `bag`, several under `bags`."""
    bag = {"bag": source_entry(result.bag)}
    return bag | {"bags": [source_entry(each) for each in result.bags]} if result.bags else bag


def source_entry(source: SourceFile | None) -> dict[str, str] | None:
    """Return where data came from as plain values."""
    return None if source is None else {"path": source.path, "sha256": source.sha256}


def _start(entry: _Start | None) -> FoundStart | None:
    if entry is None:
        return None
    other = None if entry.runner_up is None else np.array(entry.runner_up)
    return FoundStart(np.array(entry.t_lidar_mag), entry.margin, other)


def _time_offset(entry: _TimeOffset | None) -> TimeOffset | None:
    if entry is None:
        return None
    return TimeOffset(**{**dict(entry), "cross_covariance": np.array(entry.cross_covariance)})


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
        from_priors=entry.from_priors,
        sync=SyncCounts(**dict(entry.readings)),
        outside_map=entry.outside_map,
        start=_start(entry.start),
        rejected=entry.rejected,
        time_offset=_time_offset(entry.time_offset),
        models=None if entry.models is None else models_of(entry.models),
        not_compared=entry.not_compared,
        moving=moving_of(entry.moving),
        missing_in=entry.missing_in,
    )
