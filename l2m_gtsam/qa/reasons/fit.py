"""How well readings, map and calibration go together."""

import numpy as np

from l2m_gtsam.qa.reasons.reason import Case, Level, Reason, against


def fit(case: Case) -> list[Reason]:
    """Return what of the readings is not explained, and how many there are."""
    sensor, options = case.sensor, case.options
    reasons = [] if case.metrics is None else [*_explained(case), *_consistent(case)]
    used = 0 if sensor.residuals is None else sensor.residuals.readings
    inside = used + sensor.rejected
    if inside:
        share = sensor.rejected / inside
        text = f"{share:.0%} of its readings fit neither map nor distortion and do not count."
        reasons += against(share, options.rejected, text)
        lost = sensor.outside_map / (inside + sensor.outside_map)
        text = f"{lost:.0%} of its readings lie outside the map and do not count."
        reasons += against(lost, options.outside_map, text)
    return reasons


def misfit(case: Case) -> bool:
    """Whether the map explains nothing: what else is found of the sensor means nothing then."""
    found = _explained(case)
    return bool(found) and found[0].level is Level.FAIL


def _explained(case: Case) -> list[Reason]:
    # Where the place is open, the field is too even to say anything of the map.
    if case.metrics is None or not np.isfinite(case.sensor.t_sigma).all():
        return []
    found = case.metrics.fit
    text = (
        f"The map leaves {found.left:.2g} µT of its readings unexplained, a field that is the same "
        f"everywhere {found.without_map:.2g} µT: "
    )
    if found.unexplained > case.options.unexplained.fail:
        text += (
            "the map does not fit this drive. Is it of this place, and are the poses in its frame? "
            "(Or the field here is too even to tell.)"
        )
    else:
        text += "it explains less than a map of this place should."
    return against(found.unexplained, case.options.unexplained, text)


def _consistent(case: Case) -> list[Reason]:
    figures = case.sensor.residuals
    if figures is None:
        return []
    chi2 = figures.chi2_per_dof
    text = (
        f"Residuals are {chi2**0.5:.1f} times as large as the noise that was assumed: sigmas are "
        "too small."
    )
    return against(chi2, case.options.chi_square, text)


def clock(case: Case) -> list[Reason]:
    """Return the time offset, where one was found that is worth mending."""
    offset, limit = case.sensor.time_offset, case.options.time_offset_s
    if offset is None or not offset.estimated or abs(offset.seconds) < 3 * offset.sigma:
        return []
    text = (
        f"Its clock is off by {1e3 * offset.seconds:.1f} ± {1e3 * offset.sigma:.1f} ms against the "
        "lidar's. That is taken into account here; correct its stamps before its readings are used."
    )
    size = abs(offset.seconds)
    return against(size, limit, text) or [Reason(Level.PASS, text)] * (size > limit.warn / 5)
