"""``calibration.yaml``: everything about each sensor, with formulas and units inside."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, RigidTransform, SourceFile, SyncCounts
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
from l2m_gtsam.records.sensor_models import (
    Coefficients,
    Model,
    ModelComparison,
    ModelFigures,
    MovingField,
)
from l2m_gtsam.storage.yaml_file import Lenient, Matrix, Vector, read_model, write_yaml

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
    "time_offset": (
        "a reading's pose is that at stamp + seconds; cross_covariance with the parameters in "
        "covariance_order; held says why it is not estimated but taken as 0"
    ),
    "moving": (
        "B_meas = C @ B_lidar + H + sum of number * h (uT per unit of the recorded number); H is "
        "the offset where all numbers are 0; empty where the readings do not ask for it"
    ),
    "models": (
        "models of the readings, z = C b + H + sum of number * h + E db/dt and parts of it; score: "
        "mean log density of held-out readings (1/uT^3), behind: the best of them; coefficients "
        "are those of the recommended model at t_lidar_mag, b counted as exact"
    ),
    "disagreements": (
        "stretches over which readings fit neither map nor distortion and were rejected: stamps in "
        "ns, the lidar's way from p_from to p_to in m in the map, median residual (size) in uT"
    ),
    "from_priors": (
        "what the readings leave open and only `calibration.priors` determine, or mostly (sigmas "
        "without them would be more than twice as large): parameters, and what was known of them"
    ),
    "infinite": "a variance of .inf marks what this drive and map do not determine",
}


def transform_entry(T_lidar_mag: RigidTransform) -> dict[str, Any]:
    """Return both directions and a point in both frames, so that no convention is left to guess."""
    p_mag = np.array([0.1, 0.2, 0.3])
    p_lidar = T_lidar_mag.R @ p_mag + T_lidar_mag.t
    return {
        "T_lidar_mag": _direction(T_lidar_mag),
        "T_mag_lidar": _direction(T_lidar_mag.inverse()),
        "example": {
            "meaning": "one point in both frames: p_lidar = R_lidar_mag @ p_mag + t_lidar_mag",
            "p_mag": p_mag.tolist(),
            "p_lidar": p_lidar.tolist(),
        },
    }


def _direction(transform: RigidTransform) -> dict[str, list[float]]:
    return {
        "translation": transform.t.tolist(),
        "quaternion_xyzw": _quaternion(transform.R),
    }


def _quaternion(R: FloatArray) -> list[float]:
    if not np.isfinite(R).all():
        return [float("nan")] * 4
    return [float(q) for q in Rotation.from_matrix(R).as_quat(canonical=True)]


class MovingEntry(Lenient):
    """What a recorded number adds to the readings."""

    h: Vector
    sigma: Vector


class CoefficientsEntry(Lenient):
    """Coefficients of a model, or their sigmas; h by the names of the numbers."""

    C: Matrix
    H: Vector
    h: dict[str, Vector]
    E: Matrix


class FiguresEntry(Lenient):
    """How one model does."""

    model: Model
    parameters: int
    rms: float
    held_out_rms: float
    held_out_score: float
    score_error: float
    behind: float
    behind_error: float
    bic: float
    bic_above: float


class ModelsEntry(Lenient):
    """All models side by side."""

    recommended: Model
    reason: str
    readings: int
    independent: float
    segments: int
    regressors: tuple[str, ...]
    fits: tuple[FiguresEntry, ...]
    coefficients: CoefficientsEntry
    sigma: CoefficientsEntry


def moving_entry(moving: tuple[MovingField, ...]) -> dict[str, Any]:
    """Return what recorded numbers add as plain values, by their names."""
    return {each.name: {"h": each.h.tolist(), "sigma": each.sigma.tolist()} for each in moving}


def moving_of(entries: Mapping[str, MovingEntry]) -> tuple[MovingField, ...]:
    """Return what recorded numbers add from its entry."""
    return tuple(
        MovingField(name, np.array(each.h), np.array(each.sigma)) for name, each in entries.items()
    )


def models_entry(comparison: ModelComparison) -> dict[str, Any]:
    """Return a comparison as plain values."""
    names = comparison.regressors
    return {
        "recommended": comparison.recommended.value,
        "reason": comparison.reason,
        "readings": comparison.readings,
        "independent": comparison.independent,
        "segments": comparison.segments,
        "regressors": list(names),
        "fits": [{**vars(each), "model": each.model.value} for each in comparison.fits],
        "coefficients": _coefficients_entry(comparison.coefficients, names),
        "sigma": _coefficients_entry(comparison.sigma, names),
    }


def models_of(entry: ModelsEntry) -> ModelComparison:
    """Return a comparison from its entry."""
    return ModelComparison(
        fits=tuple(ModelFigures(**dict(each)) for each in entry.fits),
        regressors=entry.regressors,
        readings=entry.readings,
        independent=entry.independent,
        segments=entry.segments,
        recommended=entry.recommended,
        reason=entry.reason,
        coefficients=_coefficients(entry.coefficients),
        sigma=_coefficients(entry.sigma),
    )


def _coefficients_entry(found: Coefficients, names: tuple[str, ...]) -> dict[str, Any]:
    h = {name: each.tolist() for name, each in zip(names, found.h, strict=True)}
    return {"C": found.C.tolist(), "H": found.H.tolist(), "h": h, "E": found.E.tolist()}


def _coefficients(entry: CoefficientsEntry) -> Coefficients:
    h = np.array(list(entry.h.values())).reshape(-1, 3)
    return Coefficients(np.array(entry.C), np.array(entry.H), h, np.array(entry.E))


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
