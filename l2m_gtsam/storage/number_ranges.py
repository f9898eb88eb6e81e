"""Numbers that no pose and no reading has: of a damaged message, or in another unit."""

import numpy as np

from l2m_gtsam.data import FloatArray

# Drivers round quaternions, in single precision or to a few digits; none is off by more than this.
QUATERNION_LENGTH = (0.5, 2.0)
# Further than any place of the Earth from another one: the unit is wrong, or the number is.
MOST_METRES = 1e8


def odd_orientation(quaternion: FloatArray) -> str:
    """Return what is wrong with quaternions, shape (N, 4); nothing if all are rotations."""
    if np.any(~quaternion.any(axis=1)):
        return "an orientation is all zero, it must be a unit quaternion"
    # Of large numbers the squares are infinite: the largest component bounds the length, too.
    largest = np.abs(quaternion).max(axis=1)
    sound = (largest > QUATERNION_LENGTH[0] / 2) & (largest <= QUATERNION_LENGTH[1])
    length = np.linalg.norm(quaternion[sound], axis=1)
    inside = (length >= QUATERNION_LENGTH[0]) & (length <= QUATERNION_LENGTH[1])
    if sound.all() and inside.all():
        return ""
    worst = quaternion[~sound][0] if not sound.all() else quaternion[sound][~inside][0]
    return (
        f"an orientation is ({', '.join(f'{each:.3g}' for each in worst)}), it must be a unit "
        "quaternion"
    )


def odd_position(p: FloatArray) -> str:
    """Return what is wrong with positions in metres, shape (N, 3); nothing if all can be."""
    furthest = float(np.abs(p).max(initial=0.0))
    if furthest <= MOST_METRES:
        return ""
    return f"a position has a coordinate of {furthest:.3g} m, at most {MOST_METRES:g} m can be"


def odd_poses(p: FloatArray, quaternion: FloatArray) -> str:
    """Return what is wrong with poses, shapes (N, 3) and (N, 4); nothing if all can be."""
    return odd_orientation(quaternion) or odd_position(p)


# No sensor reads as much in any unit, counts included; squares of what is left are finite.
MOST_WRITTEN = 1e18


def readable(written: FloatArray) -> FloatArray:
    """Return readings as written with NaN in place of numbers that no sensor reads, (N, 3)."""
    return np.where(np.abs(written) <= MOST_WRITTEN, written, np.nan)
