"""What all drives of Table I say together."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate.route import RouteShape
from l2m_gtsam.studies.table1.cells import Ends, Table1Cell, Table1Options
from l2m_gtsam.studies.table1.methods import HARMONIC, OURS

FAR = 0.05  # metres: an error beyond counts as a failure


@dataclass(frozen=True)
class Spread:
    """Figures of a set of errors, of those calibrations that have a result."""

    mean: float
    std: float
    median: float
    p95: float
    max: float

    @classmethod
    def of(cls, values: FloatArray) -> "Spread":
        """Return the figures of finite values, at least one."""
        return cls(
            float(np.mean(values)),
            float(np.std(values)),
            float(np.median(values)),
            float(np.percentile(values, 95)),
            float(np.max(values)),
        )


@dataclass(frozen=True)
class Entry:
    """One method on one map over all drives of one path, or of all, at one noise level.

    Attributes
    ----------
    method, map_kind, path, noise
        Which; no path stands for all of them together.
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
    t: Spread | None
    t2: Spread | None
    C: Spread | None
    H: Spread | None
    H2: Spread | None
    seconds: float


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
    options
        The study.
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
    entries: tuple[Entry, ...]
    together: tuple[Entry, ...]
    bounds: tuple[Bound, ...]
    efficiency: tuple[Efficiency, ...]
    solves: int

    def entry(self, method: str, map_kind: str, path: RouteShape, noise: float) -> Entry:
        """Return one entry."""
        wanted = (method, map_kind, path, noise)
        return next(
            each
            for each in self.entries
            if (each.method, each.map_kind, each.path, each.noise) == wanted
        )


def summarise(options: Table1Options, cells: Mapping[str, Table1Cell]) -> Table1Summary:
    """Return what all cells say together."""
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


def entries_of(cells: Sequence[Table1Cell], path: RouteShape | None) -> list[Entry]:
    """Return an entry for each method on each map; the cells are of one noise."""
    ends: dict[tuple[str, str], list[Ends]] = defaultdict(list)
    for cell in cells:
        for each in cell.ends:
            ends[each.method, each.map_kind].append(each)
    return [entry_of(group, path, cells[0].noise) for group in ends.values()]


def entry_of(ends: Sequence[Ends], path: RouteShape | None, noise: float) -> Entry:
    """Return the figures of one method on one map."""
    t, C, H = (np.concatenate(each) for each in zip(*((e.t, e.C, e.H) for e in ends), strict=True))
    return Entry(
        method=ends[0].method,
        map_kind=ends[0].map_kind,
        path=path,
        noise=noise,
        calibrations=len(t),
        lost=int(np.count_nonzero(~np.isfinite(H))),  # which every method has an answer for
        far=int(np.count_nonzero(t > FAR)),
        t=spread(t),
        t2=spread(t**2),
        C=spread(C),
        H=spread(H),
        H2=spread(H**2),
        seconds=float(np.mean([each.seconds for each in ends])),
    )


def spread(values: FloatArray) -> Spread | None:
    """Return the figures of the finite values; None if there are none."""
    finite = values[np.isfinite(values)]
    return Spread.of(finite) if len(finite) else None


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
    error, bound = (
        float(np.sqrt(np.average(np.square(values), weights=drives)))
        for values in ([each.t_error for each in bounds], [each.t for each in bounds])
    )
    return Efficiency(bounds[0].noise, error, bound)
