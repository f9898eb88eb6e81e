"""Whether it is one sensor that does not fit, or the map or drive that all share."""

from collections.abc import Sequence

from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.records.metrics import Halves, SensorMetrics


def fits_elsewhere(others: Sequence[SensorMetrics], options: QaOptions) -> bool:
    """Return whether there are other sensors and the map explains the readings of most."""
    fit = [each.fit.unexplained <= options.unexplained.warn for each in others]
    return sum(fit) > len(fit) / 2


def halves_agree(halves: Halves, options: QaOptions) -> bool:
    """Return whether two halves agree within their sigmas, or within what nobody minds."""
    if halves.reason or halves.distance <= options.halves_sigmas.warn:
        return True
    return _moved(halves, 0, 3) < options.halves_m and (
        halves.turned_deg < options.halves_deg and _moved(halves, 12, 15) < options.halves_ut
    )


def _moved(halves: Halves, first: int, end: int) -> float:
    return float(sum(each**2 for each in halves.difference[first:end]) ** 0.5)
