r"""What makes the residuals of several readings white where errors are common to them.

With W for the noise of each reading and A for the common errors in units of it, residuals have the
covariance ``I + A A^T`` after W. Its inverse root is ``I - B B^T``, with as many columns as there
are common errors that say more than nothing: from ``A^T A = V diag(l) V^T``

.. math::
    B = A V \, \mathrm{diag}\left(\sqrt{(1 - 1 / \sqrt{1 + l}) / l}\right)
"""

from dataclasses import dataclass

import numpy as np

from l2m_factors.arguments import numbers
from l2m_factors.field_map import FloatArray

NOTHING = 1e-3  # of a variance: a smaller part of it changes no sigma noticeably


@dataclass(frozen=True)
class Whitening:
    """A matrix ``(I - B B^T) W`` that makes the residuals of n readings white with unit variance.

    Attributes
    ----------
    own
        Blocks of W, for the noise of each reading alone, in 1/uT, shape (n, 3, 3).
    common
        B, for what errs for several readings alike, shape (3 n, r).
    """

    own: FloatArray
    common: FloatArray

    @classmethod
    def independent(cls, own: FloatArray) -> "Whitening":
        """Return that of readings without common errors, from blocks of shape (n, 3, 3)."""
        return cls(own, np.empty((3 * len(own), 0)))

    @classmethod
    def with_errors(cls, own: FloatArray, errors: FloatArray) -> "Whitening":
        """Return that of readings whose residuals depend on common errors, too.

        Parameters
        ----------
        own
            For the noise of each reading alone, in 1/uT, shape (n, 3, 3).
        errors
            What each error adds to the residuals in one standard deviation, uT, shape (n, 3, q).
        """
        A = (own @ errors).reshape(3 * len(own), -1)
        values, vectors = np.linalg.eigh(A.T @ A)
        informative = values > NOTHING
        values, vectors = values[informative], vectors[:, informative]
        return cls(own, A @ (vectors * np.sqrt((1 - 1 / np.sqrt(1 + values)) / values)))

    @property
    def log_determinant(self) -> float:
        """Of the matrix, so that densities of white residuals become those of residuals in uT."""
        left = np.eye(self.common.shape[1]) - self.common.T @ self.common
        return float(np.linalg.slogdet(self.own)[1].sum() + np.linalg.slogdet(left)[1])

    def checked(self, count: int) -> "Whitening":
        """Return a copy for so many readings that is nobody else's.

        Raises
        ------
        ValueError
            It is of another number of readings, or has a number that is not finite.
        """
        r = np.shape(self.common)[-1:]
        return Whitening(
            numbers("Whitening.own", self.own, (count, 3, 3)),
            numbers("Whitening.common", self.common, (3 * count, *r)),
        )

    def __call__(self, block: FloatArray) -> FloatArray:
        """Return residuals or derivatives of n readings, (n, 3, k), white and in rows, (3 n, k)."""
        rows = (self.own @ block).reshape(3 * len(block), -1)
        if self.common.shape[1]:
            rows = rows - self.common @ (self.common.T @ rows)
        return np.asarray(rows)
