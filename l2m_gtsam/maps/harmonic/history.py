"""Which drive each reading of a map is of, and how far the field moved between drives."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.grid import Grid
from l2m_gtsam.records.map_diary import MapDiary, MapDrive


@dataclass(frozen=True)
class TileStep:
    """How the field of a tile moved between two drives.

    Attributes
    ----------
    share
        Standard deviation of the step over that of the prior, 0 to 1.
    depth
        How much further away than the prior's the sources are that moved, metres: where it is not
        zero the waves move less the shorter they are, and the structures do not.
    """

    share: float
    depth: float


STILL = TileStep(0.0, 0.0)


@dataclass(frozen=True)
class History:
    """What N readings of a map went through.

    Attributes
    ----------
    drive
        Number of the drive that each is of, the survey being 0, shape (N,).
    cells
        Whole-numbered places of tiles that have steps, shape (M, 2).
    shares, depths
        Of each one's step before each drive; see ``TileStep``, shapes (M, D).
    freed
        Structures that are others since a drive: number of the structure and of the drive, (P, 2).
    diary
        The D drives and what changed between them.
    """

    drive: IntArray
    cells: IntArray
    shares: FloatArray
    depths: FloatArray
    freed: IntArray
    diary: MapDiary

    @classmethod
    def of_survey(cls, count: int, survey: MapDrive) -> "History":
        """Return that of so many readings of a survey."""
        pairs = np.empty((0, 2), dtype=np.int64)
        none = np.empty((0, 1))
        drive = np.zeros(count, dtype=np.int64)
        return cls(drive, pairs, none, none, pairs, MapDiary((survey,)))

    @property
    def drives(self) -> int:
        """How many drives there were, the survey among them."""
        return len(self.diary.drives)

    def followed_by(self, count: int, drive: MapDrive) -> "History":
        """Return the same with so many readings of a new drive, before which nothing moved."""
        still = np.zeros((len(self.cells), 1))
        return replace(
            self,
            drive=np.append(self.drive, np.full(count, self.drives)),
            shares=np.hstack([self.shares, still]),
            depths=np.hstack([self.depths, still]),
            diary=replace(self.diary, drives=(*self.diary.drives, drive)),
        )

    def only(self, rows: BoolArray) -> "History":
        """Return that of some readings, (N,)."""
        return replace(self, drive=self.drive[rows])

    def with_freed(self, structures: IntArray) -> "History":
        """Return the same with structures that are others since the last drive."""
        last = np.full(len(structures), self.drives - 1)
        return replace(self, freed=np.vstack([self.freed, np.column_stack([structures, last])]))

    def with_steps(self, grid: Grid, steps: dict[int, TileStep]) -> "History":
        """Return the same with steps of tiles of a grid before the last drive."""
        moved = {tile: step for tile, step in steps.items() if step.share > 0}
        places = grid.cells[list(moved)].reshape(-1, 2)
        cells = np.unique(np.vstack([self.cells, places]), axis=0)
        old = np.array([self._row(each, cells) for each in self.cells], dtype=np.int64)
        shares, depths = (np.zeros((len(cells), self.drives)) for _ in range(2))
        shares[old], depths[old] = self.shares, self.depths
        for place, step in zip(places, moved.values(), strict=True):
            row = self._row(place, cells)
            shares[row, -1], depths[row, -1] = step.share, step.depth
        return replace(self, cells=cells, shares=shares, depths=depths)

    @staticmethod
    def _row(cell: IntArray, cells: IntArray) -> int:
        return int(np.flatnonzero((cells == cell).all(axis=1))[0])

    def steps_of(self, cell: IntArray) -> list[TileStep]:
        """Return the steps of a tile by its place, (2,), before each drive."""
        own = np.flatnonzero((self.cells == cell).all(axis=1))
        if not len(own):
            return [STILL] * self.drives
        return [
            TileStep(float(share), float(depth))
            for share, depth in zip(self.shares[own[0]], self.depths[own[0]], strict=True)
        ]

    def freed_before(self, drive: int, structures: list[int]) -> list[bool]:
        """Return which structures are others since a drive."""
        gone = set(self.freed[self.freed[:, 1] == drive, 0].tolist())
        return [each in gone for each in structures]
