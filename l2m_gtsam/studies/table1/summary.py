"""Statistics of all drives of Table I, and the paper's Table I as printed."""

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate.route import RouteShape
from l2m_gtsam.studies.table1.cells import Ends, Table1Cell, Table1Options
from l2m_gtsam.studies.table1.methods import HARMONIC, OURS

Metric = Literal["t", "C", "H"]
METRICS: dict[Metric, str] = {"t": "e_t (m^2)", "C": "e_C", "H": "e_H (uT^2)"}
BETTER = 10  # our mean of e_t is to be at most the paper's over this
FAR = 0.05  # metres: an error beyond counts as a failure


@dataclass(frozen=True)
class Printed:
    """One entry of the table: of e_t and e_H squared norms, of e_C the Frobenius norm.

    Attributes
    ----------
    mean, std
        Over 2,500 calibrations; of e_t in m^2, of e_H in uT^2.
    """

    mean: float
    std: float


NOISES = (0.1, 0.2, 0.5)
"""Its columns in microtesla."""

# One line per path: three means, then three standard deviations.
_E_T = (
    (0.0018, 0.0037, 0.0058, 0.0009, 0.0014, 0.0030),
    (0.0031, 0.0029, 0.0076, 0.0007, 0.0016, 0.0053),
    (0.0039, 0.0021, 0.0034, 0.0005, 0.0012, 0.0018),
    (0.0025, 0.0017, 0.0048, 0.0012, 0.0014, 0.0039),
    (0.0049, 0.0045, 0.0062, 0.0008, 0.0010, 0.0020),
)
_E_C = (
    (0.0018, 0.0055, 0.0289, 0.0010, 0.0089, 0.0885),
    (0.0029, 0.0080, 0.0427, 0.0069, 0.0235, 0.1331),
    (0.0016, 0.0047, 0.0276, 0.0023, 0.0136, 0.0886),
    (0.0028, 0.0070, 0.0378, 0.0066, 0.0215, 0.1154),
    (0.0028, 0.0070, 0.0368, 0.0047, 0.0205, 0.1218),
)
_E_H = (
    (0.0751, 0.1400, 0.2623, 0.0156, 0.0468, 0.5669),
    (0.0508, 0.0979, 0.5559, 0.0485, 0.1658, 0.9575),
    (0.0300, 0.0622, 0.2541, 0.0164, 0.0812, 0.5643),
    (0.0398, 0.0748, 0.4048, 0.0378, 0.1296, 0.7131),
    (0.0673, 0.0923, 0.3307, 0.0163, 0.1111, 0.7460),
)
PATHS = len(_E_T)


def printed(metric: Metric, path: int, noise: float) -> Printed | None:
    """Return an entry of the table; None where it has none.

    Parameters
    ----------
    metric
        ``t``, ``C`` or ``H``.
    path
        Counted from 0.
    noise
        In microtesla.
    """
    lines = {"t": _E_T, "C": _E_C, "H": _E_H}[metric]
    if noise not in NOISES or path >= PATHS:
        return None
    column = NOISES.index(noise)
    return Printed(lines[path][column], lines[path][column + len(NOISES)])


@dataclass(frozen=True)
class ErrorStatistics:
    """Figures of a set of errors, of those calibrations that have a result."""

    mean: float
    std: float
    median: float
    p95: float
    max: float

    @classmethod
    def of(cls, values: FloatArray) -> "ErrorStatistics | None":
        """Return the figures of the finite values; None if there are none."""
        finite = values[np.isfinite(values)]
        if not len(finite):
            return None
        return cls(
            float(np.mean(finite)),
            float(np.std(finite)),
            float(np.median(finite)),
            float(np.percentile(finite, 95)),
            float(np.max(finite)),
        )


@dataclass(frozen=True)
class MethodErrors:
    """One method on one map over all drives of one path, or of all, at one noise level.

    Attributes
    ----------
    method, map_kind, path, noise
        Which; no path means all of them together.
    calibrations, lost, far
        Tried, without a result, and with one beyond 5 cm.
    t, t2, C, H, H2
        Errors plain (m, Frobenius, uT) and squared; None if all are lost.
    seconds
        Of one core for each calibration.
    """

    method: str
    map_kind: str
    path: RouteShape | None
    noise: float
    calibrations: int
    lost: int
    far: int
    t: ErrorStatistics | None
    t2: ErrorStatistics | None
    C: ErrorStatistics | None
    H: ErrorStatistics | None
    H2: ErrorStatistics | None
    seconds: float

    def as_printed(self, metric: Metric) -> ErrorStatistics | None:
        """Return the errors as the paper defines them: t and H squared."""
        return {"t": self.t2, "C": self.C, "H": self.H2}[metric]


@dataclass(frozen=True)
class Bound:
    """The Cramer-Rao bound on the drives of one path at one noise level.

    Attributes
    ----------
    path, noise, drives
        Which, and how many of them.
    readings
        Of a drive, mean.
    t, C, H
        Root mean square over drives of the bound of the norm, in m, Frobenius, uT.
    t_error, C_error, H_error
        Root mean square of our errors on the same drives, each start counted.
    """

    path: RouteShape
    noise: float
    drives: int
    readings: float
    t: float
    C: float
    H: float
    t_error: float
    C_error: float
    H_error: float

    def least_mean(self, metric: Metric) -> float:
        """Return the bound of the metric's mean.

        That of a squared norm is the trace itself. The mean of a norm is below the root of its
        square's; of a norm that one direction dominates, sqrt(2 / pi) of it.
        """
        return {"t": self.t**2, "C": math.sqrt(2 / math.pi) * self.C, "H": self.H**2}[metric]


@dataclass(frozen=True)
class Shortfall:
    """A mean error that is above its aim.

    Attributes
    ----------
    metric, row, noise
        Which entry of the paper's table; noise in microtesla.
    mean, aim, least
        Ours, the aim, and the bound of the mean, in the unit of the metric.
    """

    metric: Metric
    row: int
    noise: float
    mean: float
    aim: float
    least: float

    @property
    def forbidden(self) -> bool:
        """Whether the bound is above the aim."""
        return self.least > self.aim


@dataclass(frozen=True)
class Efficiency:
    """How far our root-mean-square error of t is above the bound at one noise level."""

    noise: float
    error: float
    bound: float

    @property
    def ratio(self) -> float:
        """Error over bound."""
        return self.error / self.bound


@dataclass(frozen=True)
class Table1Summary:
    """The outcome.

    Attributes
    ----------
    entries
        All methods, maps, paths and noise levels.
    together
        All methods, maps and noise levels, over all paths.
    bounds
        Of all paths and noise levels.
    efficiency
        Of all noise levels.
    solves
        That our full method computed for its calibrations: starts from which it finds the same
        place share one.
    """

    options: Table1Options
    entries: tuple[MethodErrors, ...]
    together: tuple[MethodErrors, ...]
    bounds: tuple[Bound, ...]
    efficiency: tuple[Efficiency, ...]
    solves: int

    def entry(self, path: RouteShape, noise: float, method: str, map_kind: str) -> MethodErrors:
        """Return the errors of one method on one map."""
        wanted = (method, map_kind, path, noise)
        return next(e for e in self.entries if (e.method, e.map_kind, e.path, e.noise) == wanted)

    def shortfalls(self) -> Iterator[Shortfall]:
        """Yield what is above its aim, in the order of the paper's table."""
        for metric in METRICS:
            for row, path in enumerate(self.options.paths):
                for noise in self.options.noises:
                    ours = self.entry(path, noise, OURS, HARMONIC).as_printed(metric)
                    theirs = printed(metric, row, noise)
                    if ours is None or theirs is None:
                        continue
                    aim = theirs.mean / (BETTER if metric == "t" else 1)
                    if ours.mean > aim:
                        bound = next(b for b in self.bounds if (b.path, b.noise) == (path, noise))
                        least = bound.least_mean(metric)
                        yield Shortfall(metric, row, noise, ours.mean, aim, least)


def summarise(options: Table1Options, cells: Mapping[str, Table1Cell]) -> Table1Summary:
    """Return the statistics of all cells."""
    paths: dict[tuple[float, RouteShape], list[Table1Cell]] = defaultdict(list)
    levels: dict[float, list[Table1Cell]] = defaultdict(list)
    for cell in cells.values():
        paths[cell.noise, cell.path].append(cell)
        levels[cell.noise].append(cell)
    bounds = [bound_of(group) for group in paths.values()]
    return Table1Summary(
        options,
        tuple(entry for (_, path), group in paths.items() for entry in entries_of(group, path)),
        tuple(entry for group in levels.values() for entry in entries_of(group, None)),
        tuple(bounds),
        tuple(efficiency([bound for bound in bounds if bound.noise == level]) for level in levels),
        sum(cell.places for cell in cells.values()),
    )


def entries_of(cells: Sequence[Table1Cell], path: RouteShape | None) -> list[MethodErrors]:
    """Return an entry for each method on each map; the cells are of one noise."""
    ends: dict[tuple[str, str], list[Ends]] = defaultdict(list)
    for cell in cells:
        for each in cell.ends:
            ends[each.method, each.map_kind].append(each)
    return [entry_of(group, path, cells[0].noise) for group in ends.values()]


def entry_of(ends: Sequence[Ends], path: RouteShape | None, noise: float) -> MethodErrors:
    """Return the figures of one method on one map."""
    t, C, H = (np.concatenate(each) for each in zip(*((e.t, e.C, e.H) for e in ends), strict=True))
    return MethodErrors(
        method=ends[0].method,
        map_kind=ends[0].map_kind,
        path=path,
        noise=noise,
        calibrations=len(t),
        lost=int(np.count_nonzero(~np.isfinite(H))),  # which every method has an answer for
        far=int(np.count_nonzero(t > FAR)),
        t=ErrorStatistics.of(t),
        t2=ErrorStatistics.of(t**2),
        C=ErrorStatistics.of(C),
        H=ErrorStatistics.of(H),
        H2=ErrorStatistics.of(H**2),
        seconds=float(np.mean([each.seconds for each in ends])),
    )


def bound_of(cells: Sequence[Table1Cell]) -> Bound:
    """Return the bound of the drives that have one, and our errors on these."""
    bounded = [cell for cell in cells if len(cell.bound)]
    bounds = rms(cell.bound for cell in bounded)
    errors = rms(np.column_stack(our_errors(cell)) for cell in bounded)
    return Bound(
        cells[0].path,
        cells[0].noise,
        len(bounded),
        float(np.mean([cell.readings for cell in cells])),
        *(float(value) for value in (*bounds, *errors)),
    )


def our_errors(cell: Table1Cell) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the errors of t, C and H of our method on our map, each of shape (N,)."""
    ours = next(each for each in cell.ends if (each.method, each.map_kind) == (OURS, HARMONIC))
    return ours.t, ours.C, ours.H


def rms(rows: Iterable[FloatArray]) -> FloatArray:
    """Return the root mean square over all rows of three values, lost ones left out."""
    return np.asarray(np.sqrt(np.nanmean(np.vstack(list(rows)) ** 2, axis=0)))


def efficiency(bounds: Sequence[Bound]) -> Efficiency:
    """Return error and bound of t over all drives of a noise level."""
    drives = np.array([bound.drives for bound in bounds])
    # Mean squares of paths add up with their numbers of drives; roots would not.
    error, bound = (
        float(np.sqrt(np.average(np.square(values), weights=drives)))
        for values in ([each.t_error for each in bounds], [each.t for each in bounds])
    )
    return Efficiency(bounds[0].noise, error, bound)
