r"""How well sensors at candidate places explain their readings, whatever their distortion.

With C and H eliminated in closed form the cost of a candidate t is what a linear regression of the
readings on the predicted field leaves,

.. math::
    \min_{C, H} \sum_k | C R_k^T B(R_k t + p_k) + H - z_k |^2 .

All sensors are regressed on the same predictions: the map is evaluated once for all of them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from l2m_gtsam.data import BoolArray, FloatArray, Readings

# Between two readings of a sensor its value is interpolated if the lidar moved no further.
MOST_STEP = 0.3  # metres
MOST_TURN = 0.3  # radians, of the rotation's Frobenius distance over sqrt(2)
# Normal equations hold half of the digits: what follows from the rest only is not regressed on.
TIE = 1e-10
TINY = 1e-300
REGRESSORS = 4  # a one and the field
CONCENTRATIONS = 4  # fits, each on the readings that the one before explains best

# Sums in any order and fused products: loops over readings run in vector registers.
FAST = {"reassoc", "contract", "nsz"}

FieldPredictor = Callable[[FloatArray], tuple[FloatArray, BoolArray]]
"""Field in uT at points (N, 3) in metres, shape (N, 3), and whether it is known, shape (N,)."""


@dataclass(frozen=True)
class Snapshots:
    """What all S sensors read at K common poses.

    Attributes
    ----------
    R_map_lidar
        Rotations from lidar to map, shape (K, 3, 3).
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

    They are NaN where the sensor read nothing near, in time or place, or not in the same drive.
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
    # A value between two drives was never read.
    near &= (a.of_drive == at.of_drive) & (b.of_drive == at.of_drive)
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
    rms
        Root mean square per axis in uT of each of G candidates and S sensors, over the readings
        that are explained best, shape (G, S). Where the map does not know the field a candidate
        explains nothing but the mean.
    known
        Share of each sensor's readings that lie inside the map, shape (G, S).
    """

    rms: FloatArray
    known: FloatArray


def misfits(
    snapshots: Snapshots, predict: FieldPredictor, t: FloatArray, good: float = 1.0
) -> Misfits:
    """Return how well candidates in the lidar frame, shape (G, 3), explain every sensor.

    Least trimmed squares by concentration (P. J. Rousseeuw, K. Van Driessen, "Computing LTS
    regression for large data sets", 2006): readings that are wrong, up to a share, do not count.

    Parameters
    ----------
    snapshots
        Readings in uT of all sensors at common poses.
    predict
        Map: field in uT and whether inside, of positions (N, 3) in metres.
    t
        Candidate positions in the lidar frame in metres, shape (G, 3).
    good
        Share of the readings that counts.
    """
    places = snapshots.places(t)
    field, inside = predict(places.reshape(-1, 3))
    inside = inside.reshape(places.shape[:2])
    b = np.einsum("kji,gkj->gki", snapshots.R_map_lidar, field.reshape(places.shape))
    has = np.asarray(np.isfinite(snapshots.field).all(axis=2).T)
    z = (snapshots.field - middle(snapshots.field)).transpose(1, 2, 0)
    rms = np.empty((len(t), len(z)))
    write_trimmed(
        np.ascontiguousarray(b.transpose(0, 2, 1)),
        inside.astype(float),
        np.where(has[:, None], z, 0.0),
        has.astype(float),
        good,
        rms,
    )
    known = inside.astype(float) @ has.T / np.maximum(has.sum(axis=1), 1)
    return Misfits(rms, known)


def middle(field: FloatArray) -> FloatArray:
    """Return the median of each sensor's readings in uT, shape (S, 3); 0 where there are none."""
    ordered = np.sort(field, axis=0)  # what is missing comes last
    count = np.isfinite(field).sum(axis=0)
    rows = np.maximum(count - 1, 0) // 2
    return np.where(count > 0, np.take_along_axis(ordered, rows[None], axis=0)[0], 0.0)


@njit(cache=True, nogil=True)
def write_trimmed(
    b: FloatArray, inside: FloatArray, z: FloatArray, has: FloatArray, good: float, rms: FloatArray
) -> None:
    """Write what regressions on (1, b) leave of the readings that they explain best.

    Parameters
    ----------
    b
        Predicted field in the lidar frame, shape (G, 3, K).
    inside
        1 where it is known and 0 elsewhere, shape (G, K).
    z, has
        Readings about their middle, shape (S, 3, K), and 1 where there are some, shape (S, K).
    good
        Share of the readings that counts.
    rms
        Root mean square of what is left, shape (G, S).
    """
    K = z.shape[2]
    regressors, used, left, pool = np.empty((REGRESSORS, K)), np.empty(K), np.empty(K), np.empty(K)
    gram, X = np.empty((REGRESSORS, REGRESSORS)), np.empty((REGRESSORS, 3))
    # Sums and products of whole arrays would take five times as long to compile.
    for g in range(len(b)):
        write_regressors(b[g], inside[g], regressors)
        for s in range(len(z)):
            count = 0.0
            for k in range(K):
                used[k] = inside[g, k] * has[s, k]
                count += has[s, k]
            kept, total = int(np.ceil(good * count)), 0.0
            for _ in range(CONCENTRATIONS if kept < count else 1):
                write_fit(regressors, z[s], used, gram, X)
                write_left(regressors, z[s], inside[g], X, left)
                limit = least(left, has[s], kept, pool)
                total = 0.0
                for k in range(K):
                    chosen = has[s, k] * (left[k] <= limit)
                    used[k] = inside[g, k] * chosen
                    total += left[k] * chosen
            rms[g, s] = np.sqrt(total / max(3 * kept, 1))


@njit(cache=True, nogil=True, fastmath=FAST)
def write_regressors(b: FloatArray, inside: FloatArray, regressors: FloatArray) -> None:
    """Write ones and the field, shape (3, K), about its mean inside the map, shape (4, K)."""
    count = 0.0
    for k in range(len(inside)):
        regressors[0, k] = 1.0
        count += inside[k]
    for i in range(3):
        total = 0.0
        for k in range(len(inside)):
            total += b[i, k] * inside[k]
        mean = total / max(count, 1.0)
        for k in range(len(inside)):
            regressors[1 + i, k] = b[i, k] - mean


@njit(cache=True, nogil=True, fastmath=FAST)
def write_fit(
    regressors: FloatArray, z: FloatArray, used: FloatArray, gram: FloatArray, X: FloatArray
) -> None:
    """Write the regression, shape (4, 3), of the readings (3, K) that are used, by Cholesky."""
    for i in range(REGRESSORS):
        for j in range(i + 1):
            total = 0.0
            for k in range(len(used)):
                total += used[k] * regressors[i, k] * regressors[j, k]
            gram[i, j] = total
        for c in range(3):
            total = 0.0
            for k in range(len(used)):
                total += used[k] * regressors[i, k] * z[c, k]
            X[i, c] = total
        gram[i, i] += TIE * gram[i, i] + TINY
    solve_in_place(gram, X)


# Not the mode of a fast kernel that calls it, which it has where it is compiled for that one.
@njit(cache=True, nogil=True, fastmath=False)
def solve_in_place(gram: FloatArray, X: FloatArray) -> None:
    """Replace X, shape (n, 3), by the solution; of ``gram`` the lower half, by Cholesky."""
    n = len(gram)
    for i in range(n):
        for j in range(i + 1):
            total = gram[i, j]
            for k in range(j):
                total -= gram[i, k] * gram[j, k]
            # Rounding may leave less than nothing of a column that follows from the others.
            gram[i, j] = np.sqrt(max(total, TINY)) if i == j else total / gram[j, j]
    for c in range(X.shape[1]):
        for i in range(n):
            for k in range(i):
                X[i, c] -= gram[i, k] * X[k, c]
            X[i, c] /= gram[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                X[i, c] -= gram[k, i] * X[k, c]
            X[i, c] /= gram[i, i]


@njit(cache=True, nogil=True, fastmath=FAST)
def write_left(
    regressors: FloatArray, z: FloatArray, inside: FloatArray, X: FloatArray, left: FloatArray
) -> None:
    """Write the squared length of what is left of each reading, all of it outside the map."""
    left[:] = 0.0
    for c in range(3):
        for k in range(len(left)):
            explained = 0.0
            for i in range(REGRESSORS):
                explained += regressors[i, k] * X[i, c]
            e = z[c, k] - inside[k] * explained
            left[k] += e * e


@njit(cache=True, nogil=True)
def least(values: FloatArray, has: FloatArray, rank: int, pool: FloatArray) -> float:
    """Return the value of a rank, counted from 1, among those that there are (Hoare's select)."""
    count = 0
    for k in range(len(values)):
        if has[k] > 0:
            pool[count] = values[k]
            count += 1
    if not 0 < rank <= count:
        return np.inf
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = pool[rank - 1], low, high
        while i <= j:
            while pool[i] < pivot:
                i += 1
            while pool[j] > pivot:
                j -= 1
            if i <= j:
                pool[i], pool[j] = pool[j], pool[i]
                i += 1
                j -= 1
        if j < rank - 1:
            low = i
        if i > rank - 1:
            high = j
    return float(pool[rank - 1])


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
        Rotations from lidar to map, shape (K, 3, 3).
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
