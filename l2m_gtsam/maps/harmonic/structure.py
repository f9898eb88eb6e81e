"""Where sources can be: voxels in which the LiDAR saw something beside or over the drive."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.training import FURTHEST
from l2m_gtsam.options import Options
from l2m_gtsam.solve.linear_algebra import parts_of

MOST_SOURCES = 200_000
MOST_REACH = 2.0  # metres; tiles see no structure further away
# Metres beside a tile's box, which itself ends 0.75 m beyond the readings. Without the strong
# posts 1.3 m from its outermost readings a tile takes their field for that of those it
# has; strengths of a hundred were learnt.
SIGHT = 0.5


class StructureOptions(Options):
    """How a point cloud becomes candidate sources; lengths in metres."""

    edge: float = Field(default=0.12, gt=0.01)
    """Edge of the voxels; each holds one source. Sources this close make any field half a metre
    away, also that of a post a few centimetres beside. At 0.2 m strong posts were estimated with
    twice the error that the map claimed."""
    reach: float = Field(default=MOST_REACH, gt=0, le=MOST_REACH)
    """Structure further than this from every reading is left to floor and ceiling modes."""
    clearance: float = Field(default=0.12, ge=0)
    """No source is nearer than this to a reading: the sensor was there."""
    below: float = Field(default=0.5, ge=0)
    """Standing structure is followed this far below the lowest reading; deeper sources are the
    floor's."""
    piece: float = Field(default=1.0, gt=0)
    """Long structures are cut into pieces of this length; each has its own strength."""


@dataclass(frozen=True)
class Sources:
    """Candidate sources and the structures they belong to.

    Attributes
    ----------
    positions
        In the map frame in metres, shape (K, 3).
    structure
        Number of the structure that each is a part of, shape (K,).
    """

    positions: FloatArray
    structure: IntArray

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, rows: IntArray) -> "Sources":
        return Sources(self.positions[rows], self.structure[rows])

    @cached_property
    def pieces(self) -> tuple["Sources", ...]:
        """Each structure by itself."""
        order = np.argsort(self.structure, kind="stable")
        edges = np.flatnonzero(np.diff(self.structure[order])) + 1
        return tuple(self[rows] for rows in np.split(order, edges) if len(rows))

    @cached_property
    def middles(self) -> FloatArray:
        """Middle of each structure in metres, shape (S, 3)."""
        return np.array([each.positions.mean(axis=0) for each in self.pieces]).reshape(-1, 3)

    def within(self, centre: FloatArray, edge: float) -> list[int]:
        """Return which structures have their middle in, or close to, a square about (x, y)."""
        inside = (np.abs(self.middles[:, :2] - centre) <= edge / 2 + SIGHT).all(axis=1)
        return [int(s) for s in np.flatnonzero(inside)]


NO_SOURCES = Sources(np.empty((0, 3)), np.empty(0, dtype=np.int64))


def candidate_sources(
    cloud: FloatArray, readings: FloatArray, options: StructureOptions
) -> Sources:
    """Return the sources that a point cloud suggests for a survey.

    A voxel is kept where it is within reach of a reading but not at one, and where something
    stands: its column holds points above the lowest reading nearby, and higher than a ramp could
    rise from what lies around. A bare floor makes none, level or not.

    Parameters
    ----------
    cloud
        Points of the map frame in metres, shape (M, 3).
    readings
        Where the survey read the field, metres, shape (N, 3).
    options
        Edge of the voxels and distances in metres.

    Raises
    ------
    MapError
        If there would be too many sources, or points lie nowhere on Earth.
    """
    if len(cloud) and np.abs(cloud).max() > FURTHEST:
        raise MapError(f"the structure cloud exceeds {FURTHEST:g} m: is it in metres?")
    voxels = np.unique(np.floor(cloud / options.edge).astype(np.int64), axis=0)
    centres = np.asarray((voxels + 0.5) * options.edge, dtype=np.float64)
    away, nearest = cKDTree(readings).query(centres, distance_upper_bound=options.reach)
    near = np.isfinite(away) & (away >= options.clearance)
    lowest = np.full(len(voxels), np.inf)
    lowest[near] = lowest_nearby(readings, options.reach)[np.asarray(nearest)[near]]
    keep = near & (centres[:, 2] >= lowest - options.below)
    above = np.flatnonzero(near & (centres[:, 2] >= lowest))
    above = above[rises(centres[above], np.concatenate([centres, readings]), options.edge)]
    keep = keep & is_standing(voxels, above)
    if np.count_nonzero(keep) > MOST_SOURCES:
        raise MapError(
            f"the structure cloud suggests {np.count_nonzero(keep)} sources within "
            f"{options.reach:g} m of the survey, at most {MOST_SOURCES} are allowed; a larger "
            "structure.edge or a smaller structure.reach is needed"
        )
    return Sources(centres[keep], structures_of(centres[keep], options))


# A floor that vehicles drive on rises by less than this, 17 degrees, in any direction.
STEEPEST = 0.3
# What a voxel is compared with: the lowest points of so many cells of so many voxels around it,
# about a metre far. The floor under a rack's shelf may be hidden, that beside the rack is seen.
GROUND_CELL, GROUND_CELLS = 3, 25


def cells_of(points: FloatArray | IntArray, edge: float) -> IntArray:
    """Return the number of the square cell, from above, that holds each point, shape (N,)."""
    x, y = np.floor(points[:, :2] / edge).astype(np.int64).T
    # One number per cell, as sorting pairs takes several times as long. It may wrap, but no two
    # cells less than 2^31 apart share one.
    _, cell = np.unique((x << 32) + y, return_inverse=True)
    return np.asarray(cell, dtype=np.int64)


def lowest_of_cells(points: FloatArray, edge: float) -> FloatArray:
    """Return the lowest point of every square cell that holds any, shape (C, 3)."""
    cell = cells_of(points, edge)
    order = np.lexsort((points[:, 2], cell))
    return points[order[np.diff(cell[order], prepend=-1) > 0]]


def lowest_nearby(points: FloatArray, edge: float) -> FloatArray:
    """Return the height of the lowest point of the cell around each one, shape (N,)."""
    cell = cells_of(points, edge)
    lowest = np.full(cell.max() + 1, np.inf)
    np.minimum.at(lowest, cell, points[:, 2])
    return np.asarray(lowest[cell])


def rises(centres: FloatArray, seen: FloatArray, edge: float) -> BoolArray:
    """Return which voxels are higher than a ramp could lead to from the points around, (K,).

    Readings alone do not determine it: those of a drive along a ramp's foot, or across it, carry
    no information on how the floor goes on beside them. In a cloud without floor a beam little
    higher than the sensors is taken for one.

    Parameters
    ----------
    centres
        Of the voxels in metres, shape (K, 3).
    seen
        Centres of all voxels, and the readings, under which there is floor too, shape (N, 3).
    edge
        Edge of a voxel in metres.
    """
    ground = lowest_of_cells(seen, GROUND_CELL * edge)
    away, which = cKDTree(ground[:, :2]).query(centres[:, :2], k=GROUND_CELLS)
    heights = np.append(ground[:, 2], np.inf)  # where there are fewer cells
    lowest = (heights[which] + STEEPEST * away).min(axis=1)
    # An even floor's points are in one layer of voxels or, where it is left, in two.
    return np.asarray(centres[:, 2] > lowest + 1.5 * edge)


def is_standing(voxels: IntArray, above: IntArray) -> BoolArray:
    """Return which voxels share their column with one of those numbered ``above``, shape (K,)."""
    column = cells_of(voxels, 1.0)
    standing = np.zeros(len(voxels), dtype=bool)  # by column; there are no more than voxels
    standing[column[above]] = True
    return np.asarray(standing[column])


def structures_of(centres: FloatArray, options: StructureOptions) -> IntArray:
    """Return the structure of each voxel: touching voxels of one cell of ``piece``, (K,)."""
    if not len(centres):
        return np.empty(0, dtype=np.int64)
    # Neighbours by a face, an edge or a corner: a cube's diagonal is 1.73 edges.
    touching = cKDTree(centres).query_pairs(1.8 * options.edge, output_type="ndarray")
    component = parts_of(touching, len(centres))
    cell = np.floor(centres[:, :2] / options.piece).astype(np.int64)
    _, piece = np.unique(np.column_stack([component, cell]), axis=0, return_inverse=True)
    return np.asarray(piece, dtype=np.int64)
