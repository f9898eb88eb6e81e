"""How well readings fit, beside what a field without structure would explain."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.metrics.evidence import SensorEvidence
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.records.metrics import Fit, Normalised
from l2m_gtsam.solve.chi_square import quantile

BINS = 24


def fit_figures(evidence: SensorEvidence, noise: float) -> Fit:
    """Return residuals, and what sensor, map and poses contribute to them."""
    used = evidence.used
    e, B = evidence.residual[used], evidence.B_map[used]
    poses = np.einsum("nii->n", evidence.pose_share[used]) / 3
    return Fit(
        readings=int(used.sum()),
        sensor_noise=noise,
        map_noise=float(np.sqrt(evidence.map_variance[used].mean())),
        pose_noise=float(np.sqrt(poses.mean())),
        mean=row(e.mean(axis=0)),
        rms=row(np.sqrt(np.mean(e**2, axis=0))),
        anomaly=float(np.sqrt(np.mean((B - B.mean(axis=0)) ** 2))),
        without_map=_without_map(evidence),
    )


def _without_map(evidence: SensorEvidence) -> float:
    """Return what is left of the readings if the field is the same everywhere.

    As the map has it on the mean; C and H are those that explain the readings best then.
    """
    used = evidence.used
    R, z = evidence.readings.R_map_lidar[used], evidence.readings.field[used]
    b = np.einsum("nji,j->ni", R, evidence.B_map[used].mean(axis=0))
    A = np.column_stack([b, np.ones(len(b))])
    # A vehicle that keeps its heading leaves columns alike; least squares takes the shortest then.
    solution: FloatArray = np.linalg.lstsq(A, z, rcond=None)[0]
    return float(np.sqrt(np.mean((A @ solution - z) ** 2)))


def normalised_figures(evidence: SensorEvidence) -> Normalised:
    """Return how the residuals compare with the noise that the solve assumed."""
    white = evidence.white[evidence.used]
    squared = np.sum(white**2, axis=1)
    edges = np.linspace(0, quantile(0.999, 3), BINS + 1)
    counts, _ = np.histogram(np.minimum(squared, edges[-1]), edges)
    return Normalised(
        std=row(white.std(axis=0), 4),
        edges=row(edges, 4),
        counts=tuple(counts.tolist()),
        beyond_95=float(np.mean(squared > quantile(0.95, 3))),
    )
