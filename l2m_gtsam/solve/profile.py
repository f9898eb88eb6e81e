r"""How well sensors at candidate places explain their readings, whatever their distortion.

With C and H eliminated in closed form the cost of a candidate t is what a linear regression of the
readings on the predicted field leaves,

.. math::
    \min_{C, H} \sum_k | C R_k^T B(R_k t + p_k) + H - z_k |^2 .

All sensors are regressed on the same predictions: the map is asked once for all of them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray, Readings

# Between two readings of a sensor its value is interpolated if the lidar moved no further.
MOST_STEP = 0.3  # metres
MOST_TURN = 0.3  # radians, of the rotation's Frobenius distance over sqrt(2)
# Normal equations hold half of the digits: what follows from the rest only is not regressed on.
TIE = 1e-10

Prediction = Callable[[FloatArray], tuple[FloatArray, BoolArray]]
"""Field in uT at points (N, 3) in metres, shape (N, 3), and whether it is known, shape (N,)."""


@dataclass(frozen=True)
class Snapshots:
    """What all S sensors read at K common poses.

    Attributes
    ----------
    R_map_lidar
        Shape (K, 3, 3).
    p_map_lidar
        Metres, shape (K, 3).
    field
        Each sensor's reading in its own frame in uT, NaN where it has none near, shape (K, S, 3).
    """

    R_map_lidar: FloatArray
    p_map_lidar: FloatArray
    field: FloatArray

    def __len__(self) -> int:
        return len(self.p_map_lidar)

    def shared(self) -> BoolArray:
        """Return which sensors read something at half of the poses or more, shape (S,)."""
        return np.asarray(np.isfinite(self.field).all(axis=2).mean(axis=0) >= 0.5)

    def thinned(self, count: int) -> "Snapshots":
        """Return at most so many of the poses, spread evenly."""
        rows = np.linspace(0, len(self) - 1, min(count, len(self))).round().astype(int)
        return Snapshots(self.R_map_lidar[rows], self.p_map_lidar[rows], self.field[rows])

    def places(self, t: FloatArray) -> FloatArray:
        """Return where candidates (G, 3) in the lidar frame are in the map, shape (G, K, 3)."""
        return np.asarray(np.einsum("kij,gj->gki", self.R_map_lidar, t) + self.p_map_lidar)


def snapshots_of(readings: Readings, most: int) -> Snapshots:
    """Return at most so many poses, spread evenly over the drive, with what all sensors read."""
    _, rows = np.unique(readings.stamp_ns, return_index=True)
    rows = rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int)]
    at = readings[rows]
    fields = [
        interpolated(readings[np.flatnonzero(readings.sensor == sensor)], at)
        for sensor in range(len(readings.sensors))
    ]
    return Snapshots(at.R_map_lidar, at.p_map_lidar, np.stack(fields, axis=1))


def interpolated(own: Readings, at: Readings) -> FloatArray:
    """Return a sensor's readings at the times of others in uT, shape (K, 3).

    They are NaN where the sensor read nothing near, in time or place.
    """
    field = np.full((len(at), 3), np.nan)
    if len(own) < 2:
        return field
    after = np.clip(np.searchsorted(own.stamp_ns, at.stamp_ns), 1, len(own) - 1)
    a, b = own[after - 1], own[after]
    share = (at.stamp_ns - a.stamp_ns) / np.maximum(b.stamp_ns - a.stamp_ns, 1)
    # At the very time of a reading the other one does not matter.
    near = (close(a, at) | (share == 1)) & (close(b, at) | (share == 0))
    near &= (share >= 0) & (share <= 1)
    field[near] = (a.field + share[:, None] * (b.field - a.field))[near]
    return field


def close(a: Readings, b: Readings) -> BoolArray:
    """Return whether the lidar stood about as it did, reading by reading, shape (N,)."""
    step = np.linalg.norm(a.p_map_lidar - b.p_map_lidar, axis=1)
    turn = np.linalg.norm(a.R_map_lidar - b.R_map_lidar, axis=(1, 2))
    return np.asarray((step <= MOST_STEP) & (turn <= np.sqrt(2) * MOST_TURN))


@dataclass(frozen=True)
class Misfits:
    """What candidates leave of the readings.

    Attributes
    ----------
    left
        Sum of squares in uT^2 of each of G candidates and S sensors, shape (G, S). Where the map
        does not know the field a candidate explains nothing but the mean.
    known
        Share of each sensor's readings that lie inside the map, shape (G, S).
    """

    left: FloatArray
    known: FloatArray


def misfits(snapshots: Snapshots, predict: Prediction, t: FloatArray) -> Misfits:
    """Return how well candidates in the lidar frame, shape (G, 3), explain every sensor.

    Parameters
    ----------
    snapshots
        Readings at common poses.
    predict
        The map.
    t
        Candidates in metres.
    """
    places = snapshots.places(t)
    field, inside = predict(places.reshape(-1, 3))
    inside = inside.reshape(places.shape[:2])
    b = np.einsum("kji,gkj->gki", snapshots.R_map_lidar, field.reshape(places.shape))
    has = np.asarray(np.isfinite(snapshots.field).all(axis=2))
    z = np.where(has[..., None], snapshots.field, 0.0)
    z = np.where(has[..., None], z - z.sum(axis=0) / np.maximum(has.sum(axis=0), 1)[:, None], 0.0)
    total = np.einsum("ksi,ksi->s", z, z)
    left = total - explained(b, inside, z, has)
    known = inside.astype(float) @ has / np.maximum(has.sum(axis=0), 1)
    return Misfits(np.maximum(left, 0.0), known)


def explained(b: FloatArray, inside: BoolArray, z: FloatArray, has: BoolArray) -> FloatArray:
    """Return the sum of squares that a regression on (1, b) takes from readings inside, (G, S).

    Parameters
    ----------
    b
        Predicted field in the lidar frame, shape (G, K, 3).
    inside
        Where it is known, shape (G, K).
    z, has
        Centred readings, shape (K, S, 3), zero where there are none, and where there are some.
    """
    count = np.maximum(inside.sum(axis=1), 1)
    mean = np.einsum("gki,gk->gi", b, inside.astype(float)) / count[:, None]
    ones = np.ones((*b.shape[:2], 1))
    regressors = np.concatenate([ones, b - mean[:, None]], axis=2) * inside[..., None]
    products = regressors[..., :, None] * regressors[..., None, :]
    gram = np.einsum("gkab,ks->gsab", products, has.astype(float), optimize=True)
    cross = np.einsum("gka,ksi->gsai", regressors, z, optimize=True)
    gram[..., range(4), range(4)] *= 1 + TIE
    gram[..., range(4), range(4)] += np.finfo(float).tiny
    solved = np.linalg.solve(gram, cross)
    return np.asarray(np.einsum("gsai,gsai->gs", cross, solved))


@dataclass(frozen=True)
class Linearisation:
    """What a sensor at a place leaves of its readings, and how that changes with the place.

    Attributes
    ----------
    residual
        uT, shape (3 K,).
    by_t
        Derivative by the place, distortion following it (Kaufman's approximation), shape (3 K, 3).
    """

    residual: FloatArray
    by_t: FloatArray

    def step(self) -> FloatArray:
        """Return the Gauss-Newton step in metres, shape (3,): shortest where it is not known."""
        return np.asarray(-np.linalg.lstsq(self.by_t, self.residual, rcond=1e-6)[0])


def linearised(
    field: FloatArray, gradient: FloatArray, R_map_lidar: FloatArray, z: FloatArray
) -> Linearisation:
    """Return the profile of one sensor's cost about a place.

    Parameters
    ----------
    field, gradient
        Of the map at the sensor's K places, uT (K, 3) and uT/m (K, 3, 3), in the map frame.
    R_map_lidar
        Shape (K, 3, 3).
    z
        Readings in uT, shape (K, 3).
    """
    b = np.einsum("kji,kj->ki", R_map_lidar, field)
    by_t = np.einsum("kja,kjl,kli->kai", R_map_lidar, gradient, R_map_lidar, optimize=True)
    regressors = np.column_stack([np.ones(len(b)), b - b.mean(axis=0)])
    Q, triangle = np.linalg.qr(regressors)
    # Where the field does not vary nothing follows from it: least squares of smallest norm.
    X = np.linalg.lstsq(triangle, Q.T @ z, rcond=np.sqrt(TIE))[0]
    change = np.einsum("kai,ac->kci", by_t, X[1:])
    outer = np.einsum("kq,kci->qci", Q, change)
    change -= np.einsum("kq,qci->kci", Q, outer)
    return Linearisation((z - regressors @ X).ravel(), -change.reshape(-1, 3))
