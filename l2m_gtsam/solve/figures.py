"""Figures of fit."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.calibration import ResidualFigures


def residual_figures(residual: FloatArray, whitening: FloatArray, taken: float) -> ResidualFigures:
    """Summarise the residuals of one sensor.

    Parameters
    ----------
    residual
        ``C b + H - z`` in uT, shape (N, 3).
    whitening
        Matrices that make them white, shape (N, 3, 3).
    taken
        Degrees of freedom that the fit took; see ``estimate_noise``.
    """
    norm = np.linalg.norm(residual, axis=1)
    white = np.einsum("nij,nj->ni", whitening, residual)
    freedom = max(residual.size - taken, 1)
    return ResidualFigures(
        readings=len(residual),
        rms_axes=np.sqrt(np.mean(residual**2, axis=0)),
        rms=float(np.sqrt(np.mean(norm**2))),
        median_norm=float(np.median(norm)),
        p95_norm=float(np.quantile(norm, 0.95)),
        max_norm=float(norm.max()),
        chi2_per_dof=float(np.sum(white**2) / freedom),
    )
