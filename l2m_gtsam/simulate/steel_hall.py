"""Halls of magnetised cuboids, with posts and racks inside the area where vehicles drive.

The field is the exact one of extended bodies, so that no map kind is judged in a world made of
its own features. Beside every steel structure stands a timber one of the same shape: a LiDAR sees
both, the field only the first. z = 0 is the floor, the area is centred on the origin.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import BoolArray, FloatArray, joined_rows
from l2m_gtsam.simulate.world import SteelWorld
from l2m_gtsam.storage.cloud import thinned_cloud

MILD, STRONG = 1.0, 10.0  # factors on the polarisation of posts and racks
EARTH = np.array([22.0, 3.0, -38.0])  # uT
CELLS = (4, 3)  # one structure in each cell of 2 x 2 m
INDUCED = 5.0  # polarisation along a part's length, relative to the Earth's field there
CROSS = 0.25  # remanence across a part's length, relative to that along it
TESLA_PER_MICROTESLA = 1e-6
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


@dataclass(frozen=True)
class SteelStructure:
    """A post or a rack: upright boxes along the hall's axes on one footprint.

    Attributes
    ----------
    centre, half
        Middle and half sides of the footprint in metres, shape (2,).
    """

    boxes: Boxes
    centre: FloatArray
    half: FloatArray

    def cloud(self) -> FloatArray:
        """Return the voxels of its surface, shape (P, 3)."""
        pairs = zip(self.boxes.dimensions, self.boxes.centres, strict=True)
        surfaces = [_surface(dimensions) + centre for dimensions, centre in pairs]
        return thinned_cloud(np.concatenate(surfaces), VOXEL_M)


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


def post(rng: np.random.Generator, place: FloatArray) -> SteelStructure:
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
    return SteelStructure(boxes, place, np.full(2, side / 2))


def rack(rng: np.random.Generator, place: FloatArray) -> SteelStructure:
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
    return SteelStructure(boxes, place, half)


def _surface(dimensions: FloatArray) -> FloatArray:
    """Return a grid on the surface of a box about the origin, shape (P, 3)."""
    axes = [np.linspace(-d / 2, d / 2, int(np.ceil(d / SAMPLING_M)) + 1) for d in dimensions]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    # The outermost grid lines are the sides to rounding.
    return np.asarray(grid[np.any(np.abs(grid) > dimensions / 2 - 1e-9, axis=1)])


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
    """A hall: its steel, its structures, its floor.

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
    steel: tuple[SteelStructure, ...]
    timber: tuple[SteelStructure, ...]
    floor: Floor

    def field(self, points: FloatArray) -> FloatArray:
        """Return the field in the map frame at points (N, 3) in uT, shape (N, 3)."""
        return self.world.field(points)

    def height(self, xy: FloatArray) -> FloatArray:
        """Return the height of the floor at places (N, 2) in metres, shape (N,)."""
        return self.floor.height(xy)

    def cloud(self) -> FloatArray:
        """Return what a LiDAR saw of its structures, shape (P, 3) in metres."""
        return np.concatenate([np.zeros((0, 3)), *(each.cloud() for each in self.steel)])

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
        # From within a footprint the exit is the nearest side.
        through = (over == over.max(axis=1, keepdims=True)).astype(np.float64)
        outwards = np.where(over.max(axis=1, keepdims=True) > 0, np.maximum(over, 0.0), through)
        direction = np.where(offset < 0, -outwards, outwards)
        return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))

    def _distances(self, points: FloatArray) -> FloatArray:
        """Return signed horizontal distances to all footprints, shape (N, K)."""
        # Signed distance of a box: outside the length of what is over, inside the least depth.
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
    parts = [floor, ceiling, *(structure.boxes for structure in steel)]
    boxes = replace(joined_rows(parts), kinds=sum((each.kinds for each in parts), ()))
    factor = np.ones(len(boxes.kinds))
    factor[len(floor.kinds) + len(ceiling.kinds) :] = strength
    world = _magnetised(rng, boxes, factor)
    return SteelHall(world, steel, timber, _uneven_floor(rng))


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
