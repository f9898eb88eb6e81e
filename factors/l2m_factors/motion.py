r"""Poses a little earlier or later: what a time offset does to them.

.. math::
    R(\delta) = R \, \mathrm{Exp}(w \delta), \quad p(\delta) = p + R v \, \delta

with the twist ``(w, v)`` of the lidar: turning at a constant rate about its own axes, moving along
a straight line of the map.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from l2m_factors.arguments import numbers
from l2m_factors.field_map import FloatArray


@dataclass(frozen=True)
class PoseMotion:
    """How the lidar moves at each reading.

    Attributes
    ----------
    twist_lidar
        Angular velocity in rad/s and linear velocity in m/s, both in the lidar frame, shape (N, 6).
    offset
        Time offset in seconds at which the poses were taken, shape (N,).
    """

    twist_lidar: FloatArray
    offset: FloatArray

    @cached_property
    def at_rest(self) -> bool:
        """Whether the lidar moves at no reading."""
        return not self.twist_lidar.any()

    def after(self, offset: FloatArray) -> "PoseMotion":
        """Return the motion at other time offsets, shape (N,): the frame of ``v`` has turned."""
        if self.at_rest:
            return replace(self, offset=offset)
        turn = rotation_matrices(-self._angle(offset))
        v = np.einsum("nij,nj->ni", turn, self.twist_lidar[:, 3:])
        return replace(self, twist_lidar=np.hstack([self.twist_lidar[:, :3], v]), offset=offset)

    def checked(self, count: int) -> "PoseMotion":
        """Return a copy of it at so many readings; a ValueError names an array that is wrong."""
        twist = numbers("PoseMotion.twist_lidar", self.twist_lidar, (count, 6))
        return PoseMotion(twist, numbers("PoseMotion.offset", self.offset, (count,)))

    def _angle(self, offset: FloatArray) -> FloatArray:
        return np.asarray(self.twist_lidar[:, :3] * (offset - self.offset)[:, None])


def moved(
    R_map_lidar: FloatArray, p_map_lidar: FloatArray, motion: PoseMotion, offset: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return rotations (N, 3, 3) and positions (N, 3) in metres at other time offsets.

    Parameters
    ----------
    R_map_lidar, p_map_lidar
        Poses at ``motion.offset``, shapes (N, 3, 3) and (N, 3), metres.
    motion
        How they move.
    offset
        Where they are wanted, seconds, shape (N,).
    """
    if motion.at_rest:
        return R_map_lidar, p_map_lidar
    later = (offset - motion.offset)[:, None]
    R = R_map_lidar @ rotation_matrices(motion.twist_lidar[:, :3] * later)
    way = np.einsum("nij,nj->ni", R_map_lidar, motion.twist_lidar[:, 3:])
    return R, p_map_lidar + way * later


def rotation_matrices(vectors: FloatArray) -> FloatArray:
    """Return the rotations by rotation vectors in radians, shape (N, 3): Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    K = skew(vectors)
    # np.sinc(x) is sin(pi x) / (pi x), without a hole at zero.
    sine, half = np.sinc(angle / np.pi), np.sinc(angle / (2 * np.pi))
    return np.asarray(np.eye(3) + sine * K + 0.5 * half**2 * K @ K)


def skew(vectors: FloatArray) -> FloatArray:
    """Return the matrices ``[v]x``, shape (N, 3, 3)."""
    K = np.zeros((len(vectors), 3, 3))
    K[:, [2, 0, 1], [1, 2, 0]] = vectors
    return np.asarray(K - K.transpose(0, 2, 1))
