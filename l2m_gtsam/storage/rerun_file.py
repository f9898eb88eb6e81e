"""A scene as a recording that Rerun's viewer opens."""

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import OutputError
from l2m_gtsam.records.scene import DriveView, MapView, Scene, SensorView
from l2m_gtsam.storage.files import atomic_path

if TYPE_CHECKING:
    from rerun import RecordingStream

WITHIN = np.sqrt(
    7.815
)  # half axes of the ellipsoid that holds 95 %, in sigmas: chi-square of three
LONGEST = 0.5  # metres of an arrow, for the misfit that a reading in a hundred exceeds
FITS, REJECTED, LIDAR, PATH = (0, 114, 178), (213, 94, 0), (90, 90, 90), (30, 30, 30)
TIMELINE = "drive"


def require_rerun(path: Path) -> None:
    """Say that a scene cannot be written, before it is computed.

    Raises
    ------
    OutputError
        Rerun is not installed.
    """
    if find_spec("rerun") is None:
        raise OutputError(f"{path}: rerun is missing: pip install 'l2m-gtsam[viewer]'")


def write_scene(path: Path, scene: Scene) -> None:
    """Write a scene.

    Entities: ``map/strength`` (places coloured by |B|) and ``map/anomaly`` (field less its mean),
    ``drive`` (the paths), ``lidar`` (its pose over time) with each sensor and its 95 % ellipsoid
    under it, and ``misfit`` and ``rejected`` (arrows of corrected reading less map, by sensor).

    Parameters
    ----------
    path
        File to write (.rrd).
    scene
        What there is to see.

    Raises
    ------
    OutputError
        Rerun is not installed, or the file cannot be written.
    """
    require_rerun(path)
    import rerun as rr

    with atomic_path(path) as temporary:
        with rr.RecordingStream("l2m_gtsam", recording_id=scene.name) as recording:
            recording.save(temporary)
            recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            _log_map(recording, scene.map)
            _log_drives(recording, scene.drives)
            metres = arrow_scale(scene.sensors)
            for sensor in scene.sensors:
                _log_sensor(recording, sensor, metres)
        recording.disconnect()


def arrow_scale(sensors: tuple[SensorView, ...]) -> float:
    """Return how many metres an arrow has for a microtesla, the same for all sensors."""
    lengths = np.concatenate([np.linalg.norm(each.misfit, axis=1) for each in sensors])
    known = lengths[np.isfinite(lengths)]
    longest = float(np.quantile(known, 0.99)) if len(known) else 0.0
    return LONGEST / longest if longest else 1.0


def ellipsoid(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return half axes in metres, shape (3,), and quaternion xyzw of what holds 95 %."""
    variances, axes = np.linalg.eigh(covariance)
    axes = axes * np.sign(np.linalg.det(axes))
    half = WITHIN * np.sqrt(np.maximum(variances, 0.0))
    return np.asarray(half), np.asarray(Rotation.from_matrix(axes).as_quat())


def _log_map(recording: "RecordingStream", view: MapView) -> None:
    import rerun as rr

    strength = np.linalg.norm(view.field, axis=1)
    low, high = np.quantile(strength, [0.01, 0.99]) if len(strength) else (0.0, 1.0)
    colours = colormaps["viridis"](np.clip((strength - low) / max(high - low, 1e-9), 0, 1))
    points = rr.Points3D(view.place, colors=colours[:, :3], radii=0.3 * view.cell)
    recording.log("map/strength", points, static=True)
    anomaly = view.field - view.field.mean(axis=0) if len(strength) else view.field
    longest = max(float(np.linalg.norm(anomaly, axis=1).max(initial=0.0)), 1e-9)
    arrows = rr.Arrows3D(
        origins=view.place,
        vectors=2 * view.cell * anomaly / longest,
        colors=colours[:, :3],
        radii=0.04 * view.cell,
    )
    recording.log("map/anomaly", arrows, static=True)


def _log_drives(recording: "RecordingStream", views: tuple[DriveView, ...]) -> None:
    import rerun as rr

    lines = rr.LineStrips3D([each.p for each in views], colors=PATH, radii=0.01)
    recording.log("drive", lines, static=True)
    recording.log("lidar", rr.Points3D([[0.0, 0.0, 0.0]], colors=LIDAR, radii=0.05), static=True)
    poses = rr.Transform3D.columns(
        translation=np.concatenate([each.p for each in views]),
        quaternion=np.concatenate([Rotation.from_matrix(each.R).as_quat() for each in views]),
    )
    seconds = np.concatenate([each.seconds for each in views])
    recording.send_columns("lidar", [rr.TimeColumn(TIMELINE, duration=seconds)], poses)


def _log_sensor(recording: "RecordingStream", view: SensorView, metres: float) -> None:
    import rerun as rr

    part: Any = rr.escape_entity_path_part(view.sensor)
    at = rr.Points3D([view.t_lidar_mag], colors=FITS, radii=0.015, labels=[view.sensor])
    recording.log(f"lidar/{part}", at, static=True)
    if np.isfinite(view.covariance).all():
        half, quaternion = ellipsoid(view.covariance)
        region = rr.Ellipsoids3D(
            centers=[view.t_lidar_mag],
            half_sizes=[half],
            quaternions=[rr.Quaternion(xyzw=quaternion)],
            colors=FITS,
        )
        recording.log(f"lidar/{part}/within_95_percent", region, static=True)
    known = np.isfinite(view.misfit).all(axis=1)
    for entity, rows, colour in (
        ("misfit", known & ~view.rejected, FITS),
        ("rejected", known & view.rejected, REJECTED),
    ):
        arrows = rr.Arrows3D(
            origins=view.place[rows], vectors=metres * view.misfit[rows], colors=colour, radii=0.005
        )
        recording.log(f"{entity}/{part}", arrows, static=True)
