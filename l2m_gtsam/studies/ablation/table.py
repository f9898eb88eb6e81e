"""What came of the ablation study: errors of each combination, and paired differences."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.studies.ablation.cells import AblationCell, AblationOptions, BatchErrors, Solver
from l2m_gtsam.studies.ablation.map_image import MapImage

SURE = 1.96  # standard errors on each side of a mean that hold 95 %
ROUNDING = 1e-6  # metres or microtesla; what differs by less is the same
FEWEST = 2  # pairs that determine a standard error
FAR_M, FAR_UT = 0.5, 5.0
"""An error of t or H beyond is none of noise and map, but another minimum."""


@dataclass(frozen=True)
class ErrorQuantiles:
    """Where the errors of some calibrations lie, in the unit of these errors."""

    mean: float
    p05: float
    p25: float
    median: float
    p75: float
    p95: float
    largest: float


@dataclass(frozen=True)
class Combination:
    """Calibrations by one method on one map.

    Attributes
    ----------
    calibrations, failed, far
        How many there are, how many of them ended without a result, and how many far off.
    t, C, H
        Errors in metres, without unit, and in microtesla; absent if all failed.
    """

    kind: str
    spacing: float
    solver: Solver
    calibrations: int
    failed: int
    far: int
    t: ErrorQuantiles | None
    C: ErrorQuantiles | None
    H: ErrorQuantiles | None


@dataclass(frozen=True)
class PairedDifference:
    """By how much errors shrink from one combination to another on the same drives.

    Attributes
    ----------
    mean
        Mean of the paired differences; positive where the other is better.
    margin
        Half of its 95 % interval.
    better
        Share of the drives on which the other is better.
    """

    mean: float
    margin: float
    better: float

    @property
    def sure(self) -> bool:
        """Whether the interval leaves out zero, by more than rounding."""
        return abs(self.mean) > max(self.margin, ROUNDING)

    @property
    def smaller(self) -> bool:
        """Whether errors clearly shrink."""
        return self.sure and self.mean > 0

    @property
    def larger(self) -> bool:
        """Whether errors clearly grow."""
        return self.sure and self.mean < 0


@dataclass(frozen=True)
class Comparison:
    """What changing one thing gains; see ``PairedDifference``.

    Attributes
    ----------
    kind, spacing, solver
        The combination from which a thing is changed.
    to
        What the map's kind or the method is changed to.
    t, H
        Gains in metres and microtesla; absent if there are no pairs.
    """

    kind: str
    spacing: float
    solver: Solver
    to: str
    t: PairedDifference | None
    H: PairedDifference | None


@dataclass(frozen=True)
class MapRow:
    """A map of the study."""

    kind: str
    spacing: float
    picture: MapImage


@dataclass(frozen=True)
class AblationTable:
    """The study's outcome.

    Attributes
    ----------
    maps
        By density, then kind.
    rows
        In the same order, then by method.
    map_gains
        From the first kind of map to each other one, with the paper's method.
    weight_gains
        From no weights to each kind of weights, on each map.
    method_gains
        From the paper's method to ours, on each map.
    """

    options: AblationOptions
    maps: tuple[MapRow, ...]
    rows: tuple[Combination, ...]
    map_gains: tuple[Comparison, ...]
    weight_gains: tuple[Comparison, ...]
    method_gains: tuple[Comparison, ...]


MapKey = tuple[str, float]
"""Kind and spacing of a map."""


def ablation_table(
    options: AblationOptions, cells: Mapping[MapKey, Sequence[AblationCell]]
) -> AblationTable:
    """Return errors and gains of all cells, given by map."""
    places = [(kind, spacing) for spacing in options.spacings for kind in options.kinds]
    errors = {place: joined(cells[place]) for place in places}
    pictures = {p: next(c.picture for c in cells[p] if c.picture is not None) for p in places}
    first, paper = options.kinds[0], Solver.PAPER
    return AblationTable(
        options=options,
        maps=tuple(MapRow(*place, pictures[place]) for place in places),
        rows=tuple(combination(p, solver, errors[p]) for p in places for solver in Solver),
        map_gains=tuple(
            compared((first, spacing), paper, errors, (kind, spacing), paper)
            for spacing in options.spacings
            for kind in options.kinds[1:]
        ),
        weight_gains=tuple(
            compared(place, Solver.RRTLS, errors, place, to)
            for place in places
            for to in (Solver.PAPER, Solver.LIKELIHOOD)
        ),
        method_gains=tuple(compared(p, paper, errors, p, Solver.ONE_KEY) for p in places),
    )


def joined(cells: Sequence[AblationCell]) -> BatchErrors:
    """Return all calibrations of one map."""
    batches = [each.batch for each in cells if each.batch is not None]
    return BatchErrors(*(np.concatenate([getattr(b, name) for b in batches]) for name in "tCH"))


def combination(place: MapKey, solver: Solver, errors: BatchErrors) -> Combination:
    """Return the errors of one method on one map."""
    t, C, H = (of(errors, name, solver) for name in "tCH")
    failed = int(np.count_nonzero(~np.isfinite(t)))
    far = int(np.count_nonzero((t > FAR_M) | (H > FAR_UT)))
    return Combination(*place, solver, len(t), failed, far, spread(t), spread(C), spread(H))


def of(errors: BatchErrors, name: str, solver: Solver) -> FloatArray:
    """Return the errors of t, C or H by one method, shape (R,)."""
    column: FloatArray = getattr(errors, name)[:, list(Solver).index(solver)]
    return column


def spread(errors: FloatArray) -> ErrorQuantiles | None:
    """Return where errors, shape (R,), lie; those that are NaN do not count."""
    known = errors[np.isfinite(errors)]
    if not len(known):
        return None
    p05, p25, median, p75, p95 = np.quantile(known, [0.05, 0.25, 0.5, 0.75, 0.95]).tolist()
    return ErrorQuantiles(float(known.mean()), p05, p25, median, p75, p95, float(known.max()))


def compared(
    place: MapKey, solver: Solver, errors: Mapping[MapKey, BatchErrors], other: MapKey, to: Solver
) -> Comparison:
    """Return what one combination gains over another."""
    before, after = errors[place], errors[other]
    changed = other[0] if to is solver else to.value
    gains = (gain(of(before, name, solver), of(after, name, to)) for name in "tH")
    return Comparison(*place, solver, changed, *gains)


def gain(before: FloatArray, after: FloatArray) -> PairedDifference | None:
    """Return by how much errors shrank, shapes (R,); pairs with a NaN do not count."""
    # Paired: both calibrate the same drives, so that what a drive is worth cancels.
    less = before - after
    less = less[np.isfinite(less)]
    if len(less) < FEWEST:
        return None
    margin = SURE * less.std(ddof=1) / np.sqrt(len(less))
    return PairedDifference(float(less.mean()), float(margin), float(np.mean(less > ROUNDING)))
