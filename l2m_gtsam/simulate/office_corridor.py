"""Office corridors of thin steel: door frames, a lift, radiators, cable trays, bars in the floor.

Nothing of the steel halls is in here, so that what holds in both does not hang on one way to make
a field. Slender parts are magnetised along their length: a pole at each end. Sheets are magnetised
through their thickness: a current round the edge, by the law of Biot and Savart for straight wires.
z = 0 is the floor, the corridor runs along x and is centred on the origin.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray, joined_rows
from l2m_gtsam.storage.cloud import thinned_cloud

MICROTESLA = 0.1  # of a pole of 1 A m at a metre: mu0 / 4 pi
EARTH = np.array([17.0, -9.0, -44.0])  # uT
HALF_LENGTH, HALF_WIDTH, CEILING = 7.0, 1.3, 2.6  # metres, between the walls
FREE_WIDTH = 0.95  # of a sensor from the middle: it stays 0.35 m from the walls
DOOR, DOOR_HEIGHT = 0.9, 2.05  # metres
DOWN = -0.6  # of what the Earth makes of an upright part, beside what it has kept, in its sigmas
SEEN_M, VOXEL_M = 0.05, 0.12  # what a LiDAR sees of a part: samples, and their averages


@dataclass(frozen=True)
class Rods:
    """Slender parts from end to end, metres, (N, 3) each, and their poles in A m, (N,)."""

    first: FloatArray
    last: FloatArray
    pole: FloatArray

    def field(self, points: FloatArray) -> FloatArray:
        """Return their field at points (P, 3) in uT, shape (P, 3)."""
        poles = np.concatenate([self.last, self.first])
        strength = np.concatenate([self.pole, -self.pole])
        away = points[:, None] - poles
        distance = np.linalg.norm(away, axis=2)
        return np.asarray(MICROTESLA * np.einsum("n,pni,pn->pi", strength, away, distance**-3))

    def seen(self) -> FloatArray:
        """Return points along them, shape (M, 3)."""
        pairs = zip(self.first, self.last, strict=True)
        return np.concatenate([np.zeros((0, 3)), *(_between(*each) for each in pairs)])


@dataclass(frozen=True)
class Sheets:
    """Parallelograms: a corner and two sides in metres, (N, 3) each, and their edge currents in A.

    A current, shape (N,), runs from the corner along ``side`` first.
    """

    corner: FloatArray
    side: FloatArray
    other: FloatArray
    current: FloatArray

    def field(self, points: FloatArray) -> FloatArray:
        """Return their field at points (P, 3) in uT, shape (P, 3)."""
        opposite = self.corner + self.side + self.other
        corners = [self.corner, self.corner + self.side, opposite, self.corner + self.other]
        total = np.zeros((len(points), 3))
        for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
            a, b = points[:, None] - start, points[:, None] - end
            far = np.linalg.norm(a, axis=2), np.linalg.norm(b, axis=2)
            both = far[0] * far[1]
            across = (far[0] + far[1]) / (both * (both + np.sum(a * b, axis=2)))
            total += np.einsum("n,pni,pn->pi", self.current, np.cross(a, b), across)
        return np.asarray(MICROTESLA * total)

    def seen(self) -> FloatArray:
        """Return points on them, shape (M, 3)."""
        found = [np.zeros((0, 3))]
        for corner, side, other in zip(self.corner, self.side, self.other, strict=True):
            along = _between(np.zeros(3), side)
            across = _between(np.zeros(3), other)
            found.append((corner + along[:, None] + across).reshape(-1, 3))
        return np.concatenate(found)


@dataclass(frozen=True)
class OfficeCorridor:
    """A corridor: what a LiDAR sees of its steel, what it does not see, and an even floor.

    Attributes
    ----------
    rods, sheets
        Door frames, lift doors, radiators, trays.
    hidden
        Bars in the floor, and the rails of the lift behind its doors.
    swell
        Waves of the floor: wave vector in rad/m, phase, height in metres; shape (K, 4).
    """

    rods: Rods
    sheets: Sheets
    hidden: Rods
    swell: FloatArray

    def field(self, points: FloatArray) -> FloatArray:
        """Return the magnetic field at points (P, 3) in the map frame in uT, shape (P, 3)."""
        steel = self.rods.field(points) + self.hidden.field(points) + self.sheets.field(points)
        return np.asarray(EARTH + steel)

    def cloud(self) -> FloatArray:
        """Return what a LiDAR saw of the steel, shape (M, 3), metres."""
        return thinned_cloud(np.concatenate([self.rods.seen(), self.sheets.seen()]), VOXEL_M)

    def height(self, xy: FloatArray) -> FloatArray:
        """Return the height of the floor at places (N, 2) in metres, shape (N,)."""
        return np.asarray(np.sin(xy @ self.swell[:, :2].T + self.swell[:, 2]) @ self.swell[:, 3])

    def normal(self, xy: FloatArray) -> FloatArray:
        """Return unit vectors upright on the floor at places (N, 2), shape (N, 3)."""
        steep = np.cos(xy @ self.swell[:, :2].T + self.swell[:, 2]) * self.swell[:, 3]
        upright = np.column_stack([-steep @ self.swell[:, :2], np.ones(len(xy))])
        return np.asarray(upright / np.linalg.norm(upright, axis=1, keepdims=True))

    def free(self, points: FloatArray) -> BoolArray:
        """Return which places, shape (N, 2 or 3), a sensor can be at."""
        x, y = np.abs(points[:, 0]), np.abs(points[:, 1])
        return np.asarray((x <= HALF_LENGTH) & (y <= FREE_WIDTH))


def office_corridor(seed: int) -> OfficeCorridor:
    """Return a corridor; the same seed gives the same one."""
    rng = np.random.default_rng([seed, 21])
    # Along each wall what stands there has a stretch of its own, in any order.
    stretches = np.linspace(-HALF_LENGTH, HALF_LENGTH, 6)
    middles = (stretches[1:] + stretches[:-1]) / 2
    places = middles + rng.uniform(-0.4, 0.4, (2, len(middles)))
    rods, sheets, hidden = [], [], [floor_bars(rng)]
    for wall, along in zip((-HALF_WIDTH, HALF_WIDTH), places, strict=True):
        kinds = rng.permutation(["door", "door", "door", "radiator", "lift" if wall > 0 else "bay"])
        for kind, x in zip(kinds, along, strict=True):
            if kind in ("door", "lift"):
                rods.append(door_frame(rng, x, wall, 22.0 if kind == "lift" else 7.0))
            if kind == "lift":
                sheets.append(panels(rng, x, wall, (DOOR, DOOR_HEIGHT), 0.0, 4, 25.0))
                hidden.append(lift_rails(rng, x, wall))
            if kind == "radiator":
                sheets.append(panels(rng, x, wall, (1.2, 0.5), 0.12, 3, 25.0))
        rods.append(cable_tray(rng, 0.6 * wall))
    length = rng.uniform(1.0, 2.5, 3)
    angle = rng.uniform(0, np.pi, 3)
    waves = 2 * np.pi / length * np.stack([np.cos(angle), np.sin(angle)])
    swell = np.column_stack([waves.T, rng.uniform(-np.pi, np.pi, 3), np.full(3, 2.5e-3)])
    return OfficeCorridor(joined_rows(rods), joined_rows(sheets), joined_rows(hidden), swell)


def door_frame(rng: np.random.Generator, x: float, wall: float, pole: float) -> Rods:
    """Return two jambs, each in two pieces, and a head; poles of a standard deviation in A m."""
    low, high = x - DOOR / 2, x + DOOR / 2
    ends = [
        ((side, wall, bottom), (side, wall, top))
        for side in (low, high)
        for cut in [rng.uniform(0.7, 1.4)]  # at the lock, where it was bent
        for bottom, top in ((0.0, cut), (cut, DOOR_HEIGHT))
    ]
    upright = rng.standard_normal(4) + DOWN
    head = ((low, wall, DOOR_HEIGHT), (high, wall, DOOR_HEIGHT))
    first, last = np.array([*ends, head]).transpose(1, 0, 2)
    return Rods(first, last, pole * np.append(upright, rng.standard_normal()))


def panels(
    rng: np.random.Generator,
    x: float,
    wall: float,
    size: tuple[float, float],
    bottom: float,
    count: int,
    current: float,
) -> Sheets:
    """Return upright panels side by side along a wall, of a width and height together."""
    width, height = size[0] / count, size[1]
    corner = np.column_stack(
        [
            x - size[0] / 2 + width * np.arange(count),
            np.full(count, wall - 0.05 * np.sign(wall)),
            np.full(count, bottom),
        ]
    )
    side, other = np.tile([width, 0.0, 0.0], (count, 1)), np.tile([0.0, 0.0, height], (count, 1))
    return Sheets(corner, side, other, current * rng.standard_normal(count))


def lift_rails(rng: np.random.Generator, x: float, wall: float) -> Rods:
    """Return the rails of a shaft behind a wall, in pieces from below the floor to the next."""
    joints = np.arange(-2.5, 5.1, 2.5) + rng.uniform(0, 1)
    y = wall + 0.7 * np.sign(wall)
    pairs = list(pairwise(joints))
    ends = [((x + s, y, low), (x + s, y, high)) for s in (-0.8, 0.8) for low, high in pairs]
    first, last = np.array(ends).transpose(1, 0, 2)
    return Rods(first, last, 40.0 * (rng.standard_normal(len(ends)) + DOWN))


def cable_tray(rng: np.random.Generator, y: float) -> Rods:
    """Return a tray below the ceiling over the whole length, joined from pieces of 2 to 3 m."""
    joints = np.cumsum(rng.uniform(2.0, 3.0, 9)) - HALF_LENGTH - 2.5
    place = np.column_stack([joints, np.full(9, y), np.full(9, CEILING - 0.15)])
    return Rods(place[:-1], place[1:], 25.0 * rng.standard_normal(8))


def floor_bars(rng: np.random.Generator) -> Rods:
    """Return bars in the floor, along the corridor and across it."""
    count, reach = 24, np.array([HALF_LENGTH + 0.5, HALF_WIDTH])
    middle = np.column_stack(
        [rng.uniform(-reach, reach, (count, 2)), rng.uniform(-0.25, -0.1, count)]
    )
    along = rng.random(count) < 0.5
    length = np.where(along, rng.uniform(1.5, 4.0, count), rng.uniform(0.8, 2.4, count))
    half = 0.5 * length[:, None] * np.where(along[:, None], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    return Rods(middle - half, middle + half, 5.0 * rng.standard_normal(count))


def _between(first: FloatArray, last: FloatArray) -> FloatArray:
    """Return points from one end to the other, shape (M, 3)."""
    count = int(np.ceil(np.linalg.norm(last - first) / SEEN_M)) + 1
    return np.asarray(first + np.linspace(0, 1, count)[:, None] * (last - first))
