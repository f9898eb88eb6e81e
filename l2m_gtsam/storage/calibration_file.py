"""``calibration.yaml``: everything about each sensor, with formulas and units inside."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform, SourceFile
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration, Uncertainty
from l2m_gtsam.records.error_budget import EXPLAINED
from l2m_gtsam.records.record import fields_of
from l2m_gtsam.records.verdict import NOT_JUDGED, Judgement
from l2m_gtsam.storage.report_id import checked_id, with_id
from l2m_gtsam.storage.result_set import check_set
from l2m_gtsam.storage.yaml_file import checked, read_yaml, write_yaml

FORMAT = "l2m-calibration"
VERSION = 1
HEADER = """Calibration of magnetometers against a LiDAR, written by l2m_gtsam.
Formulas, frames and units stand under `model`; each sensor has its own entry under `sensors`."""
# What files of the first version lack; their sigmas are of this kind.
FIRST_VERSION = {"uncertainty": Uncertainty.INDEPENDENT.value, "doubts": (), "disagreements": ()}
UNCERTAINTY = {
    Uncertainty.FULL: (
        "sigmas include the map's errors, which readings near each other and all sensors share; "
        "they are right if the map predicts held-out readings of its survey (`l2m map info`)"
    ),
    Uncertainty.INDEPENDENT: (
        "sigmas count the map's errors as independent from reading to reading; where the map is "
        "less accurate than the sensor they are too small"
    ),
}

MODEL = {
    "id": (
        "the report id: SHA-256 of all that this file says but for the id itself, as JSON with "
        "sorted keys and no spaces; metrics_sha256: of metrics.json, which the report is drawn from"
    ),
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
        "ns, the lidar's path from p_from to p_to in m in the map, median residual (size) in uT; "
        "explanations: as of sources, of all readings in the cells of 1 m that it goes through"
    ),
    "sources": (
        "steel that came, went or was moved since the place was mapped, found in the readings and "
        "taken into the solve: position and half_axis in m, moment in A m^2, map frame; gain: "
        "twice the log of the likelihood ratio; explanations: what a change of the place, of the "
        "moment, of the vehicle or of one sensor explains there, the best first"
    ),
    "readings": (
        "how many there were and why others do not count; where the range is exceeded: limits, the "
        "value in uT that is reported beyond it along an axis, of how many readings; saturated: "
        "those that do not count for that"
    ),
    "from_priors": (
        "what the readings leave open and only `calibration.priors` determine, or mostly (sigmas "
        "without them would be more than twice as large): parameters, and what was known of them"
    ),
    "unmodelled": (
        "how many times larger variances are than noise, map and poses explain, from the scatter "
        "of parts of the drive; covariance and sigmas include it; absent where nothing is"
    ),
    "variance_shares": (
        "what each cause has of the variances of t, C and H, as shares of one: noise of the "
        "readings, the map, the sensors of its survey, poses, processes of the drive, priors"
    ),
    "common": (
        "of a suite calibrated from its own survey: rows for the parameters in covariance_order "
        "and the time offset; the covariance of two sensors i and j is common_i @ common_j.T"
    ),
    "verdict": (
        "what the report concludes, with its reasons; thresholds: the options `qa` it was judged "
        "by; earlier: what the same numbers were judged before, by other thresholds"
    ),
    "exact": "what counts as exact, for want of stated errors: sigmas know nothing of its errors",
    "disturbances": (
        "processes found beside noise and the map's errors, which covariances hold: wander of H, "
        "errors of poses that last, a drive's frame that is bent against the map's, a clock that "
        "drifts, readings that are smoothed, a field that is not the map's for a time, H that "
        "follows the vehicle's motion; sizes are standard deviations, gain is twice a logarithm "
        "of likelihood"
    ),
    "jumps": (
        "moments at which H of a sensor jumped, by the stamps of its readings and in seconds after "
        "the drive's first: H after less before, uT; H of the file is that of the end"
    ),
    "stated": (
        "errors whose standard deviations were stated: ratio of what the readings show to what was "
        "stated; gain: twice the logarithm by which the readings are more likely so"
    ),
    "pose_duration": (
        "how long errors of poses last, whose sizes were stated: the correlation of two falls to "
        "1/e over this time; given, found in the readings, or assumed"
    ),
    "unseen_warp_m": (
        "shifts of the drive's frame against the map's that readings leave possible, metres, root "
        "mean square along each axis of the floor; covariances hold them"
    ),
    "recorded": (
        "first and last pose of each drive in UTC (null: its clock was not set), frames of its "
        "poses, and the file that they are from if that is not the bag"
    ),
    "map_origin": (
        "what the map was made from, as its file has it: first and last pose of the survey, end "
        "of the last drive that it was given since, files with their digests"
    ),
    "traces": "some poses of each drive, by which validate recognises it whatever file it is in",
    "infinite": "a variance of .inf marks what this drive and map do not determine",
}
ABOUT_ERRORS = (
    *("uncertainty", "doubts", "notes", "exact", "disturbances", "jumps", "stated"),
    *("pose_duration", "unseen_warp_m"),
)
ABOUT_ORIGIN = ("recorded", "map_origin", "traces", "versions", "iterations")
"""Fields of a result as the file has them, in its order."""
OPTIONAL = (
    *("notes", "exact", "disturbances", "jumps", "stated", "pose_duration", "unseen_warp_m"),
    *("traces", "sources", "metrics_sha256", "recorded", "map_origin"),
)
SENSOR_KEYS = (
    *("status", "message", "t_lidar_mag", "t_sigma", "C", "C_sigma", "H", "H_sigma"),
    *("R_lidar_mag", "rotation_sigma", "rotation_covariance", "transforms", "noise"),
    *("undetermined", "from_priors", "residuals", "readings", "outside_map", "rejected", "start"),
    *("time_offset", "moving", "models", "not_compared", "missing_in", "drive_noise"),
    *("unmodelled", "variance_shares", "common", "covariance"),
)
"""In the order of the file; the matrix of 15 rows comes last, since it hides what follows it."""
SENSOR_OPTIONAL = ("missing_in", "drive_noise", "unmodelled", "variance_shares", "common")


@dataclass(frozen=True)
class _Head:
    format: Literal["l2m-calibration"]
    version: Literal[1]


@dataclass(frozen=True)
class _CalibrationFile(CalibrationResult, _Head):
    """The head, and the fields of the result beside it; what is derived from them is not read."""


_FILE = TypeAdapter(_CalibrationFile)
_RESULT = TypeAdapter(CalibrationResult)
_SENSOR = TypeAdapter(SensorCalibration)
_JUDGEMENT = TypeAdapter(Judgement)


def write_calibration(path: Path, result: CalibrationResult) -> CalibrationResult:
    """Write a calibration, and return it with its id; `read_calibration` gives it back equal."""
    content = calibration_content(result)
    write_yaml(path, content, HEADER)
    return replace(result, report_id=content["id"])


def calibration_content(result: CalibrationResult) -> dict[str, Any]:
    """Return all that the file of a calibration says, plain values with the id of them."""
    plain = _RESULT.dump_python(result, exclude={"sensors"})
    judged = {} if result.judgement is None else {"verdict": verdict_entry(result.judgement)}
    stretches = plain["disagreements"]
    content = {
        "format": FORMAT,
        "version": VERSION,
        "metrics_sha256": plain["metrics_sha256"],
        **judged,
        "model": {"uncertainty": UNCERTAINTY[result.uncertainty], **MODEL},
        **{name: plain[name] for name in ABOUT_ERRORS},
        "disagreements": [_without_empty(each, "bag", "explanations") for each in stretches],
        "sources": plain["sources"],
        **source_entries(result),
        **{name: plain[name] for name in ABOUT_ORIGIN},
        "sensors": {sensor.sensor: sensor_entry(sensor) for sensor in result.sensors},
        "options": plain["options"],
    }
    return with_id(_without_empty(content, *OPTIONAL), "version")


def read_calibration(path: Path) -> CalibrationResult:
    """Return the calibration in a file.

    Raises
    ------
    CalibrationError
        The file is missing, damaged, something else, or was changed after it was written.
    """
    return calibration_in(path, read_yaml(path, CalibrationError))


def calibration_in(path: Path, content: Any) -> CalibrationResult:
    """Return the calibration in the plain content of a file, see ``read_calibration``."""
    found = checked(path, content, _FILE, _as_record, added=("distortion", "judgement"))
    check_set(path, CalibrationError)
    if found.judgement is not None and not found.judgement.verdict.follows:
        raise CalibrationError(
            f"{path}: verdict.level: {found.judgement.verdict.level.upper()} does not follow from "
            "its reasons; it was edited: calibrate again"
        )
    result = CalibrationResult(**fields_of(found, CalibrationResult))
    return replace(result, report_id=checked_id(path, content, CalibrationError))


def _as_record(content: dict[str, Any]) -> dict[str, Any]:
    """Return a file as its record has it: C and H as a distortion, a verdict as a judgement."""
    sensors = content.get("sensors")
    if isinstance(sensors, dict):
        sensors = {
            name: {**entry, "distortion": entry} if isinstance(entry, dict) else entry
            for name, entry in sensors.items()
        }
    record = {**FIRST_VERSION, **content, "sensors": sensors}
    if "verdict" in content:
        verdict = content["verdict"]
        beside = verdict if isinstance(verdict, dict) else {}
        names = ("thresholds", "earlier")
        kept = {name: beside[name] for name in names if name in beside}
        record["judgement"] = {"verdict": verdict, **kept}
    return record


def verdict_entry(judgement: Judgement | None) -> dict[str, Any]:
    """Return a judgement as plain values: the verdict, and what it rests on beside it."""
    if judgement is None:
        return {"level": NOT_JUDGED}
    plain = _JUDGEMENT.dump_python(judgement)
    earlier = {"earlier": plain["earlier"]} if plain["earlier"] else {}
    return {**plain["verdict"], **earlier, "thresholds": plain["thresholds"]}


def verdict_text(result: CalibrationResult, source: SourceFile) -> str:
    """Return the verdict on a calibration, and which it is, as JSON for other files."""
    content = {
        "format": "l2m-verdict",
        "version": 1,
        "calibration": {
            "path": Path(source.path).name,
            "sha256": source.sha256,
            **({"report_id": result.report_id} if result.report_id else {}),
        },
        "verdict": verdict_entry(result.judgement),
    }
    return json.dumps(content, ensure_ascii=False)


def sensor_entry(sensor: SensorCalibration) -> dict[str, Any]:
    """Return all that is known of a sensor as plain values, derived ones too."""
    plain = _SENSOR.dump_python(sensor, by_alias=True)
    values = {
        **plain,
        **plain["distortion"],
        "t_sigma": sensor.t_sigma.tolist(),
        "C_sigma": sensor.C_sigma.tolist(),
        "H_sigma": sensor.H_sigma.tolist(),
        "rotation_sigma": np.sqrt(np.diag(sensor.rotation_covariance)).tolist(),
        "transforms": _transforms(RigidTransform(sensor.R_lidar_mag, sensor.t_lidar_mag)),
        "time_offset": _time_offset(plain["time_offset"], sensor),
        "models": _models(plain["models"]),
    }
    if sensor.unmodelled == EXPLAINED:
        values["unmodelled"] = None
    values["readings"] = _without_empty(values["readings"], "saturated", "limits", "elsewhere")
    return _without_empty({key: values[key] for key in SENSOR_KEYS}, *SENSOR_OPTIONAL)


def source_entries(result: CalibrationResult) -> dict[str, Any]:
    """Return what was calibrated: one drive under `bag`, several under `bags`, and the map."""
    plain = _RESULT.dump_python(result, include={"bag", "bags", "map"})
    return _without_empty({name: plain[name] for name in ("bag", "bags", "map")}, "bags")


def _without_empty(entry: dict[str, Any], *names: str) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if value or key not in names}


def _time_offset(plain: dict[str, Any] | None, sensor: SensorCalibration) -> dict[str, Any] | None:
    if plain is None:
        return None
    correlation = {"correlation_with_t": sensor.offset_correlation.tolist()}
    names = ("seconds", "sigma", "correlation_with_t", "held", "cross_covariance")
    return {name: {**plain, **correlation}[name] for name in names}


def _models(plain: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return a comparison with the rows of h under the names of their numbers."""
    if plain is None:
        return None
    names = plain["regressors"]
    tables = {
        table: {**plain[table], "h": dict(zip(names, plain[table]["h"], strict=True))}
        for table in ("coefficients", "sigma")
    }
    return {**plain, **tables}


def _transforms(T_lidar_mag: RigidTransform) -> dict[str, Any]:
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
    return {"translation": transform.t.tolist(), "quaternion_xyzw": _quaternion(transform.R)}


def _quaternion(R: FloatArray) -> list[float]:
    if not np.isfinite(R).all():
        return [float("nan")] * 4
    return [float(q) for q in Rotation.from_matrix(R).as_quat(canonical=True)]
