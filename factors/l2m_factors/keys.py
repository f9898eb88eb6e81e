"""Every symbol of the graph, in one place."""

import gtsam


def N(key_pose: int) -> int:
    """Return the key of the slow error of readings at this key pose: Vector 3, unit variance."""
    return int(gtsam.symbol("N", key_pose))


def X(key_pose: int) -> int:
    """Return the key of this key pose, ``T_map_lidar``: Pose3, metres."""
    return int(gtsam.symbol("X", key_pose))


def T(sensor: int) -> int:
    """Return the key of ``t_lidar_mag`` of this sensor: Point3, metres, lidar frame."""
    return int(gtsam.symbol("T", sensor))


def D(sensor: int) -> int:
    """Return the key of this sensor's distortion: Vector 12, C row by row, then H in uT."""
    return int(gtsam.symbol("D", sensor))


def S(sensor: int) -> int:
    """Return the key of this sensor's time offset: double, seconds to add to its stamps."""
    return int(gtsam.symbol("S", sensor))


def M(tile: int) -> int:
    """Return the key of the map's error in this tile: Vector of its modes, unit variance each."""
    return int(gtsam.symbol("M", tile))


def P(knot: int) -> int:
    """Return the key of the lidar's pose error at this knot: Vector 6, unit variance each."""
    return int(gtsam.symbol("P", knot))


def Q(sensor: int) -> int:
    """Return the key of what recorded numbers add to this sensor's field: Vector 3K, unit variance.

    Three for each of K numbers, along the axes of the lidar.
    """
    return int(gtsam.symbol("Q", sensor))


def W(sensor: int) -> int:
    """Return the key of how this sensor's H wanders on a drive: Vector, unit variance each."""
    return int(gtsam.symbol("W", sensor))


def K(sensor: int) -> int:
    """Return the key of how this sensor's clock drifts on a drive: Vector, unit variance each."""
    return int(gtsam.symbol("K", sensor))


def L(sensor: int) -> int:
    """Return the key of how this sensor smooths its readings (low-pass): Vector, unit variance."""
    return int(gtsam.symbol("L", sensor))


def A(sensor: int) -> int:
    """Return the key of how this sensor's H follows the vehicle's motion: Vector, unit variance."""
    return int(gtsam.symbol("A", sensor))


def B() -> int:
    """Return the key of how the field differs from the map's in time: Vector, unit variance."""
    return int(gtsam.symbol("B", 0))


def F() -> int:
    """Return the key of how the drive's frame is bent against the map's: Vector, unit variance."""
    return int(gtsam.symbol("F", 0))


def U() -> int:
    """Return the key of the errors of the sensors that surveyed: Vector, unit variance each."""
    return int(gtsam.symbol("U", 0))


def G() -> int:
    """Return the key of the share by which all distances exceed odometry's: double."""
    return int(gtsam.symbol("G", 0))


def V() -> int:
    """Return the key of odometry's steady drift: Vector 6, unit variance each.

    Along the axes of the map, three that come with time and three that come with distance.
    """
    return int(gtsam.symbol("V", 0))
