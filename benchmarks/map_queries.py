"""Maps: seconds to learn, build and load, and queries per second, beside scikit-learn.

The survey is a warehouse of 45 x 35 m with dipoles under the floor and above: lanes 1.5 m apart,
nine sensors at three heights and three places abreast, 40,000 readings of three axes. The peer is
one GaussianProcessRegressor over a part of the survey that it can stand, with a gradient from
central differences; the sliding map answers the same queries from the same readings and the same
hyperparameters.

On matrices of this size BLAS threads gain little on idle cores and lose much on shared ones:
OPENBLAS_NUM_THREADS=1 is the setting to compare figures with.
"""

from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from benchmarks.timing import seconds
from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.build import map_from_state
from l2m_gtsam.maps.hyperparameters import KernelHyperparameters
from l2m_gtsam.maps.sliding_gp import SlidingGP, SlidingGPOptions
from l2m_gtsam.maps.training import ThinningOptions, TrainingSet, checked_readings
from tests.worlds.exact import DipoleWorld

SIZE = np.array([45.0, 35.0])  # metres
READINGS = 40_000
PEER_READINGS = 2_000
NOISE = 0.1  # uT


def within(data: TrainingSet, half: float) -> TrainingSet:
    """Return the part in a square of this half-width about the middle."""
    return data[np.flatnonzero(np.abs(data.points[:, :2] - SIZE / 2).max(axis=1) < half)]


def warehouse() -> DipoleWorld:
    """Return dipoles a metre apart, in the floor and above the drive."""
    rng = np.random.default_rng(0)
    count = int(SIZE.prod() * 0.4)
    positions = rng.uniform([-1, -1, 0], [*(SIZE + 1), 1], (count, 3))
    positions[:, 2] = np.where(rng.random(count) < 0.6, -0.9, 3.0)
    return DipoleWorld(np.array([22.0, 3.0, -38.0]), positions, rng.normal(0, 25, (count, 3)))


def survey(world: DipoleWorld) -> TrainingSet:
    """Return what nine sensors read on parallel lanes."""
    rng = np.random.default_rng(1)
    lanes = np.arange(0.5, SIZE[1], 1.5)[:, None] + np.array([-0.5, 0.0, 0.5])
    along = np.linspace(0, SIZE[0], round(READINGS / lanes.size / 3))
    grid = np.meshgrid(along, lanes.ravel(), [0.2, 0.5, 0.8], indexing="ij")
    points = np.column_stack([axis.ravel() for axis in grid]) + rng.normal(
        0, 0.02, (grid[0].size, 3)
    )
    parts = np.array_split(points, len(points) // 500)  # 500 points times 630 dipoles at once
    field = np.concatenate([world.field_and_gradient(part)[0] for part in parts])
    return checked_readings(points, field + rng.normal(0, NOISE, field.shape))


def scattered(count: int, half: FloatArray) -> FloatArray:
    """Return query points about the middle of the warehouse, shape (count, 3)."""
    rng = np.random.default_rng(2)
    middle = np.array([*(SIZE / 2), 0.5])
    offset = rng.uniform(-1, 1, (count, 3)) * [half[0], half[1], 0.3]
    return np.asarray(middle + offset)


def whole_map(data: TrainingSet, console: Console) -> KernelHyperparameters:
    """Print what the map of the whole warehouse costs."""
    learnt = SlidingGP.fit(data.points, data.field)
    found = learnt.trained.hyperparameters
    given = SlidingGPOptions(hyperparameters=found)
    state = learnt.to_state()
    facts = learnt.summary.facts
    table = Table("the whole warehouse", "", title=f"{len(data.points):,} readings")
    for name, value in {
        "rows kept": f"{learnt.summary.rows:,}",
        "blocks": f"{facts['blocks']}",
        "rows per block, median and most": f"{facts['readings in a block (median)']}, "
        f"{facts['readings in a block (most)']}",
        "hyperparameters": f"{found.length_scale:.2f} m, {found.signal:.2f} uT, "
        f"{found.noise:.3f} uT: {facts['hyperparameters']}",
        "learn and build (s)": f"{seconds(lambda: SlidingGP.fit(data.points, data.field), 1):.2f}",
        "build (s)": f"{seconds(lambda: SlidingGP.fit(data.points, data.field, given), 2):.2f}",
        "load (s)": f"{seconds(lambda: map_from_state(state), 2):.2f}",
        "stored arrays (MB)": f"{sum(a.nbytes for a in state.arrays.values()) / 1e6:.1f}",
    }.items():
        table.add_row(name, value)
    console.print(table)
    console.print(query_table(learnt))
    return found


def query_table(field_map: SlidingGP) -> Table:
    """Return queries per second of one map, for few and for many points."""
    table = Table("points", "field and gradient (1/s)", "with variance (1/s)", title="queries")
    for count in (1_000, 10_000, 100_000):
        points = scattered(count, SIZE / 2 - 0.5)
        plain = seconds(partial(field_map.field_and_gradient, points))
        full = seconds(partial(field_map.query, points))
        table.add_row(f"{count:,}", f"{count / plain:,.0f}", f"{count / full:,.0f}")
    return table


def peer_gradient(peer: GaussianProcessRegressor, points: FloatArray) -> FloatArray:
    """Return the gradient of the peer's mean by central differences, shape (N, 3, 3)."""
    step = 1e-4
    slopes = [
        (peer.predict(points + step * axis) - peer.predict(points - step * axis)) / (2 * step)
        for axis in np.eye(3)
    ]
    return np.stack(slopes, axis=-1)


def against_the_peer(data: TrainingSet, found: KernelHyperparameters) -> Table:
    """Return times of both on the same part of the survey, and how far they differ."""
    half = float(np.sqrt(PEER_READINGS / READINGS * SIZE.prod()) / 2)
    part = within(data, half)
    options = SlidingGPOptions(hyperparameters=found, thinning=ThinningOptions(spacing=0))
    ours = SlidingGP.fit(part.points, part.field, options)
    mean = part.field.mean(axis=0)
    kernel = ConstantKernel(found.signal**2) * RBF(found.length_scale)
    peer = GaussianProcessRegressor(kernel, alpha=found.noise**2, optimizer=None)
    points = scattered(4_000, np.full(2, half - 0.5))
    build = (
        seconds(lambda: SlidingGP.fit(part.points, part.field, options)),
        seconds(lambda: peer.fit(part.points, part.field - mean), 1),
    )
    plain = (
        seconds(lambda: ours.field_and_gradient(points)),
        seconds(lambda: (peer.predict(points), peer_gradient(peer, points)), 1),
    )
    variance = (
        seconds(lambda: ours.variance(points)),
        seconds(lambda: peer.predict(points, return_std=True), 1),
    )
    sample = ours.query(points)
    field = np.sqrt(np.nanmean((sample.field - mean - peer.predict(points)) ** 2))
    slope = np.sqrt(np.nanmean((sample.gradient - peer_gradient(peer, points)) ** 2))
    table = Table(
        "seconds",
        "sliding",
        "scikit-learn",
        "ratio",
        title=f"{len(part.points):,} readings, {len(points):,} points, no thinning",
        caption=f"they differ by {field:.4f} uT and {slope:.4f} uT/m rms: the sliding margin",
    )
    for name, (fast, slow) in {
        "build": build,
        "field and gradient": plain,
        "variance": variance,
    }.items():
        table.add_row(name, f"{fast:.3f}", f"{slow:.3f}", f"{slow / fast:,.0f}")
    return table


def main() -> None:
    console = Console()
    data = survey(warehouse())
    found = whole_map(data, console)
    console.print(against_the_peer(data, found))


if __name__ == "__main__":
    main()
