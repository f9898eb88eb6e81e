"""What a hall of steel is made of: boxes, posts and racks of boxes, bars, plates and beams."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from l2m_gtsam.data import FloatArray

HALF_AREA = np.array([4.0, 3.0])  # metres
BEYOND = 1.0  # steel under the floor and over the ceiling lies this far beyond the area too
SAMPLING_M, VOXEL_M = 0.04, 0.1


@dataclass(frozen=True)
class Boxes:
    """Boxes turned about z, one kind name and one typical remanence each.

    Attributes
    ----------
    kinds
        What each is, N names.
    dimensions, centres
        In metres, shape (N, 3).
    yaw
        In radians, shape (N,).
    remanence
        Standard deviation of the polarisation along the longest side in tesla, shape (N,).
    """

    kinds: tuple[str, ...]
    dimensions: FloatArray
    centres: FloatArray
    yaw: FloatArray
    remanence: FloatArray

    @classmethod
    def joined(cls, parts: "tuple[Boxes, ...]") -> Self:
        """Return the boxes of all parts."""
        return cls(
            sum((part.kinds for part in parts), ()),
            np.concatenate([np.zeros((0, 3)), *(part.dimensions for part in parts)]),
            np.concatenate([np.zeros((0, 3)), *(part.centres for part in parts)]),
            np.concatenate([np.zeros(0), *(part.yaw for part in parts)]),
            np.concatenate([np.zeros(0), *(part.remanence for part in parts)]),
        )


@dataclass(frozen=True)
class Structure:
    """A post or a rack: upright boxes along the hall's axes on one footprint.

    Attributes
    ----------
    boxes
        Its parts.
    centre, half
        Middle and half sides of the footprint in metres, shape (2,).
    """

    boxes: Boxes
    centre: FloatArray
    half: FloatArray

    def cloud(self, shift: FloatArray) -> FloatArray:
        """Return the voxels of its surface, moved by ``shift`` (3,) metres, shape (P, 3)."""
        surfaces = [
            _surface(dimensions) + centre + shift
            for dimensions, centre in zip(self.boxes.dimensions, self.boxes.centres, strict=True)
        ]
        return _voxels(np.concatenate(surfaces))


def floor_steel(rng: np.random.Generator) -> Boxes:
    """Return bars and plates under the floor."""
    bars, plates = 14, 6
    bar = np.column_stack([rng.uniform(1.0, 3.0, bars), rng.uniform(0.04, 0.1, (bars, 2))])
    plate = np.column_stack([rng.uniform(0.5, 1.2, (plates, 2)), rng.uniform(0.01, 0.03, plates)])
    dimensions = np.concatenate([bar, plate])
    z = -rng.uniform(0.1, 0.8, bars + plates) - dimensions[:, 2] / 2
    kinds = ("floor bar",) * bars + ("floor plate",) * plates
    remanence = np.concatenate([np.full(bars, 6e-3), np.full(plates, 3e-3)])
    return _scattered(rng, Boxes(kinds, dimensions, _at_height(z), np.zeros_like(z), remanence))


def ceiling_steel(rng: np.random.Generator) -> Boxes:
    """Return beams under the ceiling."""
    count = 8
    dimensions = np.column_stack([rng.uniform(2.0, 4.0, count), rng.uniform(0.1, 0.2, (count, 2))])
    z = rng.uniform(2.8, 4.0, count) + dimensions[:, 2] / 2
    boxes = Boxes(
        ("beam",) * count, dimensions, _at_height(z), np.zeros(count), np.full(count, 8e-3)
    )
    return _scattered(rng, boxes)


def _at_height(z: FloatArray) -> FloatArray:
    return np.column_stack([np.zeros((len(z), 2)), z])


def _scattered(rng: np.random.Generator, boxes: Boxes) -> Boxes:
    """Return boxes at random places and in random directions, at their own heights."""
    reach, count = HALF_AREA + BEYOND, len(boxes.kinds)
    moved = boxes.centres + _at_height(np.zeros(count))
    moved[:, :2] += rng.uniform(-reach, reach, (count, 2))
    yaw = rng.uniform(0, np.pi, count)
    return Boxes(boxes.kinds, boxes.dimensions, moved, yaw, boxes.remanence)


def post(rng: np.random.Generator, place: FloatArray) -> Structure:
    """Return a post of three lengths, each magnetised on its own."""
    side, lengths = rng.uniform(0.1, 0.2), rng.uniform(0.7, 1.0, 3)
    z = np.cumsum(lengths) - lengths / 2
    boxes = Boxes(
        ("post",) * 3,
        np.column_stack([np.full((3, 2), side), lengths]),
        np.column_stack([np.tile(place, (3, 1)), z]),
        np.zeros(3),
        np.full(3, 6e-4),
    )
    return Structure(boxes, place, np.full(2, side / 2))


def rack(rng: np.random.Generator, place: FloatArray) -> Structure:
    """Return a rack: four uprights, beams in front and behind at two levels, two boxes."""
    half, section = np.array([0.6, 0.25]), 0.06
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]]) * (half - section / 2)
    beams = np.array([[s * (half[1] - section / 2), z] for s in (-1, 1) for z in (0.45, 1.3)])
    loads = np.array([[x, z] for x, z in zip((-0.25, 0.25), (0.65, 1.5), strict=True)])
    dimensions = [[section, section, 2.0]] * 4 + [[2 * half[0], 0.04, 0.1]] * 4
    boxes = Boxes(
        ("upright",) * 4 + ("rack beam",) * 4 + ("box",) * 2,
        np.concatenate([dimensions, rng.uniform([0.25, 0.2, 0.2], [0.4, 0.35, 0.28], (2, 3))]),
        np.concatenate(
            [
                np.column_stack([corners, np.ones(4)]),
                np.column_stack([np.zeros(4), beams]),
                np.column_stack([loads[:, 0], np.zeros(2), loads[:, 1]]),
            ]
        )
        + np.append(place, 0.0),
        np.zeros(10),
        np.concatenate([np.full(8, 4e-3), np.full(2, 3e-4)]),
    )
    return Structure(boxes, place, half)


def _surface(dimensions: FloatArray) -> FloatArray:
    """Return a grid on the surface of a box about the origin, shape (P, 3)."""
    axes = [np.linspace(-d / 2, d / 2, int(np.ceil(d / SAMPLING_M)) + 1) for d in dimensions]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    # The outermost grid lines are the sides to rounding.
    return np.asarray(grid[np.any(np.abs(grid) > dimensions / 2 - 1e-9, axis=1)])


def _voxels(points: FloatArray) -> FloatArray:
    """Return the mean of the points in each voxel, shape (P, 3)."""
    _, voxel = np.unique(np.floor(points / VOXEL_M), axis=0, return_inverse=True)
    count = np.bincount(voxel)
    return np.stack([np.bincount(voxel, points[:, k]) / count for k in range(3)], axis=1)
