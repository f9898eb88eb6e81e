"""Motions that a driver could add to a drive, as poses."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSample, FloatArray
from l2m_gtsam.options import Options

SWINGS = 7  # of a heaving or tilting vehicle along the drive


class MotionOptions(Options):
    """Which extra motions are tried."""

    poses: int = Field(default=100, ge=10)
    """Poses of each motion at which every sensor reads once."""
    heave_m: float = Field(default=0.2, gt=0)
    """Up and down by so much."""
    tilt_deg: float = Field(default=5.0, gt=0, lt=45)
    """Roll and pitch by so much either way."""
    loop_m: float = Field(default=0.5, gt=0)
    """Radius of a loop where the gradient is strong."""
    detour_m: float = Field(default=2.0, gt=0)
    """Such a place is looked for so far around the drive."""


@dataclass(frozen=True)
class Motion:
    """Poses of the lidar in the map.

    Attributes
    ----------
    name
        What the driver does.
    R, p
        Shapes (N, 3, 3) and (N, 3), metres.
    """

    name: str
    R: FloatArray
    p: FloatArray


def extra_motions(drive: Motion, options: MotionOptions) -> tuple[Motion, ...]:
    """Return what could be done on the path of a drive, the drive itself once more first.

    Parameters
    ----------
    drive
        The drive.
    options
        How much of each.
    """
    rows = np.linspace(0, len(drive.p) - 1, options.poses).round().astype(int)
    R, p = drive.R[rows], drive.p[rows]
    swing = np.sin(2 * np.pi * SWINGS * np.linspace(0, 1, options.poses))
    up = np.array([0.0, 0.0, 1.0])
    tilt, round_ = np.deg2rad(options.tilt_deg) * swing, np.linspace(0, 2 * np.pi, len(swing))
    middle = len(p) // 2
    spot = np.broadcast_to(p[middle], p.shape)
    return (
        Motion("the same drive once more", R, p),
        Motion(
            f"heave by {options.heave_m:g} m up and down",
            R,
            p + options.heave_m * swing[:, None] * up,
        ),
        Motion(f"roll by {options.tilt_deg:g} deg either way", R @ _turns(tilt, [1, 0, 0]), p),
        Motion(f"pitch by {options.tilt_deg:g} deg either way", R @ _turns(tilt, [0, 1, 0]), p),
        Motion(
            f"turn round on the spot at {_place(p[middle])}", _turns(round_, up) @ R[middle], spot
        ),
        Motion("the same path the other way round", (_turns(np.pi, up) @ R)[::-1], p[::-1]),
    )


def loop(drive: Motion, centre: FloatArray, options: MotionOptions) -> Motion:
    """Return a circle about a place of the map, shape (3,), in metres, heading along it."""
    angle = np.linspace(0, 2 * np.pi, options.poses)
    around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    upright = _turns(angle + np.pi / 2 - _heading(drive.R[0]), [0.0, 0.0, 1.0]) @ drive.R[0]
    name = f"a loop of {options.loop_m:g} m radius about {_place(centre)}, if it is free"
    return Motion(name, upright, centre + options.loop_m * around)


def places_around(drive: Motion, options: MotionOptions) -> FloatArray:
    """Return the corners of a grid over and around a drive at its middle height, shape (K, 3)."""
    low, high = drive.p.min(axis=0) - options.detour_m, drive.p.max(axis=0) + options.detour_m
    x, y = (np.arange(low[axis], high[axis], options.loop_m) for axis in range(2))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.column_stack([grid, np.full(len(grid), np.median(drive.p[:, 2]))])


def strongest(places: FloatArray, sample: FieldSample) -> FloatArray | None:
    """Return the place with the strongest gradient of those inside the map, if there is one."""
    strength = np.linalg.norm(np.nan_to_num(sample.gradient), axis=(1, 2))
    strength[~sample.inside] = -1.0
    best = int(np.argmax(strength))
    return places[best] if sample.inside[best] else None


def _turns(angle: FloatArray | float, axis: FloatArray | list[float]) -> FloatArray:
    """Return rotations by angles in radians, shape (N, 3, 3), or one by one angle."""
    return Rotation.from_rotvec(np.multiply.outer(angle, axis)).as_matrix()


def _heading(R: FloatArray) -> float:
    """Return where the lidar's x axis points in the map's plane, in radians."""
    return float(np.arctan2(R[1, 0], R[0, 0]))


def _place(p: FloatArray) -> str:
    return f"({p[0]:.1f}, {p[1]:.1f}) m"
