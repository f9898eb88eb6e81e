"""Where sensors are looked for: places of a lattice."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Candidates:
    """Places on a cubic lattice, of which those within some balls are looked at.

    They are the lidar frame's multiples of a step: searches around different centres look at the
    same places.

    Attributes
    ----------
    step
        Metres.
    lowest
        The first node in steps, shape (3,).
    within
        Which nodes of a box are in a ball, shape (nx, ny, nz).
    """

    step: float
    lowest: IntArray
    within: BoolArray

    @classmethod
    def around(cls, centre: FloatArray, radius: float, step: float) -> "Candidates":
        """Return the candidates in the ball about a centre, shape (3,); all in metres."""
        lowest = np.floor((centre - radius) / step).astype(np.int64)
        highest = np.ceil((centre + radius) / step).astype(np.int64)
        box = cls(step, lowest, np.ones(highest - lowest + 1, dtype=np.bool_))
        away = np.linalg.norm(box.t(np.argwhere(box.within)) - centre, axis=1)
        return replace(box, within=(away <= radius).reshape(box.within.shape))

    @classmethod
    def union(cls, balls: Sequence["Candidates"]) -> "Candidates":
        """Return the candidates in any of some balls of one step."""
        lowest = np.min([ball.lowest for ball in balls], axis=0)
        ends = [ball.lowest + ball.within.shape for ball in balls]
        whole = cls(balls[0].step, lowest, np.zeros(np.max(ends, axis=0) - lowest, dtype=np.bool_))
        for ball in balls:
            whole.within[ball.slices_of(whole)] |= ball.within
        return whole

    def slices_of(self, whole: "Candidates") -> tuple[slice, slice, slice]:
        """Return where the box lies in a larger one."""
        x, y, z = (self.lowest - whole.lowest).tolist()
        nx, ny, nz = self.within.shape
        return slice(x, x + nx), slice(y, y + ny), slice(z, z + nz)

    def axes(self) -> list[FloatArray]:
        """Return the coordinates of the box's nodes along each axis in metres."""
        return [
            self.step * (first + np.arange(size))
            for first, size in zip(self.lowest, self.within.shape, strict=True)
        ]

    def t(self, nodes: IntArray) -> FloatArray:
        """Return nodes of the box, shape (N, 3), in the lidar frame in metres."""
        return np.asarray(self.step * (self.lowest + nodes))
