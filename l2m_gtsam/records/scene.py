"""What there is to see of a calibration in three dimensions."""

from dataclasses import dataclass

from l2m_gtsam.data import BoolArray, FloatArray


@dataclass(frozen=True)
class MapView:
    """A map on a lattice of M places around a drive.

    Attributes
    ----------
    place
        In the map in metres, shape (M, 3).
    field
        There, along the map's axes in uT, shape (M, 3).
    cell
        Distance between neighbouring places in metres.
    """

    place: FloatArray
    field: FloatArray
    cell: float


@dataclass(frozen=True)
class DriveView:
    """K poses of the lidar in the map.

    Attributes
    ----------
    seconds
        Since the first of all drives, pauses between drives left out, shape (K,).
    R, p
        Rotations (K, 3, 3), and positions (K, 3) in metres.
    """

    seconds: FloatArray
    R: FloatArray
    p: FloatArray


@dataclass(frozen=True)
class SensorView:
    """One sensor on the lidar, and N of its readings.

    Attributes
    ----------
    sensor
        Its name.
    t_lidar_mag, covariance
        Its place on the lidar in metres, shape (3,), and the covariance, shape (3, 3).
    place
        Where it was in the map in metres, shape (N, 3).
    misfit
        Corrected reading less what the map has there, along the map's axes in uT, shape (N, 3).
    rejected
        Whether a reading does not count, shape (N,).
    """

    sensor: str
    t_lidar_mag: FloatArray
    covariance: FloatArray
    place: FloatArray
    misfit: FloatArray
    rejected: BoolArray


@dataclass(frozen=True)
class Scene:
    """Map, drives and sensors; ``name`` says of what."""

    name: str
    map: MapView
    drives: tuple[DriveView, ...]
    sensors: tuple[SensorView, ...]
