"""Where SLAM leaves GTSAM, or did: the open section on line without a map, and the Kalman update.

Processor time. BLAS threads that wait for each other count as work: set OPENBLAS_NUM_THREADS=1.
"""

from dataclasses import dataclass
from time import process_time

import gtsam
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.timing import seconds
from l2m_factors import M, X
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.joint_gaussian import JointGaussian, prior_factors
from l2m_gtsam.slam.marginals import joint_posterior
from l2m_gtsam.slam.online.belief import kalman_gain
from l2m_gtsam.slam.solver import colamd_ordering, levenberg_marquardt
from tests.reference.dense_newton import newton

STEPS = 3  # of a section's last stage, as measured


@dataclass(frozen=True)
class Section:
    """What is known of tiles and anchors, and what a stretch of the path adds to it."""

    known: JointGaussian
    graph: gtsam.NonlinearFactorGraph
    start: gtsam.Values
    sizes: dict[int, int]


def section(tiles: int, weights: int, poses: int) -> Section:
    """Return a section whose readings are linear in weights, as many as a real one has."""
    rng = np.random.default_rng(0)
    sizes = {M(n): weights for n in range(tiles)} | {X(n): 6 for n in range(tiles)}
    root = rng.normal(size=(count := sum(sizes.values()), count)) / np.sqrt(count)
    values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for key, size in sizes.items():
        values.insert(key, gtsam.Pose3() if size == 6 else np.zeros(size))
    known = JointGaussian(values, dict(sizes), 1e-2 * (root @ root.T + 0.1 * np.eye(count)))
    start = gtsam.Values(values)
    step = gtsam.noiseModel.Isotropic.Sigma(6, 0.01)
    for k in range(tiles, tiles + poses):
        start.insert(X(k), gtsam.Pose3())
        sizes[X(k)] = 6
        move = gtsam.Pose3.Expmap(rng.normal(0, 0.01, 6))
        graph.add(gtsam.BetweenFactorPose3(X(k - 1), X(k), move, step))
        graph.add(readings(k, k % tiles, rng.normal(size=(36, weights + 12))))
    return Section(known, graph, start, sizes)


def readings(pose: int, tile: int, J: FloatArray) -> gtsam.CustomFactor:
    """Return 36 residuals of a key pose, its tile's anchor and its weights."""

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        between = values.atPose3(X(tile)).between(values.atPose3(X(pose)))
        turn = gtsam.Pose3.LogmapDerivative(gtsam.Pose3.Logmap(between))
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(J[:, :6] @ turn)
            jacobians[1] = np.asfortranarray(-J[:, :6] @ turn @ between.inverse().AdjointMap())
            jacobians[2] = np.asfortranarray(J[:, 12:])
        return np.asarray(
            J[:, :6] @ gtsam.Pose3.Logmap(between) + J[:, 12:] @ values.atVector(M(tile)) - 1.0
        )

    keys = [X(pose), X(tile), M(tile)]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(36), keys, error)


def open_section(tiles: int, weights: int) -> list[str]:
    """Descend and take a covariance, by GTSAM and by the dense Newton steps of the tests."""
    given = section(tiles, weights, 36)
    priors, last = prior_factors(given.known), X(tiles + 35)

    def by_gtsam() -> None:
        whole = gtsam.NonlinearFactorGraph(given.graph)
        whole.push_back(priors)
        found = levenberg_marquardt(whole, given.start, colamd_ordering(whole), STEPS, 0.0)
        joint_posterior(whole.linearize(found.values), [last])

    dense = seconds(
        lambda: newton(given.graph, given.known, given.start, given.sizes, STEPS), 3, process_time
    )
    return [
        f"{sum(given.sizes.values()):,}",
        f"{seconds(by_gtsam, 3, process_time):.3f}",
        f"{dense:.3f}",
    ]


def kalman(count: int, seen: int) -> list[str]:
    """Take in what is seen of a dense Gaussian: Kalman's gain, and elimination by GTSAM."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(count, count)) / np.sqrt(count)
    P, J, e = root @ root.T + 0.1 * np.eye(count), rng.normal(size=(seen, count)), np.ones(seen)

    def own() -> None:
        gain = kalman_gain(P, J)
        _ = -gain @ e, P - gain @ (J @ P)

    def by_gtsam() -> None:
        graph = gtsam.GaussianFactorGraph()
        graph.add(gtsam.HessianFactor(0, np.zeros(count), P))
        graph.add(gtsam.JacobianFactor(0, J, -e, gtsam.noiseModel.Unit.Create(seen)))
        tree = graph.eliminateMultifrontal()
        _ = tree.optimize(), tree.marginalCovariance(0)

    return [
        f"{count}",
        f"{1e3 * seconds(by_gtsam, 5, process_time):.2f}",
        f"{1e3 * seconds(own, 5, process_time):.2f}",
    ]


def main() -> None:
    """Print both tables."""
    section_table = Table("open section: components", "GTSAM (s)", "dense Newton in numpy (s)")
    for tiles, weights in ((3, 100), (8, 100), (8, 200)):
        section_table.add_row(*open_section(tiles, weights))
    update = Table("update on line: components", "GTSAM (ms)", "Kalman (ms)")
    for count, seen in ((12, 36), (192, 36)):
        update.add_row(*kalman(count, seen))
    for table in (section_table, update):
        Console().print(table)


if __name__ == "__main__":
    main()
