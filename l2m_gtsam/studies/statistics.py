"""Whether stated uncertainties are true: z-scores, coverage, NEES, and the bands they must be in.

Errors of calibrations on one survey are not independent, because they share its map. Every band
here therefore comes in a form that takes only surveys for independent.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm, t

from l2m_gtsam.data import FloatArray, IntArray

LEVEL = 0.95


@dataclass(frozen=True)
class Band:
    """An interval that holds a figure with a stated probability."""

    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return f"{self.low:.3g}-{self.high:.3g}"


@dataclass(frozen=True)
class ClusteredMean:
    """A mean over groups of values that are alike within each group.

    Attributes
    ----------
    mean
        Over all values.
    standard_error
        Of the mean, from the spread of the groups alone.
    effective
        How many independent values would leave the mean as unsure as it is: between the number
        of groups and the number of values.
    """

    mean: float
    standard_error: float
    effective: float
    groups: int

    def band(self) -> Band:
        """Return Student's 95 % interval of the true mean."""
        reach = float(t.ppf(0.5 + LEVEL / 2, self.groups - 1)) * self.standard_error
        return Band(self.mean - reach, self.mean + reach)


def inside_interval(z: FloatArray) -> FloatArray:
    """Return which z-scores of any shape lie within the central 95 % interval, 0 or 1."""
    return np.asarray(np.abs(z) <= norm.ppf(0.5 + LEVEL / 2), dtype=np.float64)


def nees(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return e' inv(P) e of errors (N, K) with their covariances (N, K, K), shape (N,).

    Its expectation is K where the covariances are true.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a covariance is not positive definite.
    """
    # Metres, ratios and microtesla in one matrix: scaled to correlations before factorising.
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    correlation = covariances / (sigma[:, :, None] * sigma[:, None, :])
    # With P = L L', e' inv(P) e is the squared length of inv(L) e (Bar-Shalom, Li, Kirubarajan,
    # Estimation with Applications to Tracking and Navigation, 2001, section 5.4).
    white = np.linalg.solve(np.linalg.cholesky(correlation), (errors / sigma)[..., None])
    return np.asarray(np.sum(white[..., 0] ** 2, axis=1))


def chi_square_band(dof: int, count: float, level: float = LEVEL) -> Band:
    """Return where the mean of ``count`` independent NEES of ``dof`` dimensions must lie.

    ``count`` need not be whole: see ``ClusteredMean.effective``.
    """
    # The sum of independent chi-square variables is one with the sum of their degrees of freedom.
    low, high = (float(chi2.ppf(p, dof * count)) for p in (0.5 - level / 2, 0.5 + level / 2))
    return Band(low / count, high / count)


def ellipsoid_coverage(values: FloatArray, dof: int) -> FloatArray:
    """Return which NEES of ``dof`` dimensions lie within the 95 % ellipsoid, 0 or 1."""
    return (values <= chi2.ppf(LEVEL, dof)).astype(np.float64)


def wilson_interval(share: float, count: float, level: float = LEVEL) -> Band:
    """Return Wilson's score interval of a probability of which ``share`` of ``count`` came true.

    E. B. Wilson, J. Am. Stat. Assoc. 22:209, 1927.
    """
    z2 = float(norm.ppf(0.5 + level / 2)) ** 2 / count
    middle = (share + z2 / 2) / (1 + z2)
    reach = np.sqrt(share * (1 - share) * z2 + z2**2 / 4) / (1 + z2)
    return Band(float(middle - reach), float(middle + reach))


def clustered_mean(values: FloatArray, groups: IntArray) -> ClusteredMean:
    """Return the mean of values (N,) of which only different groups (N,) are independent.

    The standard error is that of a ratio of sums over groups (cluster-robust), with the usual
    correction G / (G - 1); groups may differ in size.

    Raises
    ------
    ValueError
        If there are fewer than two groups.
    """
    _, group = np.unique(groups, return_inverse=True)
    count, number = len(values), int(group.max()) + 1
    if number < 2:
        raise ValueError("one group does not show how groups differ; two or more are needed")
    mean = float(np.mean(values))
    # Liang and Zeger, Biometrika 73:13, 1986: residuals are summed within groups before they are
    # squared, so that what a group has in common is not averaged away.
    sums = np.bincount(group, values - mean)
    variance = float(sums @ sums) / count**2 * number / (number - 1)
    # Kish's design effect: the variance of one value over that of the mean.
    alone = float(np.var(values, ddof=1))
    effective = alone / variance if variance > 0 else float(count)
    # The estimate is rough with few groups; it cannot lie beyond what sharing makes possible.
    effective = float(np.clip(effective, number, count))
    return ClusteredMean(mean, float(np.sqrt(variance)), effective, number)


@dataclass(frozen=True)
class Share:
    """A number of successes among independent trials."""

    successes: int
    trials: int

    @property
    def rate(self) -> float:
        """Successes per trial."""
        return self.successes / self.trials

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the probability."""
        band = wilson_interval(self.rate, self.trials)
        return band.low, band.high


def in_percent(
    shares: Sequence[float], intervals: Sequence[tuple[float, float]]
) -> tuple[FloatArray, FloatArray]:
    """Return N shares, and how far their intervals reach below and above them, (N,) and (2, N)."""
    share = 100 * np.array(shares)
    low, high = 100 * np.array(intervals).reshape(-1, 2).T
    # Rounding may put the end of an interval a hair on the wrong side of the share.
    return share, np.maximum([share - low, high - share], 0.0)


def mean_of(values: Sequence[float | None]) -> float | None:
    """Return the mean of what is stated; None of nothing."""
    stated = [each for each in values if each is not None]
    return float(np.mean(stated)) if stated else None


def rms_of(values: Sequence[float | None]) -> float | None:
    """Return the root mean square of what is stated; None of nothing."""
    square = mean_of([None if each is None else each**2 for each in values])
    return None if square is None else square**0.5
