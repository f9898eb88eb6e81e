"""From readings to a harmonic map of which every tile is solved, compiled, written and read again.

Two places: the open floor of ``map_queries``, and the simulated warehouse of ``l2m simulate``,
where racks and posts that a LiDAR saw add some 17,000 candidate sources. Ten of either side by
side show how the cost grows. The sliding Gaussian process of the same readings is beside them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.map_queries import READINGS, SIZE, survey, warehouse
from benchmarks.timing import seconds
from l2m_gtsam.config import Config
from l2m_gtsam.data import FloatArray
from l2m_gtsam.mapping.map_building import suite_readings
from l2m_gtsam.maps.harmonic.compiled import CompiledTiles
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.sliding_gp import SlidingGP
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.simulate.scenario import ScenarioOptions, simulate
from l2m_gtsam.storage.tile_folder import TileFolder

COPIES = 10
GAP = 15.0  # metres between copies
ASKED = 2_000  # places, with variance
PLENTY = 1 << 36  # bytes


@dataclass(frozen=True)
class Place:
    """Readings (N, 3) in metres and uT, and the structure cloud, (M, 3) or None."""

    points: FloatArray
    field: FloatArray
    cloud: FloatArray | None

    def repeated(self, copies: int) -> "Place":
        """Return as many of this place side by side."""
        shifts = (SIZE[0] + GAP) * np.arange(copies)[:, None] * np.array([1.0, 0.0, 0.0])

        def shifted(points: FloatArray) -> FloatArray:
            return np.concatenate([points + shift for shift in shifts])

        cloud = None if self.cloud is None else shifted(self.cloud)
        return Place(shifted(self.points), np.tile(self.field, (copies, 1)), cloud)


def open_floor() -> Place:
    data = survey(warehouse())
    return Place(data.points, data.field, None)


def warehouse_with_structure() -> Place:
    scenario = simulate(ScenarioOptions())
    suite = {known.sensor: known for known in scenario.suite}
    read = suite_readings([scenario.mapping.recording], suite, Config().mapping.sync)
    rows = np.linspace(0, len(read.points) - 1, READINGS).astype(int)
    return Place(read.points[rows], read.field[rows], scenario.cloud)


def row(place: Place) -> list[str]:
    """Return what one map costs, as the cells of the table."""
    made: list[HarmonicMap] = []
    learn = seconds(
        lambda: made.append(HarmonicMap.fit(place.points, place.field, cloud=place.cloud)), 1
    )
    solve = seconds(lambda: in_threads(made[0].tiles.__getitem__, range(len(made[0].tiles))), 1)
    tiles, fast = made[0].tiles, CompiledTiles.of(made[0].learnt, made[0].options, made[0].tiles)
    indices = range(len(tiles))
    compiling = seconds(
        lambda: in_threads(lambda i: fast.compiled(i, partial(tiles.__getitem__, i)), indices), 1
    )
    with TemporaryDirectory() as folder:
        kept = made[0].with_store(TileFolder(Path(folder), PLENTY))
        together = seconds(lambda: kept.make_tiles(lambda _done, _total: None), 1)
        size = sum(path.stat().st_size for path in Path(folder).iterdir())
        read = seconds(lambda: kept.make_tiles(lambda _done, _total: None), 1)
    sliding = seconds(lambda: SlidingGP.fit(place.points, place.field), 1)
    rng = np.random.default_rng(0)
    middle = place.points[np.abs(place.points[:, 0] - SIZE[0] / 2) < SIZE[0] / 2]
    asked = middle[rng.integers(0, len(middle), ASKED)]
    query = seconds(lambda: made[0].query(asked), 1)
    return [
        f"{len(place.points):,}",
        f"{len(made[0].tiles)}",
        f"{learn:.1f}",
        f"{solve:.1f}",
        f"{compiling:.1f}",
        f"{together:.1f}",
        f"{learn + together:.1f}",
        f"{read:.1f}",
        f"{size / 1e6:,.0f}",
        f"{sliding:.1f}",
        f"{ASKED / query:,.0f}",
    ]


def report(title: str, place: Callable[[], Place]) -> Table:
    """Return the costs of one place and of ten."""
    columns = ("readings", "tiles", "learn (s)", "solve all tiles (s)", "compile all (s)")
    kept = ("solve, compile and write all (s)", "with learning (s)", "read all (s)", "size (MB)")
    table = Table(*columns, *kept, "sliding GP (s)", "exact with variance (1/s)", title=title)
    one = place()
    table.add_row(*row(one))
    table.add_row(*row(one.repeated(COPIES)))
    return table


def main() -> None:
    console = Console()
    console.print(report("open floor", open_floor))
    console.print(report("warehouse, structure from a LiDAR", warehouse_with_structure))


if __name__ == "__main__":
    main()
