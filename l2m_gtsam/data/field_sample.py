"""What a map says about the field."""

from dataclasses import dataclass

from l2m_gtsam.data.arrays import BoolArray, FloatArray
from l2m_gtsam.data.tables import chosen_rows


@dataclass(frozen=True)
class FieldSample:
    """What a map says about the field at N points.

    Attributes
    ----------
    field
        Mean in the map frame in microtesla, shape (N, 3); NaN outside the map.
    gradient
        ``gradient[n, i, j]`` = dB_i/dx_j in microtesla per metre, shape (N, 3, 3); NaN outside.
    variance
        Posterior variance per axis of the map frame in square microtesla, without sensor
        noise, shape (N, 3); infinite outside.
    inside
        Whether the map has data near the point, shape (N,).
    """

    field: FloatArray
    gradient: FloatArray
    variance: FloatArray
    inside: BoolArray

    def select(self, keep: BoolArray) -> "FieldSample":
        """Return what it says at some of the points, shape (N,)."""
        return chosen_rows(self, keep)
