"""A spinning LiDAR in a world of solid boxes, by casting rays."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.options import Options
from l2m_gtsam.records.scans import Scan
from l2m_gtsam.simulate.solids import Solids

NANOSECONDS = 1e9
MISSING = "point clouds are cast with trimesh and embreex: pip install 'l2m-gtsam[lidar]'"

PosesAt = Callable[[IntArray], Trajectory]
"""True poses of the lidar in the map at times (ns), shape (N,): ``VehicleMotion.at``."""


class SpinningLidarOptions(Options):
    """A LiDAR of beams that spin about the vertical axis of its frame."""

    beams: Annotated[int, Field(ge=1, le=256)] = 32
    """Number of beams, evenly spaced in elevation."""
    lowest: Annotated[float, Field(ge=-90, le=90)] = -22.5
    """Elevation of the lowest beam in degrees."""
    highest: Annotated[float, Field(ge=-90, le=90)] = 22.5
    """Elevation of the highest beam in degrees."""
    columns: Annotated[int, Field(ge=4, le=4096)] = 900
    """Measurements of each beam in one turn."""
    rate: Annotated[float, Field(gt=0, le=100)] = 10.0
    """Turns per second. A turn of the default LiDAR takes up to 0.35 MB of a bag."""
    sweep: Annotated[float, Field(ge=0)] = 0.0
    """How long the beams take for their turn, in seconds: each point is in the frame of the lidar
    where it was then, which distorts a scan that is taken while driving, and has its time in the
    field `time`. 0 gives snapshots, as from a driver that has removed the distortion."""
    nearest: Annotated[float, Field(ge=0)] = 0.5
    """Nearer points are not measured, metres."""
    furthest: Annotated[float, Field(gt=0, le=1000)] = 60.0
    """Further points are not measured, metres."""
    noise: Annotated[float, Field(ge=0)] = 0.01
    """Standard deviation of a range in metres."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.lowest > self.highest:
            raise ValueError("`lowest` must not be above `highest`")
        if self.nearest >= self.furthest:
            raise ValueError("`nearest` must be less than `furthest`")
        if self.sweep * self.rate > 1:
            raise ValueError(f"`sweep` must end before the next turn, {1 / self.rate:g} s at most")
        return self

    def directions(self) -> FloatArray:
        """Return unit vectors of all rays in the lidar frame, shape (columns, beams, 3).

        Columns turn from the x axis to the y axis.
        """
        azimuth = 2 * np.pi * np.arange(self.columns)[:, None] / self.columns
        elevation = np.deg2rad(np.linspace(self.lowest, self.highest, self.beams))
        flat, up = np.cos(elevation), np.sin(elevation)
        rays = (
            np.cos(azimuth) * flat,
            np.sin(azimuth) * flat,
            np.broadcast_to(up, (1, self.beams)),
        )
        return np.stack(np.broadcast_arrays(*rays), axis=-1)


class RayCaster:
    """Solid boxes as a mesh that rays are cast at.

    Parameters
    ----------
    solids
        At least one box.

    Raises
    ------
    ConfigError
        The libraries that cast rays are not installed.
    """

    def __init__(self, solids: Solids) -> None:
        try:
            from trimesh import Trimesh
            from trimesh.ray.ray_pyembree import RayMeshIntersector
        except ImportError as error:
            raise ConfigError(MISSING) from error
        # Not processed: vertices of boxes that touch must not be merged.
        mesh = Trimesh(solids.vertices(), solids.triangles(), process=False)
        self._intersector = RayMeshIntersector(mesh)
        corners = solids.vertices()[solids.triangles()]
        self._anchor = corners[:, 0]
        self._normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    def ranges(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """Return how far rays go before they meet a surface, infinity where they meet none.

        Which surface a ray meets first is found in single precision, where in double precision.

        Parameters
        ----------
        origins
            In the map in metres, shape (N, 3).
        directions
            Unit vectors in the map, shape (N, 3).

        Returns
        -------
        In metres, shape (N,).
        """
        met = np.asarray(self._intersector.intersects_first(origins, directions))
        found = np.full(len(origins), np.inf)
        hit = np.flatnonzero(met >= 0)
        # The distance along the ray to the plane of the triangle that it meets.
        anchor, normal = self._anchor[met[hit]], self._normal[met[hit]]
        height = np.einsum("ni,ni->n", normal, anchor - origins[hit])
        found[hit] = height / np.einsum("ni,ni->n", normal, directions[hit])
        return found


@dataclass(frozen=True)
class SimulatedScans:
    """The scans of a drive, each made when it is asked for and the same whenever it is.

    Attributes
    ----------
    poses_at
        Where it truly is.
    stamp_ns
        Begin of each scan in nanoseconds, shape (N,).
    seed
        Of the ranges' noise.
    """

    caster: RayCaster
    options: SpinningLidarOptions
    poses_at: PosesAt
    stamp_ns: IntArray
    seed: int = 0

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def __iter__(self) -> Iterator[Scan]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> Scan:
        """Return a scan; points that are too near, too far or nowhere are left out."""
        if not 0 <= index < len(self):
            raise IndexError(index)
        options, stamp = self.options, int(self.stamp_ns[index])
        rays = options.directions()
        seconds = options.sweep * np.arange(options.columns) / options.columns
        poses = self.poses_at(stamp + np.round(seconds * NANOSECONDS).astype(np.int64))
        directions = (rays @ poses.R.swapaxes(1, 2)).reshape(-1, 3)
        exact = self.caster.ranges(np.repeat(poses.p, options.beams, axis=0), directions)
        noise = np.random.default_rng([self.seed, index]).normal(0.0, options.noise, len(exact))
        measured = exact + noise
        kept = (measured >= options.nearest) & (measured <= options.furthest)
        points = measured[kept, None] * rays.reshape(-1, 3)[kept]
        times = np.repeat(seconds, options.beams)[kept] if options.sweep > 0 else None
        return Scan(stamp, points, times)


def scan_stamps(
    options: SpinningLidarOptions, duration: float, rng: np.random.Generator
) -> IntArray:
    """Return when scans begin that end within ``duration`` seconds, in nanoseconds, shape (N,).

    The first one begins at a random share of the interval: sources are not synchronised.
    """
    first = rng.uniform() / options.rate
    count = int(max(0.0, duration - options.sweep - first) * options.rate) + 1
    seconds = first + np.arange(count) / options.rate
    within = seconds + options.sweep <= duration
    return np.round(seconds[within] * NANOSECONDS).astype(np.int64)
