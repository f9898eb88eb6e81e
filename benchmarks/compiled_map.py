"""The compiled harmonic map beside the exact one and the sliding Gaussian process.

Two surveys: an open floor over dipoles, where there are only floor and ceiling modes, and a hall
with strong posts and a rack that a LiDAR saw, where hundreds of sources stand beside the lanes.
All maps answer the same places, up to half a metre from the readings, in the same run. Set
OPENBLAS_NUM_THREADS=1: the compiled map uses two threads of its own.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.map_queries import survey, warehouse, within
from benchmarks.timing import seconds
from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.maps.harmonic.harmonic_map import CompiledMap, HarmonicMap
from l2m_gtsam.maps.sliding_gp import SlidingGP
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.simulate import hall_drives
from l2m_gtsam.simulate.steel_hall import STRONG, steel_hall

HALF = 5.0  # metres: of the part of the open floor
FEW, MANY = 3_000, 100_000  # places


@dataclass(frozen=True)
class Maps:
    """Maps of the same readings."""

    exact: HarmonicMap
    compiled: CompiledMap
    sliding: SlidingGP

    @classmethod
    def of(cls, data: TrainingSet, cloud: FloatArray | None = None) -> "Maps":
        exact = HarmonicMap.fit(data.points, data.field, cloud=cloud)
        return cls(exact, exact.compile(), SlidingGP.fit(data.points, data.field))


def open_floor() -> Maps:
    return Maps.of(within(survey(warehouse()), HALF))


def hall_with_posts() -> Maps:
    hall = steel_hall(3, STRONG)
    return Maps.of(hall_drives.survey(hall, 3), hall.cloud())


def places(exact: HarmonicMap, count: int) -> FloatArray:
    """Return places within the map's reach of its readings."""
    rng = np.random.default_rng(2)
    readings = exact.learnt.readings.points
    offset = rng.uniform(-1, 1, (count, 3)) * exact.options.reach / np.sqrt(3)
    return np.asarray(readings[rng.integers(0, len(readings), count)] + offset)


def rate(field_map: FieldMap, points: FloatArray, repeats: int) -> float:
    """Return fields with gradients per second."""
    return len(points) / seconds(partial(field_map.field_and_gradient, points), repeats)


def report(title: str, maps: Maps) -> Table:
    """Return rates, what compiling costs, and the largest errors."""
    few, many = places(maps.exact, FEW), places(maps.exact, MANY)
    maps.compiled.field_and_gradient(few[:10])  # loads the compiled code
    first = seconds(lambda: maps.exact.compile().field_and_gradient(many), 1)
    fast = rate(maps.compiled, many, 9)
    compiling, tiles = first - MANY / fast, len(maps.exact.tiles)
    errors = [
        np.abs(one - other).max()
        for one, other in zip(
            maps.exact.field_and_gradient(few), maps.compiled.field_and_gradient(few), strict=True
        )
    ]
    table = Table(
        title,
        "field and gradient (1/s)",
        "compiled is faster by",
        title=f"{len(maps.exact.learnt.readings):,} readings, {tiles} tiles",
        caption=f"off by at most {1e3 * errors[0]:.2f} nT and {1e3 * errors[1]:.2f} nT/m at "
        f"{FEW:,} places; {compiling:.2f} s to compile all tiles",
    )
    table.add_row("compiled", f"{fast:,.0f}", "")
    for name, slow in {
        "exact": rate(maps.exact, few, 2),
        "sliding GP": rate(maps.sliding, many, 2),
    }.items():
        table.add_row(name, f"{slow:,.0f}", f"{fast / slow:,.0f}")
    return table


def main() -> None:
    console = Console()
    console.print(report("open floor", open_floor()))
    console.print(report("hall with posts", hall_with_posts()))


if __name__ == "__main__":
    main()
