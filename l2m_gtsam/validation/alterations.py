r"""Which part of a calibration is no longer right, told by readings that it did not see.

With the innovation e = z - (C b + H), white under the noise of sensor, map and poses, and J its
derivatives by the sixteen parameters,

.. math::
    e = J (\varepsilon + \delta) + n, \quad \varepsilon \sim N(0, P), \quad n \sim N(0, I)

P is the covariance that the calibration states, delta what has changed since. One QR takes
epsilon out; the squared length of what remains is the normalised innovation squared. Parts of
delta are tested by how much of that they explain (a likelihood ratio, chi-square of as many
degrees of freedom as the part has) and named one after the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.validation import Part
from l2m_gtsam.solve.chi_square import chance_beyond

PARAMETERS = 16  # t, C row by row, H, time offset
COLUMNS = {
    Part.PLACE: slice(0, 3),
    Part.ROTATION: slice(3, 6),
    Part.GAINS: slice(6, 9),
    Part.ANGLES: slice(9, 12),
    Part.OFFSET: slice(12, 15),
    Part.CLOCK: slice(15, 16),
}
PAIRS = ((0, 1), (1, 2), (2, 0))
UNTOLD = 1e-9  # of the best told direction of a part: zero but for rounding
OPEN_SIGMAS = 30.0  # of the largest useful ones: a parameter that a calibration leaves open


@dataclass(frozen=True)
class Told:
    """What white readings tell of parameters x, as ``|white - root x|^2 + rest``.

    Attributes
    ----------
    root
        Triangular, shape (P, P).
    white
        Shape (P,).
    rest
        What no parameters explain.
    """

    root: FloatArray
    white: FloatArray
    rest: float

    @classmethod
    def of(cls, rows: FloatArray) -> "Told":
        """Reduce white rows of parameters and, in the last column, of the innovation."""
        square = reduced(rows)
        return cls(square[:-1, :-1], square[:-1, -1], float(square[-1, -1] ** 2))

    @property
    def squared(self) -> float:
        """Squared length of the innovation with all parameters zero."""
        return float(self.white @ self.white) + self.rest

    def explained(self, columns: Sequence[int]) -> float:
        """Return how much less that is with these parameters free."""
        if not columns:
            return 0.0
        Q, s, _ = np.linalg.svd(self.root[:, columns], full_matrices=False)
        seen = Q[:, s > 1e-9 * max(float(s[0]), 1e-300)].T @ self.white
        return float(seen @ seen)

    def estimate(self, columns: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Return the values of parameters that explain most, and their covariance."""
        own = self.root[:, columns]
        inverse = np.linalg.pinv(own, rcond=1e-12)
        return np.asarray(inverse @ self.white), np.asarray(inverse @ inverse.T)

    def moved(self, by: FloatArray) -> "Told":
        """Return the same about parameters that count from elsewhere: x + ``by``."""
        return Told(self.root, self.white + self.root @ by, self.rest)


def reduced(rows: FloatArray) -> FloatArray:
    """Return the square triangular matrix with the same inner products of columns."""
    triangular = np.asarray(np.linalg.qr(rows, mode="r"))
    square = np.zeros((rows.shape[1], rows.shape[1]))
    square[: len(triangular)] = triangular
    return square


def against_calibration(told: Told, covariance: FloatArray, basis: FloatArray) -> Told:
    """Return what readings tell of a change, with the calibration's own errors counted.

    Parameters
    ----------
    told
        Of t, C row by row, H and the time offset.
    covariance
        Of the calibration, shape (16, 16), finite.
    basis
        Change of these per unit of each of Q coordinates of a change, shape (16, Q).
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    count = len(root)
    rows = np.zeros((2 * count, count + basis.shape[1] + 1))
    rows[:count, :count] = told.root @ root
    rows[:count, count:-1] = told.root @ basis
    rows[:count, -1] = told.white
    rows[count:, :count] = np.eye(count)
    left = reduced(rows)[count:, count:]
    found = Told.of(left)
    return Told(found.root, found.white, found.rest + told.rest)


def changes_of(C: FloatArray) -> FloatArray:
    """Return what a change of each part does to (t, C row by row, H, time offset), (16, 16).

    Columns are those of ``COLUMNS``: metres; degrees by which the sensor turns about its own axes,
    R_lidar_mag to R_lidar_mag exp(d), so that field vectors turn the other way in it and C becomes
    exp(-d) C; relative gains; degrees by which the angles x y, y z, z x between axes become
    smaller; microtesla; seconds.
    """
    basis = np.zeros((PARAMETERS, PARAMETERS))
    basis[:3, COLUMNS[Part.PLACE]] = np.eye(3)
    basis[12:15, COLUMNS[Part.OFFSET]] = np.eye(3)
    basis[15:, COLUMNS[Part.CLOCK]] = 1.0
    degree = np.deg2rad(1.0)
    for k, (i, j) in enumerate(PAIRS):
        turn, skew, gain = np.zeros((3, 3, 3))
        # about the axis that completes the pair: -[d]x, what a sensor that turns by d reads
        turn[j, i], turn[i, j] = -degree, degree
        skew[i, j] = skew[j, i] = degree / 2
        gain[k, k] = 1.0
        axis = 3 - i - j
        for part, column, A in (
            (Part.ROTATION, axis, turn),
            (Part.ANGLES, k, skew),
            (Part.GAINS, k, gain),
        ):
            basis[3:12, COLUMNS[part].start + column] = (A @ C).ravel()
    return basis


def parts_changed(told: Told, freedom: int, chance: float) -> tuple[Part, ...]:
    """Return the parts that have changed, the plainest first.

    At each step the part that explains most is added, each of its degrees of freedom costing the
    logarithm of the number of readings' values (as in the BIC), as long as chance would do as
    much less often than in ``chance`` of all drives.

    Parameters
    ----------
    told
        Of the coordinates of ``COLUMNS``.
    freedom
        Number of values read.
    chance
        For all parts together.
    """
    named: list[Part] = []
    left = [part for part in COLUMNS if is_told(told, part)]
    price = np.log(max(freedom, 3))
    while left:
        before = told.explained(columns_of(named))
        gains = [told.explained(columns_of([*named, part])) - before for part in left]
        sizes = [width(part) for part in left]
        scores = [gain - size * price for gain, size in zip(gains, sizes, strict=True)]
        best = int(np.argmax(scores))
        if chance_beyond(gains[best], sizes[best]) >= chance / len(COLUMNS):
            break
        named.append(left.pop(best))
    return tuple(named)


def columns_of(parts: Sequence[Part]) -> list[int]:
    """Return the columns of parts, in their order."""
    return [k for part in parts for k in range(COLUMNS[part].start, COLUMNS[part].stop)]


def width(part: Part) -> int:
    """Return the number of coordinates of a part."""
    return COLUMNS[part].stop - COLUMNS[part].start


def is_told(told: Told, part: Part) -> bool:
    """Return whether readings depend on a part at all."""
    return bool(np.linalg.norm(told.root[:, COLUMNS[part]], axis=0).all())


def noticeable(told: Told, part: Part, sigmas: float) -> float:
    """Return the largest standard deviation of a part by itself, so many times; maybe infinite."""
    own = told.root[:, COLUMNS[part]]
    values = np.linalg.svd(own, compute_uv=False)
    return float(sigmas / values[-1]) if values[-1] > UNTOLD * values[0] else float("inf")
