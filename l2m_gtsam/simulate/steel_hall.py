"""Halls of magnetised cuboids, with posts and racks inside the area where vehicles drive.

The field is the exact one of extended bodies, so that no map kind is judged in a world made of
its own features. Beside every steel structure stands a timber one of the same shape: a LiDAR sees
both, the field only the first. z = 0 is the floor, the area is centred on the origin.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.simulate.hall_parts import (
    HALF_AREA,
    Boxes,
    Structure,
    ceiling_steel,
    floor_steel,
    post,
    rack,
)
from l2m_gtsam.simulate.world import SteelWorld

MILD, STRONG = 1.0, 10.0  # factors on the polarisation of posts and racks
EARTH = np.array([22.0, 3.0, -38.0])  # uT
CELLS = (4, 3)  # structures stand one to a cell of 2 x 2 m
INDUCED = 5.0  # polarisation along a part's length, relative to the Earth's field there
CROSS = 0.25  # remanence across a part's length, relative to that along it
TESLA_PER_MICROTESLA = 1e-6
SHIFT_M = 0.03  # exactly, in a random horizontal direction


class CloudVariant(StrEnum):
    """What the LiDAR is said to have seen of the structures."""

    NONE = "none"
    ACCURATE = "accurate"
    SHIFTED = "shifted 3 cm"
    FALSE = "with false"
    SHIFTED_FALSE = "shifted, with false"


@dataclass(frozen=True)
class Floor:
    """An uneven floor: a sum of waves.

    Attributes
    ----------
    waves
        Wave vectors in rad/m, shape (K, 2).
    phases
        In radians, shape (K,).
    amplitude
        Of each wave in metres.
    """

    waves: FloatArray
    phases: FloatArray
    amplitude: float

    def height(self, xy: FloatArray) -> FloatArray:
        """Return the height of the floor at places (N, 2) in metres, shape (N,)."""
        return np.asarray(self.amplitude * np.cos(xy @ self.waves.T + self.phases).sum(axis=1))

    def slope(self, xy: FloatArray) -> FloatArray:
        """Return the slope of the floor along x and y, shape (N, 2)."""
        return np.asarray(-self.amplitude * np.sin(xy @ self.waves.T + self.phases) @ self.waves)


@dataclass(frozen=True)
class SteelHall:
    """A hall: its steel, what stands in it, its floor.

    Attributes
    ----------
    world
        All steel, with the Earth's field.
    steel
        Structures of steel inside the area.
    timber
        As many of the same shapes that are not magnetic.
    floor
        Heights of the floor.
    """

    world: SteelWorld
    steel: tuple[Structure, ...]
    timber: tuple[Structure, ...]
    floor: Floor

    def free(self, points: FloatArray, clearance: float) -> BoolArray:
        """Return which points, shape (N, 2 or 3), lie in the area and this far from structures."""
        within = np.all(np.abs(points[:, :2]) <= HALF_AREA, axis=1)
        return np.asarray(within & (self.distance(points) >= clearance))

    def distance(self, points: FloatArray) -> FloatArray:
        """Return the horizontal distance to the nearest footprint in metres, shape (N,)."""
        return np.asarray(self._distances(points).min(axis=1, initial=np.inf))

    def pushed(self, xy: FloatArray, clearance: float) -> FloatArray:
        """Return places (N, 2) moved away from structures, as a drive bends around them.

        Between two structures with too little room a place may stay nearer than ``clearance``.
        """
        for _ in range(3 if self.steel else 0):
            lacking = np.maximum(clearance + 1e-9 - self.distance(xy), 0.0)
            xy = xy + lacking[:, None] * self._away(xy)
        return xy

    def _away(self, xy: FloatArray) -> FloatArray:
        """Return unit vectors away from the nearest footprint, shape (N, 2)."""
        nearest = np.argmin(self._distances(xy), axis=1)
        offset, half = xy - self._centres()[nearest], self._halves()[nearest]
        over = np.abs(offset) - half
        # Within a footprint the way out is through the nearest side.
        through = (over == over.max(axis=1, keepdims=True)).astype(np.float64)
        outwards = np.where(over.max(axis=1, keepdims=True) > 0, np.maximum(over, 0.0), through)
        direction = np.where(offset < 0, -outwards, outwards)
        return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))

    def _distances(self, points: FloatArray) -> FloatArray:
        """Return signed horizontal distances to all footprints, shape (N, K)."""
        over = np.abs(points[:, None, :2] - self._centres()) - self._halves()
        outside = np.linalg.norm(np.maximum(over, 0.0), axis=2)
        return np.asarray(outside + np.minimum(over.max(axis=2), 0.0))

    def _centres(self) -> FloatArray:
        return np.reshape([s.centre for s in self.steel + self.timber], (-1, 2))

    def _halves(self) -> FloatArray:
        return np.reshape([s.half for s in self.steel + self.timber], (-1, 2))


def steel_hall(seed: int, strength: float = MILD, posts: int = 4, racks: int = 1) -> SteelHall:
    """Return a hall with this many posts and racks of steel, and as many of timber.

    Parameters
    ----------
    seed
        The same seed gives the same hall; ``strength`` changes no place and no direction.
    strength
        Factor on the polarisation of posts and racks: ``MILD`` or ``STRONG``.
    posts, racks
        Structures of steel inside the area, six at most in all.
    """
    rng = np.random.default_rng([seed, 1])
    floor, ceiling = floor_steel(rng), ceiling_steel(rng)
    places = _places(rng)[: 2 * (posts + racks)]
    standing = [
        rack(rng, place) if index // 2 < racks else post(rng, place)
        for index, place in enumerate(places)
    ]
    steel, timber = tuple(standing[::2]), tuple(standing[1::2])
    inside = Boxes.joined(tuple(structure.boxes for structure in steel))
    boxes = Boxes.joined((floor, ceiling, inside))
    factor = np.ones(len(boxes.kinds))
    factor[len(factor) - len(inside.kinds) :] = strength
    world = _magnetised(rng, boxes, factor)
    return SteelHall(world, steel, timber, _uneven_floor(rng))


def hall_cloud(hall: SteelHall, variant: CloudVariant, seed: int) -> FloatArray:
    """Return what a LiDAR is said to have seen, shape (P, 3) in metres, empty for none."""
    rng = np.random.default_rng([seed, 2])
    angle = rng.uniform(-np.pi, np.pi, len(hall.steel))
    unit = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    off = variant in (CloudVariant.SHIFTED, CloudVariant.SHIFTED_FALSE)
    seen = () if variant is CloudVariant.NONE else hall.steel
    clouds = [
        structure.cloud(SHIFT_M * off * shift)
        for structure, shift in zip(seen, unit[: len(seen)], strict=True)
    ]
    if variant in (CloudVariant.FALSE, CloudVariant.SHIFTED_FALSE):
        clouds += [structure.cloud(np.zeros(3)) for structure in hall.timber]
    return np.concatenate([np.zeros((0, 3)), *clouds])


def _magnetised(rng: np.random.Generator, boxes: Boxes, factor: FloatArray) -> SteelWorld:
    """Return boxes with induced and remanent polarisation, times a factor each, shape (N,)."""
    R = Rotation.from_rotvec(np.outer(boxes.yaw, [0.0, 0.0, 1.0])).as_matrix()
    along = boxes.dimensions == boxes.dimensions.max(axis=1, keepdims=True)
    earth = np.einsum("nij,i->nj", R, EARTH) * TESLA_PER_MICROTESLA
    spread = np.where(along, 1.0, CROSS) * boxes.remanence[:, None]
    polarisation = INDUCED * along * earth + spread * rng.standard_normal(along.shape)
    return SteelWorld(
        boxes.kinds, boxes.dimensions, boxes.centres, R, polarisation * factor[:, None], EARTH
    )


def _places(rng: np.random.Generator) -> FloatArray:
    """Return the cells' middles in random order, shape (12, 2), with a decimetre of play."""
    x, y = ((np.arange(n) + 0.5) / n * 2 - 1 for n in CELLS)
    middles = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) * HALF_AREA
    play: FloatArray = rng.uniform(-0.1, 0.1, middles.shape)
    return np.asarray(rng.permutation(middles) + play)


def _uneven_floor(rng: np.random.Generator) -> Floor:
    """Return three waves of 0.8 to 2 m: 5 mm and 1.3 degrees, standard deviation."""
    angle, length = rng.uniform(0, np.pi, 3), rng.uniform(0.8, 2.0, 3)
    waves = 2 * np.pi / length * np.stack([np.cos(angle), np.sin(angle)])
    return Floor(waves.T, rng.uniform(-np.pi, np.pi, 3), 4e-3)
