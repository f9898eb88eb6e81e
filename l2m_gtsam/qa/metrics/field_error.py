"""How far readings are from the map's: the paper's e_B, before and after the calibration."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.records.validation import FieldError


def field_error(field: FloatArray, of_map: FloatArray) -> FieldError:
    """Return the difference of fields along the axes of the lidar, both in uT, shape (N, 3)."""
    difference = field - of_map
    length = np.linalg.norm(difference, axis=1)
    return FieldError(
        squared=float(np.mean(length**2)),
        mean=float(length.mean()),
        std=float(length.std()),
        mean_axes=row(difference.mean(axis=0)),
        std_axes=row(difference.std(axis=0)),
    )


def refitted(b_lidar: FloatArray, readings: FloatArray) -> float:
    """Return what any C and H leave of readings at fields ``b_lidar``, per axis, rms in uT.

    Both have the shape (N, 3).
    """
    A: FloatArray = np.column_stack([b_lidar, np.ones(len(b_lidar))])
    # A vehicle that keeps its heading leaves columns alike; least squares takes the shortest then.
    solution = np.linalg.lstsq(A, readings, rcond=None)[0]
    return float(np.sqrt(np.mean((A @ solution - readings) ** 2)))
