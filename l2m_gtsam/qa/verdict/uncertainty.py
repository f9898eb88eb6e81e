"""Where the uncertainty of a calibration comes from, and what would help."""

from collections.abc import Sequence

from l2m_gtsam.records.stated_size import StatedSize
from l2m_gtsam.records.variance_shares import ErrorCause, VarianceShare
from l2m_gtsam.records.verdict import Level, Reason

NAMES = {
    ErrorCause.NOISE: "noise",
    ErrorCause.MAP: "map",
    ErrorCause.SUITE: "the survey's sensors",
    ErrorCause.POSES: "poses",
    ErrorCause.WANDER: "wander of H",
    ErrorCause.FIELD: "a field that changed",
    ErrorCause.WARP: "a bent frame",
    ErrorCause.CURRENTS: "recorded numbers",
    ErrorCause.PRIORS: "priors",
    ErrorCause.UNMODELLED: "not modelled",
}
REMEDIES = {
    ErrorCause.NOISE: "a longer drive, through more places and headings",
    ErrorCause.MAP: "a denser survey of where the vehicle drives",
    ErrorCause.SUITE: "a survey with calibrated sensors (`l2m map suite`)",
    ErrorCause.POSES: "better poses",
    ErrorCause.WANDER: "a sensor that is warm, away from currents",
    ErrorCause.FIELD: "a new survey, or a drive while nothing near by changes",
    ErrorCause.WARP: "poses on the same point cloud for survey and drive",
    ErrorCause.CURRENTS: "a drive on which the recorded numbers change more",
    ErrorCause.PRIORS: "a drive that determines what now comes from priors",
    ErrorCause.UNMODELLED: "stated errors of poses and of the survey's sensors",
}
LISTED = 0.01  # of a variance


STATED = {
    ErrorCause.NOISE: (
        "sigmas stated of the noise of {sensor}",
        "calibration.solve.sensor_noise_ut",
    ),
    ErrorCause.POSES: ("sigmas stated of the poses", "calibration.solve.pose_noise, or the bag"),
}


def stated_wrongly(stated: Sequence[StatedSize]) -> list[Reason]:
    """Return what was stated that the readings speak against."""
    return [
        Reason(Level.WARN, _wrong(each))
        for each in stated
        if each.is_wrong and each.cause in STATED
    ]


def _wrong(found: StatedSize) -> str:
    what, where = STATED[found.cause]
    what = what.format(sensor=found.sensor)
    if found.ratio > 1:
        return (
            f"The {what} are too small: the readings show {found.ratio:.1f} times as much, and "
            f"sigmas are too small. Correct them ({where})."
        )
    return (
        f"The {what} are too large: the readings show {found.ratio:.2f} times as much, and sigmas "
        f"are too large. Correct them ({where})."
    )


def shares_in_words(shares: Sequence[VarianceShare], of: str) -> str:
    """Return the shares in the variance of ``t``, ``C`` or ``H``, the largest first."""
    sizes = sorted(((getattr(each, of), NAMES[each.cause]) for each in shares), reverse=True)
    return ", ".join(f"{name} {size:.0%}" for size, name in sizes if size >= LISTED)


def what_helps(shares: Sequence[VarianceShare]) -> str:
    """Return what would lower the variance of t most, or of H where t is not determined."""
    of = "t" if any(each.t for each in shares) else "H"
    return REMEDIES[max(shares, key=lambda each: float(getattr(each, of))).cause]
