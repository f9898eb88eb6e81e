"""Motions that a driver could add to a drive, as poses, and options of a plan."""

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
    """Poses of a turn on the spot and of a loop; every sensor reads once at each. A motion along
    the path of a drive has those of the drive."""
    heave_m: float = Field(default=0.2, gt=0)
    """Up and down by so much."""
    tilt_deg: float = Field(default=5.0, gt=0, lt=45)
    """Roll and pitch by so much to either side."""
    loop_m: float = Field(default=0.5, gt=0)
    """Radius of a loop where the gradient is strong."""
    turn_rad_s: float = Field(default=0.5, gt=0)
    """How fast the vehicle turns on the spot and in a loop."""
    detour_m: float = Field(default=2.0, gt=0)
    """Such a place is looked for so far around the drive."""


class PlanOptions(Options):
    """What is assumed and tried before a drive is calibrated."""

    rate_hz: float = Field(default=10.0, gt=0, le=1000)
    """Readings per second of sensors that the bag does not have yet."""
    noise_ut: float = Field(default=0.2, gt=0)
    """Standard deviation of the sensors' noise in microtesla, where neither
    `calibration.solve.sensor_noise_ut` nor the map has one: a map that learns it gives that of
    the mapping suite."""
    motion: MotionOptions = MotionOptions()
    """Extra motions that are tried."""


@dataclass(frozen=True)
class ExtraMotion:
    """Poses of the lidar in the map.

    Attributes
    ----------
    name
        What the driver does.
    R, p
        Shapes (N, 3, 3) and (N, 3), metres.
    seconds
        When, shape (N,).
    """

    name: str
    R: FloatArray
    p: FloatArray
    seconds: FloatArray

    @property
    def twist(self) -> FloatArray:
        """Angular velocity in rad/s and linear velocity in m/s, lidar frame, shape (N, 6)."""
        # Central differences, one-sided at both ends; rotations by their rotation vector.
        rows = np.arange(len(self.p))
        before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, len(rows) - 1)
        between = np.maximum(self.seconds[after] - self.seconds[before], np.finfo(float).tiny)
        turn = Rotation.from_matrix(self.R[before].transpose(0, 2, 1) @ self.R[after]).as_rotvec()
        step = np.einsum("nji,nj->ni", self.R, self.p[after] - self.p[before])
        return np.asarray(np.hstack([turn, step]) / between[:, None])


def extra_motions(drive: ExtraMotion, options: MotionOptions) -> tuple[ExtraMotion, ...]:
    """Return what could be done on the path of a drive, the drive itself once more first.

    Parameters
    ----------
    drive
        The drive as a sensor reads on it, its times ascending, none twice.
    options
        How much of each.
    """
    R, p, seconds = drive.R, drive.p, drive.seconds
    swings = min(SWINGS, len(p) / 4)
    swing = np.sin(2 * np.pi * swings * np.linspace(0, 1, len(p)))
    up = np.array([0.0, 0.0, 1.0])
    tilt, round_ = np.deg2rad(options.tilt_deg) * swing, np.linspace(0, 2 * np.pi, options.poses)
    middle = len(p) // 2
    spot = np.broadcast_to(p[middle], (options.poses, 3))
    return (
        ExtraMotion("the same drive once more", R, p, seconds),
        ExtraMotion(
            f"heave by {options.heave_m:g} m up and down",
            R,
            p + options.heave_m * swing[:, None] * up,
            seconds,
        ),
        ExtraMotion(
            f"roll by {options.tilt_deg:g} deg either way", R @ _turns(tilt, [1, 0, 0]), p, seconds
        ),
        ExtraMotion(
            f"pitch by {options.tilt_deg:g} deg either way", R @ _turns(tilt, [0, 1, 0]), p, seconds
        ),
        ExtraMotion(
            f"turn round on the spot at {_place(p[middle])}",
            _turns(round_, up) @ R[middle],
            spot,
            round_ / options.turn_rad_s,
        ),
        ExtraMotion(
            "the same path the other way round",
            (_turns(np.pi, up) @ R)[::-1],
            p[::-1],
            seconds[-1] - seconds[::-1],
        ),
    )


def loop(drive: ExtraMotion, centre: FloatArray, options: MotionOptions) -> ExtraMotion:
    """Return a circle about a place of the map, shape (3,), in metres, heading along it."""
    angle = np.linspace(0, 2 * np.pi, options.poses)
    around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    upright = _turns(angle + np.pi / 2 - _heading(drive.R[0]), [0.0, 0.0, 1.0]) @ drive.R[0]
    name = f"a loop of {options.loop_m:g} m radius about {_place(centre)}, if it is free"
    seconds = angle / options.turn_rad_s
    return ExtraMotion(name, upright, centre + options.loop_m * around, seconds)


def places_around(drive: ExtraMotion, options: MotionOptions) -> FloatArray:
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
