"""Prints a digest of what each of some kernels computes: run as a module, by a test."""

from hashlib import sha256

import numpy as np

from l2m_gtsam.maps.harmonic.compiled_tile import CompiledTile, TermSum
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.modes import add_waves
from l2m_gtsam.maps.harmonic.near_sources import PointSources, near_sources
from l2m_gtsam.maps.harmonic.potential_grid import PotentialGrid, spline_derivatives
from l2m_gtsam.solve.profile import write_trimmed

COUNT, WAVES = 400, 60


def main() -> None:
    """Print a line for each of the kernels that work with others."""
    rng = np.random.default_rng(0)
    field, gradient = np.zeros((COUNT, 3)), np.zeros((COUNT, 3, 3))
    points = rng.uniform(3.0, 7.0, (COUNT, 3))
    numbers, kz = rng.integers(0, 12, (WAVES, 2)), rng.random(WAVES)
    steps, weights = np.array([0.3, 0.4]), rng.normal(size=WAVES)
    add_waves(points, steps, 0.2, numbers, kz, weights, field, gradient)
    print("add_waves", digest(field, gradient))
    coefficients = rng.normal(size=(24, 24, 24))
    spline_derivatives(points, np.zeros(3), 0.5, coefficients, field, gradient)
    print("spline_derivatives", digest(field, gradient))
    print("compiled tile", digest(*tile(rng).field_and_gradient(points)))
    b, z = rng.normal(size=(20, 3, COUNT)), rng.normal(size=(4, 3, COUNT))
    inside, has = (np.where(rng.random((n, COUNT)) < 0.95, 1.0, 0.0) for n in (20, 4))
    rms = np.empty((20, 4))
    write_trimmed(b, inside, z, has, 0.8, rms)
    print("write_trimmed", digest(rms))


def tile(rng: np.random.Generator) -> CompiledTile:
    """Return a tile with a grid and sources near the points."""
    frame = TileFrame(np.eye(3), np.zeros(3), np.array([8.0, 8.0]), 8.0)
    sources = PointSources(rng.uniform(3.0, 7.0, (WAVES, 3)), rng.normal(size=(WAVES, 3)))
    grid = PotentialGrid(np.zeros(3), 0.5, rng.normal(size=(24, 24, 24)))
    near = near_sources(sources, np.zeros(3), np.full(3, 12.0), 1.0)
    walls = (np.full(3, 2.0), np.full(3, 8.0))
    return CompiledTile(frame, walls, grid, near, lambda: TermSum(sources, ()))


def digest(*arrays: np.ndarray) -> str:
    """Return a digest of the bits of some arrays."""
    return sha256(b"".join(each.tobytes() for each in arrays)).hexdigest()


if __name__ == "__main__":
    main()
