r"""Changes of a calibration, tested on readings that it did not see: a likelihood ratio.

With the innovation e = z - (C b + H), white under the noise of sensor, map and poses, and J its
derivatives by the sixteen parameters,

.. math::
    e = J (\varepsilon + \delta) + n, \quad \varepsilon \sim N(0, P), \quad n \sim N(0, I)

P is the covariance that the calibration states, delta what has changed since. Errors of the map,
shared by readings near each other, errors of the poses, shared by readings near each other in
time, and fields of recorded numbers are weights with a prior, as in the solve; QR takes them out,
and epsilon, too. The squared length of what remains is the normalised innovation squared. Parts of
delta are tested by how much of that they explain (chi-square of as many degrees of freedom as the
part has) and named one after the other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from l2m_factors import M, P, U
from l2m_factors.shared_errors import whitened
from l2m_gtsam.calibration.coverage import Coverage, NothingShared, UncertainMap, cover
from l2m_gtsam.calibration.factor_graph import Estimate, batch_readings
from l2m_gtsam.calibration.group_noise import group_noise
from l2m_gtsam.calibration.pose_errors import pose_features
from l2m_gtsam.calibration.view import QueryableMap, observe
from l2m_gtsam.data import FloatArray, Readings, joined_rows
from l2m_gtsam.qa.metrics.changes import MISSED
from l2m_gtsam.qa.metrics.coordinates import COLUMNS, columns_of, width
from l2m_gtsam.records.validation import CalibrationPart
from l2m_gtsam.solve.chi_square import chance_beyond, noticed_sigmas

ROWS = 4000  # that are reduced at once
UNOBSERVABLE = 1e-9  # of the best observed direction of a part: zero but for rounding
OPEN_SIGMAS = 30.0  # of the largest useful ones: a parameter that a calibration leaves open


@dataclass(frozen=True)
class ChangeLikelihood:
    """Minus twice the log-likelihood of a change x of parameters: ``|white - root x|^2 + rest``.

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
    def of(cls, rows: FloatArray) -> "ChangeLikelihood":
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
        # The projection of the white innovation on the columns' range: what least squares removes.
        Q, s, _ = np.linalg.svd(self.root[:, columns], full_matrices=False)
        seen = Q[:, s > 1e-9 * max(float(s[0]), 1e-300)].T @ self.white
        return float(seen @ seen)

    def estimate(self, columns: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Return the values of parameters that explain most, and their covariance."""
        own = self.root[:, columns]
        inverse = np.linalg.pinv(own, rcond=1e-12)
        return np.asarray(inverse @ self.white), np.asarray(inverse @ inverse.T)

    def recentred(self, by: FloatArray) -> "ChangeLikelihood":
        """Return the same of parameters that count from elsewhere: x + ``by``."""
        return ChangeLikelihood(self.root, self.white + self.root @ by, self.rest)


def reduced(rows: FloatArray) -> FloatArray:
    """Return the square triangular matrix with the same inner products of columns."""
    triangular = np.asarray(np.linalg.qr(rows, mode="r"))
    square = np.zeros((rows.shape[1], rows.shape[1]))
    square[: len(triangular)] = triangular
    return square


@dataclass(frozen=True)
class KnownCalibration:
    """A sensor as a calibration has it.

    Attributes
    ----------
    vector
        t in metres, C row by row, H in uT, time offset in seconds, shape (16,).
    noise
        Standard deviation of its noise in uT.
    number_sigma
        Standard deviations of the fields of K recorded numbers that were taken off the readings,
        in uT per unit, shape (K, 3).
    """

    vector: FloatArray
    noise: float
    number_sigma: FloatArray

    @property
    def C(self) -> FloatArray:
        """Distortion matrix, shape (3, 3)."""
        return self.vector[3:12].reshape(3, 3)

    def estimate(self) -> Estimate:
        """Return it as an estimate of a single sensor."""
        return estimate_of([self])


def estimate_of(known: Sequence[KnownCalibration]) -> Estimate:
    """Return sensors as a solve has them."""
    vectors = np.array([each.vector for each in known])
    noise, ridge = np.array([each.noise for each in known]), np.zeros(len(known))
    return Estimate(vectors[:, :3], vectors[:, 3:15], noise, ridge, vectors[:, 15])


def knows_its_errors(field_map: QueryableMap) -> bool:
    """Return whether a map states how its errors are correlated."""
    return isinstance(field_map, UncertainMap)


def held_poses(readings: Readings) -> FloatArray:
    """Return that poses are where they are, shape (N, 6, 0)."""
    return np.zeros((len(readings), 6, 0))


def change_likelihood(
    parts: Sequence[Readings],
    field_map: QueryableMap,
    known: Sequence[KnownCalibration],
    correlation_s: float,
    displaced: Callable[[Readings], FloatArray] = held_poses,
    map_errors: float = 1.0,
) -> ChangeLikelihood:
    """Return the likelihood of changes of the known parameters of sensors.

    Errors of the map and of the poses are those of all of them together.

    Parameters
    ----------
    parts
        Readings of each of S sensors, all inside the map, with their poses at the known time
        offset; what follows recorded numbers is taken off.
    known
        Their calibrations, whose own errors do not count here.
    correlation_s
        How long an error of a pose lasts, seconds.
    displaced
        What Q displacements of all poses together do to each of N: right perturbations per unit,
        radians before metres, shape (N, 6, Q).
    map_errors
        How many times as large as it states the map's errors count.

    Returns
    -------
    ChangeLikelihood
        Of a change of (t, C row by row, H, time offset) sensor by sensor, then of such
        displacements.
    """
    readings = together(parts)
    estimate = estimate_of(known)
    view = observe(readings, field_map, estimate, 1)
    errors = field_map if isinstance(field_map, UncertainMap) else NothingShared()
    coverage = cover(view, errors, estimate, correlation_s).with_larger_errors(map_errors)
    noise = group_noise(view, field_map, coverage, estimate)
    J, e = _linearised(view.readings, field_map, estimate, displaced)
    by_number = _number_errors(view.readings, np.concatenate([each.number_sigma for each in known]))
    C, at = estimate.C(), coverage.columns
    shared = sum(coverage.sizes.values())
    numbers = slice(shared, shared + by_number.shape[2])
    width = numbers.stop + J.shape[2] + 1
    collected = _SequentialQR(width, prior_rows(coverage, width, numbers))
    for group, own, W in zip(coverage.groups, noise.errors, noise.whitenings, strict=True):
        rows = np.zeros((3 * len(group.rows), width))
        for each in own:
            rows[:, at[each.key]] += whitened(W, C[group.sensor] @ each.features)
        rows[:, numbers] = whitened(W, by_number[group.rows])
        rows[:, numbers.stop : -1] = whitened(W, J[group.rows])
        rows[:, -1:] = whitened(W, e[group.rows, :, None])
        collected.add(rows)
    return ChangeLikelihood.of(collected.root()[numbers.stop :, numbers.stop :])


def together(parts: Sequence[Readings]) -> Readings:
    """Return readings of single sensors as those of all, each with its own recorded numbers."""
    sensor = np.repeat(np.arange(len(parts)), [len(each) for each in parts])
    names = tuple(each.sensors[0] for each in parts)
    none = (np.empty((len(each), 0)) for each in parts)
    numbers = [
        empty if each.regressors is None else each.regressors
        for each, empty in zip(parts, none, strict=True)
    ]
    joined = joined_rows([replace(each, sensors=names, regressors=None) for each in parts])
    return replace(joined, sensor=sensor, regressors=block_diag(*numbers))


class _SequentialQR:
    """Rows of a least-squares problem, reduced as they come: memory stays bounded."""

    def __init__(self, width: int, first: FloatArray) -> None:
        self._width, self._parts, self._count = width, [first], len(first)

    def add(self, rows: FloatArray) -> None:
        self._parts.append(rows)
        self._count += len(rows)
        if self._count > max(ROWS, 3 * self._width):
            self._parts = [self.root()]
            self._count = self._width

    def root(self) -> FloatArray:
        return reduced(np.concatenate(self._parts))


def prior_rows(coverage: Coverage, width: int, numbers: slice) -> FloatArray:
    """Return white rows of what is known of the weights, shape (K, width)."""
    at = coverage.columns
    tiles = np.concatenate([np.arange(at[M(t)].start, at[M(t)].stop) for t in coverage.tiles])
    rows = np.zeros((numbers.stop, width))
    rows[: len(tiles), tiles] = coverage.root_information
    rows[numbers, numbers] = np.eye(numbers.stop - numbers.start)
    if len(coverage.spread):
        common = at[U()]
        rows[common, common] = np.diag(1 / coverage.spread)
    if coverage.knots is not None:
        # Errors of poses are a first-order Gauss-Markov process from knot to knot:
        # x_k = like x_(k-1) + sqrt(1 - like^2) w_k with white w_k.
        first = at[P(0)]
        size = first.stop - first.start
        rows[first, first] = np.eye(size)
        for knot, like in enumerate(coverage.knots.correlation, start=1):
            own = 1 / np.sqrt(1 - like**2)
            before, this = at[P(knot - 1)], at[P(knot)]
            rows[this, this], rows[this, before] = own * np.eye(size), -like * own * np.eye(size)
    return rows


def _linearised(
    readings: Readings,
    field_map: QueryableMap,
    estimate: Estimate,
    displaced: Callable[[Readings], FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives of predicted readings, (N, 3, 16 S + Q), and innovations, uT, (N, 3)."""
    batch, sensors = batch_readings(readings, field_map), len(estimate.t)
    found = batch.residuals(estimate.values(batch.sensors), batch.sensors[0])
    own = np.concatenate(batch.jacobians(found), axis=2)
    by_sensor = np.zeros((*own.shape[:2], sensors, own.shape[2]))
    by_sensor[np.arange(len(own)), :, readings.sensor] = own
    by_pose = pose_features(displaced(readings), found.b_lidar, found.slope, found.t_lidar_mag)
    J = [by_sensor.reshape(*own.shape[:2], -1), found.C @ by_pose]
    return np.concatenate(J, axis=2), -found.residual


def _number_errors(readings: Readings, sigma: FloatArray) -> FloatArray:
    """Return what a sigma of each number's field does to readings in uT, shape (N, 3, 3 K)."""
    if readings.regressors is None or not sigma.size:
        return np.zeros((len(readings), 3, 0))
    features = np.einsum("nk,ki,ij->nikj", readings.regressors, sigma, np.eye(3))
    return np.asarray(features.reshape(len(readings), 3, -1))


def marginalise_calibration(
    likelihood: ChangeLikelihood, covariance: FloatArray, basis: FloatArray
) -> ChangeLikelihood:
    """Return the likelihood of a change with the calibration's own errors marginalised.

    Parameters
    ----------
    likelihood
        Of t, C row by row, H and the time offset of S sensors, and of what else there is.
    covariance
        Of their calibrations, shape (16 S, 16 S), finite.
    basis
        Change of all these per unit of each of Q coordinates of a change, shape (P, Q).
    """
    # epsilon = root u with u ~ N(0, I): rows for u and the change, then the prior of u; what QR
    # leaves below u is the marginal likelihood of the change (Bierman 1977, ch. 5).
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    count, above = len(root), len(likelihood.root)
    rows = np.zeros((above + count, count + basis.shape[1] + 1))
    rows[:above, :count] = likelihood.root[:, :count] @ root
    rows[:above, count:-1] = likelihood.root @ basis
    rows[:above, -1] = likelihood.white
    rows[above:, :count] = np.eye(count)
    left = reduced(rows)[count:, count:]
    found = ChangeLikelihood.of(left)
    return ChangeLikelihood(found.root, found.white, found.rest + likelihood.rest)


def parts_changed(
    likelihood: ChangeLikelihood, freedom: int, chance: float
) -> tuple[CalibrationPart, ...]:
    """Return the parts that have changed, the plainest first.

    At each step the part that explains most is added, each of its degrees of freedom costing the
    logarithm of the number of readings' values (as in the BIC), as long as chance would do as
    much less often than in ``chance`` of all drives.

    Parameters
    ----------
    likelihood
        Of the coordinates of ``COLUMNS``.
    freedom
        Number of values read.
    chance
        For all parts together.
    """
    named: list[CalibrationPart] = []
    left = [part for part in COLUMNS if is_observable(likelihood, part)]
    price = np.log(max(freedom, 3))  # of a degree of freedom (Schwarz 1978)
    while left:
        before = likelihood.explained(columns_of(named))
        gains = [likelihood.explained(columns_of([*named, part])) - before for part in left]
        sizes = [width(part) for part in left]
        scores = [gain - size * price for gain, size in zip(gains, sizes, strict=True)]
        best = int(np.argmax(scores))
        if chance_beyond(gains[best], sizes[best]) >= chance / len(COLUMNS):
            break
        named.append(left.pop(best))
    return tuple(named)


def is_observable(likelihood: ChangeLikelihood, part: CalibrationPart) -> bool:
    """Return whether readings depend on a part at all."""
    return bool(np.linalg.norm(likelihood.root[:, COLUMNS[part]], axis=0).all())


def detectable_change(likelihood: ChangeLikelihood, part: CalibrationPart, chance: float) -> float:
    """Return the smallest change of a part by itself that `parts_changed` shows; maybe infinite."""
    own = likelihood.root[:, COLUMNS[part]]
    values = np.linalg.svd(own, compute_uv=False)
    sigmas = noticed_sigmas(own.shape[1], chance / len(COLUMNS), MISSED)
    return float(sigmas / values[-1]) if values[-1] > UNOBSERVABLE * values[0] else float("inf")
