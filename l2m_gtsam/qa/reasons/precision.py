"""How exact a calibration is, and what its exactness rests on."""

import numpy as np

from l2m_gtsam.qa.reasons.reason import Case, Level, Reason, against
from l2m_gtsam.records.calibration import Uncertainty


def precision(case: Case) -> list[Reason]:
    """Return sigmas that are too large, and reasons to think that they are too small."""
    return [*_sigmas(case), *_correlated(case), *_priors(case)]


def _sigmas(case: Case) -> list[Reason]:
    sensor, options = case.sensor, case.options
    t, H = _finite(sensor.t_sigma), _finite(sensor.H_sigma)
    angle = np.rad2deg(_finite(np.sqrt(np.diag(sensor.rotation_covariance))))
    return [
        *against(
            t, options.position_sigma_m, f"Its place is only known to ± {1e3 * t:.1f} mm (1 sigma)."
        ),
        *against(
            angle, options.rotation_sigma_deg, f"Its rotation is only known to ± {angle:.1f}°."
        ),
        *against(H, options.hard_iron_sigma_ut, f"Its offset H is only known to ± {H:.2g} µT."),
    ]


def _finite(sigmas: np.ndarray) -> float:
    """Return the largest sigma; those of what is open are told as such."""
    return float(max(sigmas[np.isfinite(sigmas)], default=0.0))


def _correlated(case: Case) -> list[Reason]:
    if case.metrics is None or case.result.uncertainty is Uncertainty.FULL:
        return []
    found = case.metrics.autocorrelation
    if found.next <= case.options.autocorrelation:
        return []
    times = (case.metrics.fit.readings / found.independent) ** 0.5
    return [
        Reason(
            Level.WARN,
            f"Neighbouring readings err together (correlation {found.next:.2f}), but its sigmas "
            f"count each by itself: they are too small, by about {times:.1f} times.",
        )
    ]


def _priors(case: Case) -> list[Reason]:
    return [
        Reason(Level.PASS, f"Not from this drive but from what was known beforehand: {each}.")
        for each in case.sensor.from_priors
    ]
