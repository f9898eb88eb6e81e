"""Errors of calibrations with the covariances stated for them, and whether these are true."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.studies.statistics import (
    Band,
    chi_square_band,
    clustered_mean,
    ellipsoid_coverage,
    nees,
    wilson_interval,
)

OFFSET = slice(15, 16)
BLOCKS = {"t": slice(0, 3), "C, H": slice(3, 15), "all": slice(0, 15)}


@dataclass(frozen=True)
class Outcomes:
    """What came of N calibrations.

    Attributes
    ----------
    error
        Estimate minus truth of t in metres, C row by row, H in uT and time offset in seconds,
        NaN where there is none, shape (N, 16).
    covariance
        As the calibrations say, not finite for what is undetermined, shape (N, 16, 16).
    survey
        Number of the survey of each, shape (N,).
    """

    error: FloatArray
    covariance: FloatArray
    survey: IntArray

    def __len__(self) -> int:
        return len(self.survey)

    @classmethod
    def joined(cls, parts: "Sequence[Outcomes]") -> Self:
        """Return the outcomes of all parts."""
        return cls(
            np.concatenate([part.error for part in parts]),
            np.concatenate([part.covariance for part in parts]),
            np.concatenate([part.survey for part in parts]),
        )

    def solved(self) -> "Outcomes":
        """Return those that have a result."""
        return self[np.flatnonzero(np.isfinite(self.error).all(axis=1))]

    def determined_rows(self) -> IntArray:
        """Return the rows of those of which t, C and H have a result and a finite variance."""
        finite = np.isfinite(self.covariance[:, :15, :15]).all(axis=(1, 2))
        return np.flatnonzero(finite & np.isfinite(self.error).all(axis=1))

    def determined(self) -> "Outcomes":
        """Return those of which t, C and H have a result and a finite variance."""
        return self[self.determined_rows()]

    @property
    def blocks(self) -> dict[str, slice]:
        """Parameters to judge together by name; the time offset where all of these know it."""
        timed = len(self) > 0 and bool(np.isfinite(self.covariance[:, OFFSET, OFFSET]).all())
        return BLOCKS | ({"offset": OFFSET} if timed else {})

    @property
    def enough(self) -> bool:
        """Whether these are of more than one survey."""
        return len(np.unique(self.survey)) > 1

    def __getitem__(self, rows: IntArray) -> "Outcomes":
        return Outcomes(self.error[rows], self.covariance[rows], self.survey[rows])


@dataclass(frozen=True)
class Honesty:
    """Whether the covariance of some parameters is true.

    Attributes
    ----------
    dof
        Number of the parameters: what the NEES is expected to be.
    nees
        Mean over all calibrations.
    standard_error
        Of that mean, surveys being independent.
    band
        Of chi-square, for as many independent calibrations as leave the mean equally unsure.
    narrow
        Of chi-square, had no two calibrations anything in common.
    coverage, coverage_band
        Of the 95 % ellipsoid, with Wilson's interval for the effective number.
    """

    dof: int
    nees: float
    standard_error: float
    band: Band
    narrow: Band
    coverage: float
    coverage_band: Band

    @property
    def honest(self) -> bool:
        """Whether the mean NEES is in its band."""
        return self.nees in self.band

    def __str__(self) -> str:
        mark = "in" if self.honest else "OUT of"
        return (
            f"NEES {self.nees:8.2f} +- {self.standard_error:<6.2f} {mark} {self.band!s:<10}"
            f" (independent: {self.narrow!s}),"
            f" 95 % ellipsoid holds {100 * self.coverage:5.1f} % ({self.coverage_band!s})"
        )


def honesty(outcomes: Outcomes, block: slice) -> Honesty:
    """Return whether the covariances of a block of the parameters are true.

    Raises
    ------
    ValueError
        If the outcomes are of fewer than two surveys.
    """
    dof = block.stop - block.start
    values = nees(outcomes.error[:, block], outcomes.covariance[:, block, block])
    mean = clustered_mean(values, outcomes.survey)
    covered = clustered_mean(ellipsoid_coverage(values, dof), outcomes.survey)
    return Honesty(
        dof,
        mean.mean,
        mean.standard_error,
        chi_square_band(dof, mean.effective),
        chi_square_band(dof, len(values)),
        covered.mean,
        wilson_interval(covered.mean, covered.effective),
    )
