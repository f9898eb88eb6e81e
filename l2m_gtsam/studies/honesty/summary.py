"""What the honesty study finds: whether sigmas are true, and how near errors are to the bound."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from l2m_gtsam.data import FloatArray, joined_rows
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.studies.honesty.cells import OFFSET, HonestyCell, Outcomes
from l2m_gtsam.studies.honesty.drives import Condition, HonestyOptions
from l2m_gtsam.studies.statistics import (
    LEVEL,
    Band,
    chi_square_band,
    clustered_mean,
    ellipsoid_coverage,
    inside_interval,
    nees,
    wilson_interval,
)

AXES = ("x", "y", "z")
NAMES = (
    *(f"t {axis}" for axis in AXES),
    *(f"C {row}{column}" for row in AXES for column in AXES),
    *(f"H {axis}" for axis in AXES),
    "offset",
)
GROUPS = {"t": slice(0, 3), "C": slice(3, 12), "H": slice(12, 15), "offset": OFFSET}
"""Parameters of one unit."""
TARGET = 1.3  # root mean square error of t over the bound, at most
EDGES = np.linspace(-4.0, 4.0, 17)  # of the histograms of z-scores


@dataclass(frozen=True)
class Consistency:
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
    def consistent(self) -> bool:
        """Whether the mean NEES is in its band."""
        return self.nees in self.band

    @property
    def coverage_true(self) -> bool:
        """Whether the interval of the coverage holds 95 %."""
        return LEVEL in self.coverage_band

    def __str__(self) -> str:
        mark = "in" if self.consistent else "OUT of"
        return (
            f"NEES {self.nees:8.2f} +- {self.standard_error:<6.2f} {mark} {self.band!s:<10}"
            f" (independent: {self.narrow!s}),"
            f" 95 % ellipsoid holds {100 * self.coverage:5.1f} % ({self.coverage_band!s})"
        )


def consistency(outcomes: Outcomes, block: slice) -> Consistency:
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
    return Consistency(
        dof,
        mean.mean,
        mean.standard_error,
        chi_square_band(dof, mean.effective),
        chi_square_band(dof, len(values)),
        covered.mean,
        wilson_interval(covered.mean, covered.effective),
    )


@dataclass(frozen=True)
class BlockRow:
    """Whether the covariance of a block is true: t, (C, H), all of these, or the time offset."""

    name: str
    honesty: Consistency


@dataclass(frozen=True)
class ParameterRow:
    """Whether the sigma of one parameter is true.

    Attributes
    ----------
    z_std, z_band
        Root mean square of the z-scores, and where it must lie with 95 %; surveys being
        independent.
    covered, interval
        Share of the 95 % intervals that hold the truth, with Wilson's interval for the effective
        number of calibrations.
    """

    name: str
    z_std: float
    z_band: Band
    covered: float
    interval: Band

    @property
    def spread_true(self) -> bool:
        """Whether the spread of the z-scores is in its band."""
        return self.z_std in self.z_band

    @property
    def coverage_true(self) -> bool:
        """Whether the interval of the coverage holds 95 %."""
        return LEVEL in self.interval


@dataclass(frozen=True)
class BoundRow:
    """How near the errors of parameters of one unit are to the Cramer-Rao bound.

    Attributes
    ----------
    name
        t (m), C, H (uT) or offset (s).
    error, bound
        Root mean square over calibrations of the length of the error, and of what the bound says
        of it.
    ratio, interval
        Error over bound, with its 95 % interval; surveys being independent.
    """

    name: str
    error: float
    bound: float
    ratio: float
    interval: Band


@dataclass(frozen=True)
class Histogram:
    """Numbers of z-scores between ``EDGES``, those beyond counted at the ends."""

    name: str
    counts: tuple[int, ...]


@dataclass(frozen=True)
class ConsistencyVerdict:
    """One condition at one noise level, with one way to count the map's errors.

    Attributes
    ----------
    condition, noise, uncertainty
        What was judged; noise in uT.
    wanted, solved, determined
        Calibrations tried, with a result, and with t, C and H all determined, at the truth too:
        only these are judged, and none if they are of fewer than two surveys.
    blocks, parameters, bounds, histograms
        Of t, C, H, and the time offset where all calibrations know it.
    """

    condition: Condition
    noise: float
    uncertainty: Uncertainty
    wanted: int
    solved: int
    determined: int
    blocks: tuple[BlockRow, ...]
    parameters: tuple[ParameterRow, ...]
    bounds: tuple[BoundRow, ...]
    histograms: tuple[Histogram, ...]

    @property
    def consistent(self) -> bool:
        """Whether the NEES of every block is in its band."""
        return bool(self.blocks) and all(row.honesty.consistent for row in self.blocks)

    def sides(self) -> dict[str, list[BlockRow]]:
        """Return the blocks by where their NEES lies, in the words of the page."""
        sides = ("in band", "above it (sigmas too small)", "below it (sigmas too large)")
        found: dict[str, list[BlockRow]] = {side: [] for side in sides}
        for row in self.blocks:
            each = row.honesty
            found[sides[0 if each.consistent else 1 if each.nees > each.band.high else 2]].append(
                row
            )
        return found


@dataclass(frozen=True)
class HonestySummary:
    """The study's outcome: verdicts by condition and noise, full before independent."""

    options: HonestyOptions
    verdicts: tuple[ConsistencyVerdict, ...]

    def of(self, uncertainty: Uncertainty) -> tuple[ConsistencyVerdict, ...]:
        """Return the verdicts on one way to count the map's errors."""
        return tuple(each for each in self.verdicts if each.uncertainty is uncertainty)


def settings(options: HonestyOptions) -> tuple[tuple[Condition, float], ...]:
    """Return all conditions with their noise in uT, in the order of tables."""
    clean = product([Condition.CLEAN], options.noises)
    return (*clean, *product([Condition.TROUBLED], options.troubled_noises))


def honesty_summary(options: HonestyOptions, cells: Sequence[HonestyCell]) -> HonestySummary:
    """Return the verdicts on all cells."""
    verdicts = []
    for condition, noise in settings(options):
        own = [cell for cell in cells if (cell.condition, cell.noise) == (condition, noise)]
        verdicts += [verdict(own, uncertainty) for uncertainty in Uncertainty]
    return HonestySummary(options, tuple(verdicts))


def verdict(cells: Sequence[HonestyCell], uncertainty: Uncertainty) -> ConsistencyVerdict:
    """Return the verdict on the cells of one condition at one noise level."""
    outcomes = joined_rows([cell.outcomes(uncertainty) for cell in cells])
    bound = np.concatenate([cell.bound for cell in cells])
    rows = outcomes.determined_rows()
    # Where the solve had enough readings, and the truth a few less, there is no bound.
    rows = rows[np.isfinite(bound[rows, :15, :15]).all(axis=(1, 2))]
    judged, bound = outcomes[rows], bound[rows]
    names = tuple(judged.blocks) if judged.enough else ()
    groups = [g for g in GROUPS if names and (g != "offset" or g in names)]
    return ConsistencyVerdict(
        condition=cells[0].condition,
        noise=cells[0].noise,
        uncertainty=uncertainty,
        wanted=len(outcomes),
        solved=len(outcomes.solved()),
        determined=len(judged),
        blocks=tuple(BlockRow(n, consistency(judged, judged.blocks[n])) for n in names),
        parameters=tuple(row for g in groups for row in parameter_rows(judged, GROUPS[g])),
        bounds=tuple(
            bound_row(g, judged, bound)
            for g in groups
            if np.isfinite(bound[:, GROUPS[g], GROUPS[g]]).all()
        ),
        histograms=tuple(histogram(g, judged) for g in groups),
    )


def parameter_rows(outcomes: Outcomes, at: slice) -> Iterator[ParameterRow]:
    """Yield whether the sigma of each of some parameters is true."""
    for name, z in zip(NAMES[at], standard_scores(outcomes, at).T, strict=True):
        # z^2 is chi-square of one degree of freedom where sigma is true.
        square = clustered_mean(z**2, outcomes.survey)
        band = chi_square_band(1, square.effective)
        held = clustered_mean(inside_interval(z), outcomes.survey)
        yield ParameterRow(
            name=name,
            z_std=float(np.sqrt(square.mean)),
            z_band=Band(float(np.sqrt(band.low)), float(np.sqrt(band.high))),
            covered=held.mean,
            interval=wilson_interval(held.mean, held.effective),
        )


def bound_row(name: str, outcomes: Outcomes, bound: FloatArray) -> BoundRow:
    """Return how near the errors of some parameters are to their bounds, shape (N, 16, 16)."""
    at = GROUPS[name]
    square = clustered_mean(np.sum(outcomes.error[:, at] ** 2, axis=1), outcomes.survey)
    least = float(np.sqrt(np.trace(bound[:, at, at], axis1=1, axis2=2).mean()))
    error, sure = float(np.sqrt(square.mean)), square.band()
    # The band is of the mean square; with few surveys it may reach below zero.
    interval = Band(float(np.sqrt(max(sure.low, 0.0))) / least, float(np.sqrt(sure.high)) / least)
    return BoundRow(name, error, least, error / least, interval)


def histogram(name: str, outcomes: Outcomes) -> Histogram:
    """Return how often z-scores of some parameters lie where."""
    z = standard_scores(outcomes, GROUPS[name]).clip(EDGES[0], EDGES[-1])
    counts, _ = np.histogram(z, EDGES)
    return Histogram(name, tuple(counts.tolist()))


def standard_scores(outcomes: Outcomes, at: slice) -> FloatArray:
    """Return errors over their sigmas, shape (N, K)."""
    variance = np.diagonal(outcomes.covariance, axis1=1, axis2=2)[:, at]
    return np.asarray(outcomes.error[:, at] / np.sqrt(variance))
