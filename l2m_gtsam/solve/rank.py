"""What the data determine and what they do not: the rank test before any covariance."""

from dataclasses import dataclass, field, replace

import numpy as np
from pydantic import Field
from scipy.linalg import null_space, qr, solve_triangular

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.options import Options
from l2m_gtsam.solve.linear_algebra import triangular_rows

PARAMETERS = (
    *("t_x", "t_y", "t_z"),
    *(f"C_{row}{column}" for row in "xyz" for column in "xyz"),
    *("H_x", "H_y", "H_z"),
)


class RankOptions(Options):
    """When a direction counts as determined: its sigma, with nothing else known, is below these."""

    useful_t_m: float = Field(default=0.3, gt=0)
    """Metres."""
    useful_C: float = Field(default=0.3, gt=0)
    """Entries of C, without unit."""
    useful_H_ut: float = Field(default=15.0, gt=0)
    """Microtesla."""
    useful_offset_s: float = Field(default=0.02, gt=0)
    """Seconds. A time offset that is known less is held where it is, instead of leaving open with
    it the position along the drive."""

    def scale(self) -> FloatArray:
        """Return the largest useful sigma of each parameter, shape (15,)."""
        parts = np.repeat([self.useful_t_m, self.useful_C, self.useful_H_ut], [3, 9, 3])
        return np.asarray(parts, dtype=float)


@dataclass(frozen=True)
class Determinacy:
    """Which directions of (t, C row by row, H) a set of readings determines.

    Attributes
    ----------
    held
        Rows over the parameters that span what is not determined, shape (K, 15): a prior of unit
        variance on each holds it.
    directions
        The same space in units of the useful sigmas, shape (K, 15): each row has one parameter to
        itself.
    names
        One name per row of ``directions``: the parameters that take part in it.
    touched
        Parameters that take part in an undetermined direction, shape (15,).
    offset
        Whether the time offset is observable beside all of these; if not it is held, and they are
        judged as if it were known.
    imitation
        How t and C row by row would have to change to look like an unobservable time offset,
        per second of it, shape (12,).
    borrowed
        By name the parameters that the readings leave open and priors do not, with what is known
        beforehand that decides.
    leaning
        The same for parameters that the readings determine, but priors far better.
    lent
        Number of directions that priors determine and the readings do not.
    """

    held: FloatArray
    directions: FloatArray
    names: tuple[str, ...]
    touched: BoolArray
    offset: bool = False
    imitation: FloatArray = field(default_factory=lambda: np.zeros(12))
    borrowed: dict[str, str] = field(default_factory=dict)
    leaning: dict[str, str] = field(default_factory=dict)
    lent: int = 0

    @property
    def place_open(self) -> bool:
        """Whether all of t takes part in what is not determined, as in a uniform field."""
        return bool(self.touched[:3].all())

    @property
    def determined(self) -> FloatArray:
        """Orthonormal rows that span what is determined, in useful sigmas, shape (15 - K, 15)."""
        count = len(self.touched)
        if not len(self.directions):
            return np.eye(count)
        return np.asarray(null_space(self.directions).T)

    @property
    def free(self) -> int:
        """Number of directions that the readings determine."""
        return len(self.touched) - len(self.held) + self.offset - self.lent


def timed_determinacy(jacobian: FloatArray, options: RankOptions) -> Determinacy:
    """Test the rank of a whitened Jacobian with the time offset in it.

    The offset is observable if its sigma, with all other parameters known no better than is of
    use, is itself of use. Then the others are tested with it unknown, and else with it known.

    Parameters
    ----------
    jacobian
        Derivatives of whitened residuals by the 15 parameters and the time offset in seconds,
        shape (M, 16).
    options
        Largest useful sigmas of t (m), C, H (uT) and the offset (s).
    """
    jacobian = triangular_rows(jacobian)  # same J^T J in 16 rows
    scaled = jacobian * np.append(options.scale(), options.useful_offset_s)
    # A step of one of the 15 counts as one standard deviation of what is known without readings.
    others = np.vstack([scaled, np.eye(15, 16)])
    triangular = triangular_rows(others)
    # The last diagonal entry of R is the length of the offset's column beside all others, hence one
    # over its sigma (in useful ones) with the others marginalised.
    if abs(triangular[-1, -1]) < 1.0:
        # Regression of the offset's column on the others: the step of these that it looks like.
        like = solve_triangular(triangular[:15, :15], triangular[:15, 15])
        imitation = (options.scale() * like / options.useful_offset_s)[:12]
        return replace(determinacy(jacobian[:, :15], options), imitation=imitation)
    # Schur complement of the offset: J^T J of the others with the offset marginalised.
    by_offset = jacobian[:, 15] / np.linalg.norm(jacobian[:, 15])
    apart = jacobian[:, :15] - np.outer(by_offset, by_offset @ jacobian[:, :15])
    return replace(determinacy(apart, options), offset=True)


def determinacy(jacobian: FloatArray, options: RankOptions) -> Determinacy:
    """Test the rank of a whitened Jacobian.

    Columns are scaled so that a step of one is the largest sigma of use; a singular value s then
    means a sigma of 1/s along its direction, and s < 1 an undetermined one.

    Parameters
    ----------
    jacobian
        Derivatives of whitened residuals by the 15 parameters, shape (M, 15).
    options
        Largest useful sigmas of t (m), C, H (uT) and the offset (s).
    """
    # In units of useful sigmas a singular value below one is a direction with a sigma above the
    # useful one; QR instead of J^T J, which would square the condition number.
    triangular = triangular_rows(jacobian * options.scale())
    square = np.zeros((15, 15))
    square[: len(triangular)] = triangular
    _, s, Vt = np.linalg.svd(square)
    weak = Vt[s < 1.0]
    simple = _simple_basis(weak)
    names = tuple(_name(row) for row in simple)
    touched = np.sum(weak**2, axis=0) > 1e-4  # a share of one per cent in length
    # Stiff enough to be factorised beside the best determined direction.
    stiffness = max(1.0, 1e-5 * float(s[0]))
    return Determinacy(stiffness * weak / options.scale(), simple, names, touched)


def _simple_basis(rows: FloatArray) -> FloatArray:
    """Return a basis of the same space in which each row has one parameter to itself."""
    if not len(rows):
        return rows
    # Pivoting picks the parameters that the space moves most, so that the solve is well
    # conditioned.
    _, triangular, order = qr(rows, mode="economic", pivoting=True)
    basis = np.empty_like(rows)
    basis[:, order] = np.linalg.solve(triangular[:, : len(rows)], triangular)
    return basis


def members(row: FloatArray) -> IntArray:
    """Return which of the 15 parameters take part in a direction."""
    return np.flatnonzero(np.abs(row) > 0.2 * np.abs(row).max())


def _name(row: FloatArray) -> str:
    return " with ".join(PARAMETERS[i] for i in members(row))
