"""Drives and sensors made of arrays, with their shapes and units checked."""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from l2m_gtsam.api.arguments import NAME, came, check, pair_of, refused
from l2m_gtsam.data import (
    ARRAYS,
    Distortion,
    FieldSeries,
    FloatArray,
    IntArray,
    KnownSensor,
    Recording,
    SourceFile,
    Trajectory,
)
from l2m_gtsam.errors import InputError, UnitsError
from l2m_gtsam.storage.known_sensors import (
    LARGEST_OFFSET_S,
    checked_gains,
    checked_place,
    stated_covariance,
)
from l2m_gtsam.storage.units import Unit, Units, field_fault, microtesla_per, strength_fault

LATEST_S = 9e9


def drive(
    stamps: npt.ArrayLike,
    positions: npt.ArrayLike,
    orientations: npt.ArrayLike,
    fields: Mapping[str, tuple[npt.ArrayLike, npt.ArrayLike]],
    *,
    units: str | float = "microtesla",
    frame: str = "map",
    pose_covariance: npt.ArrayLike | None = None,
) -> Recording:
    """Return a drive, or a survey, made of copies of arrays.

    Parameters
    ----------
    stamps
        Times of the poses: seconds as floating-point numbers, or nanoseconds as integers, shape
        (N,), increasing.
    positions
        Of the LiDAR in the map in metres, shape (N, 3).
    orientations
        Of the LiDAR in the map: quaternions x, y, z, w, shape (N, 4), or rotation matrices, shape
        (N, 3, 3).
    fields
        Of each magnetometer by name its times as those of the poses, shape (M,), and its readings
        in its own axes, shape (M, 3); NaN marks a missing one. Of readings with one stamp the first
        counts. One of several magnetometers may have no readings.
    units
        Unit of the readings: `tesla`, `millitesla`, `microtesla`, `nanotesla`, `gauss`,
        `milligauss`, or a number, microtesla per count.
    frame
        Name of the frame of the poses, the same for survey and drive.
    pose_covariance
        Of the errors of the poses, shape (6, 6) or (N, 6, 6): a rotation in radians, then a
        translation in metres, along the axes of the LiDAR. Unknown if absent, or if that of a pose
        is all zero.

    Raises
    ------
    InputError
        An array has another shape, or values that cannot be; the line names it.
    UnitsError
        A strength does not fit its unit.
    """
    times = _stamps("stamps", stamps)
    p = _numbers("positions", positions, (len(times), 3))
    R = _rotations(orientations, len(times))
    if len(times) < 2 or (np.diff(times) <= 0).any():
        raise InputError("stamps: two or more, each later than the one before, are needed")
    named = _units(units)
    series = _all_series(fields, named)
    digest = hashlib.sha256()
    for array in (times, p, R, *(a for each in series for a in (each.stamp_ns, each.field))):
        digest.update(np.ascontiguousarray(array).tobytes())
    source = SourceFile(ARRAYS, digest.hexdigest())
    covariance = None if pose_covariance is None else _covariance(pose_covariance, len(times))
    return Recording(Trajectory(times, R, p, frame, "lidar", covariance), series, source)


def known_sensor(
    name: str,
    t: npt.ArrayLike = (0.0, 0.0, 0.0),
    C: npt.ArrayLike | None = None,
    H: npt.ArrayLike = (0.0, 0.0, 0.0),
    *,
    time_offset: float = 0.0,
    t_sigma: npt.ArrayLike | None = None,
    C_sigma: npt.ArrayLike | None = None,
    H_sigma: npt.ArrayLike | None = None,
    time_offset_sigma: float | None = None,
    covariance: npt.ArrayLike | None = None,
) -> KnownSensor:
    """Return a magnetometer whose calibration is known: ``B_meas = C @ B_lidar + H``.

    Parameters
    ----------
    name
        As in the drive.
    t
        Position in the LiDAR's frame in metres, shape (3,).
    C
        Distortion matrix, shape (3, 3); that of an ideal sensor if absent.
    H
        Offset in microtesla, shape (3,).
    time_offset
        Of its clock in seconds.
    t_sigma, C_sigma, H_sigma
        Standard deviations in m, 1 and uT, shapes (3,), (3, 3) and (3,), or one number for all of
        them; what has none counts as exact.
    time_offset_sigma
        The same of the clock, in seconds.
    covariance
        Of (t, C row by row, H) in place of their sigmas, shape (15, 15).

    Raises
    ------
    InputError
        An array has another shape, is not finite, or C cannot be inverted; a sigma is not positive;
        or the covariance is none.
    """
    check(NAME, name=name)
    gains = _numbers("C", np.eye(3) if C is None else C, (3, 3))
    place, offset = _numbers("t", t, (3,)), _numbers("H", H, (3,))
    late = float(_numbers("time_offset", time_offset, ()))
    if abs(late) > LARGEST_OFFSET_S:
        raise InputError(f"time_offset: {late:g} s; at most {LARGEST_OFFSET_S:g} s are accepted")
    stated = {
        "covariance": _plain(covariance),
        "t_sigma": _plain(t_sigma),
        "C_sigma": _plain(C_sigma),
        "H_sigma": _plain(H_sigma),
        "time_offset": {"sigma": _plain(time_offset_sigma)},
    }
    try:
        distortion = Distortion(checked_gains(gains), offset)
        return KnownSensor(name, checked_place(place), distortion, late, stated_covariance(stated))
    except ValueError as error:
        told = str(error).replace("time_offset.sigma", "time_offset_sigma")  # its name in a file
        raise InputError(f"{name}: {told}") from error


def _plain(values: npt.ArrayLike | None) -> Any:
    """Return an array as nested lists, which a message has in one line."""
    return values.tolist() if isinstance(values, np.ndarray) else values


def _all_series(fields: Mapping[str, Any], units: Units) -> tuple[FieldSeries, ...]:
    if not isinstance(fields, Mapping) or not fields:
        raise refused("fields", fields, "{name: (stamps, readings)} of each magnetometer")
    for name in fields:
        check(NAME, **{"fields: a name": name})
    pairs = {name: pair_of(f"fields[{name!r}]", fields[name]) for name in sorted(fields)}
    series = tuple(_series(name, *pair, units) for name, pair in pairs.items())
    if not any(np.isfinite(each.field).all(axis=1).any() for each in series):
        raise InputError(f"fields: no finite reading in {', '.join(pairs)}")
    return series


def _series(name: str, stamps: npt.ArrayLike, readings: npt.ArrayLike, units: Units) -> FieldSeries:
    times = _stamps(f"fields[{name!r}]: stamps", stamps)
    if len(times) > 1 and not times.any():
        raise InputError(f"fields[{name!r}]: stamps: all are 0; give the times of the readings")
    if not len(times) and np.size(readings) == 0:
        readings = np.empty((0, 3))  # an empty list has no columns
    field = _numbers(f"fields[{name!r}]: readings", readings, (len(times), 3), finite=False)
    if wrong := _strength_fault(field, units):
        raise UnitsError(f"fields[{name!r}]: {wrong}")
    order = np.argsort(times, kind="stable")
    in_ut = field[order] * microtesla_per(units, None)
    return FieldSeries(name, name, name, times[order], in_ut)


def _strength_fault(field: FloatArray, units: Units) -> str | None:
    """Return what is wrong with readings; a named unit is judged as a type's would be.

    Constant readings are judged, too: whoever gives arrays gives all of one unit.
    """
    judged, own = (Unit.AUTO, units) if isinstance(units, Unit) else (units, None)
    name = "units"  # of the argument
    return field_fault(field, judged, own, name) or strength_fault(field, judged, own, name)


def _units(units: str | float) -> Units:
    accepted = [unit.value for unit in Unit if unit is not Unit.AUTO]
    if isinstance(units, str) and units in accepted:
        return Unit(units)
    if isinstance(units, int | float) and not isinstance(units, bool) and 0 < units < np.inf:
        return float(units)
    raise InputError(
        f"units: {units!r} is not known; accepted: {', '.join(accepted)}, or a positive number, "
        "microtesla per count"
    )


def _stamps(name: str, values: npt.ArrayLike) -> IntArray:
    """Return times in nanoseconds."""
    try:
        array = np.asarray(values)
    except ValueError as error:  # lists of other lengths in a list
        raise refused(name, values, "an array of numbers of shape (N,)") from error
    if array.ndim != 1 or array.dtype.kind not in "iuf":
        raise InputError(
            f"{name}: {array.dtype} of shape {array.shape}; needed are numbers of shape (N,)"
        )
    if array.dtype.kind != "f":
        return array.astype(np.int64)
    if not np.isfinite(array).all() or np.abs(array).max(initial=0.0) > LATEST_S:
        raise InputError(f"{name}: floating-point times must be seconds; give nanoseconds as int64")
    return np.asarray(np.round(array.astype(np.float64) * 1e9).astype(np.int64))


def _numbers(
    name: str, values: npt.ArrayLike, shape: tuple[int, ...], *, finite: bool = True
) -> FloatArray:
    """Return a copy, which does not change when its owner writes into the array."""
    array = array_of(name, values).copy()
    if array.shape != shape:
        raise InputError(f"{name}: of shape {array.shape}; needed is {shape}")
    if finite and not np.isfinite(array).all():
        raise InputError(f"{name}: a number is not finite")
    return array


def array_of(name: str, values: npt.ArrayLike) -> FloatArray:
    """Return an array of numbers; an InputError for what is none."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: not an array of numbers ({came(values)})") from error


def _covariance(values: npt.ArrayLike, count: int) -> FloatArray | None:
    """Return covariances of poses, shape (N, 6, 6); None where one is all zero, as in messages."""
    array = array_of("pose_covariance", values)
    each = np.broadcast_to(array, (count, 6, 6)) if array.shape == (6, 6) else array
    found = _numbers("pose_covariance", each, (count, 6, 6))
    largest = np.abs(found).max(axis=(1, 2), keepdims=True)
    if not largest.all():
        return None
    symmetric = np.abs(found - found.swapaxes(1, 2)) <= 1e-9 * largest
    if not symmetric.all() or np.linalg.eigvalsh(found / largest).min() < -1e-9:
        raise InputError("pose_covariance: must be symmetric, without negative eigenvalues")
    return found


def _rotations(values: npt.ArrayLike, count: int) -> FloatArray:
    """Return rotation matrices of quaternions, or as they are, shape (N, 3, 3)."""
    array = array_of("orientations", values)
    if array.ndim == 2:
        q = _numbers("orientations", array, (count, 4))
        lengths = np.linalg.norm(q, axis=1)
        if np.abs(lengths - 1).max(initial=0.0) > 1e-2:
            raise InputError("orientations: quaternions x, y, z, w must have length 1")
        return np.asarray(Rotation.from_quat(q).as_matrix().reshape(-1, 3, 3))
    R = _numbers("orientations", array, (count, 3, 3))
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if error > 1e-6 or (np.linalg.det(R) < 0).any():
        raise InputError("orientations: matrices must be rotations")
    return R
