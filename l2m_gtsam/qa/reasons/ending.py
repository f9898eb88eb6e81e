"""What the end of the solve says."""

import numpy as np

from l2m_gtsam.qa.metrics.misfit import fits_elsewhere
from l2m_gtsam.qa.reasons.reason import Case, Level, Reason
from l2m_gtsam.records.calibration import SensorCalibration, SensorStatus


def ending(case: Case) -> list[Reason]:
    """Return how the solve ended, where it did not end well."""
    sensor = case.sensor
    if sensor.status is SensorStatus.SOLVED:
        return []
    if sensor.status is SensorStatus.UNDETERMINED:
        return [Reason(_open(case), sentence("Not everything can be known", sensor.message))]
    if sensor.status is SensorStatus.FLIPPED_AXIS and (order := _order(case)):
        return [order]
    if sensor.status is SensorStatus.CONTRADICTED and fits_elsewhere(case.others, case.options):
        text = (
            f"{sensor.rejected} of its readings fit no calibration that explains the others, while "
            "other sensors fit the map: something about this sensor changed on the way."
        )
        return [Reason(Level.FAIL, text)]
    return [Reason(Level.FAIL, sentence(_head(sensor), sensor.message))]


def sentence(head: str, message: str) -> str:
    """Return a message of the solve as a sentence with a heading."""
    return f"{head}: {message}" + ("" if message.endswith((".", "?")) else ".")


def _head(sensor: SensorCalibration) -> str:
    if sensor.status is SensorStatus.CONTRADICTED and sensor.rejected:
        return "Its readings contradict the map or what is known"
    return _HEADS[sensor.status]


_HEADS = {
    SensorStatus.NOT_CONVERGED: "The solve did not converge",
    SensorStatus.NO_READINGS: "There is nothing to calibrate on",
    SensorStatus.OUTSIDE_MAP: "The map does not cover the drive",
    SensorStatus.DEAD_AXIS: "An axis is dead",
    SensorStatus.AMBIGUOUS: "Its place is not certain",
    SensorStatus.CONTRADICTED: "What is known contradicts the readings",
    SensorStatus.FLIPPED_AXIS: "An axis is reversed",
}


def _open(case: Case) -> Level:
    """Return how grave it is: a place or rotation that is open fails, an offset only warns."""
    known = np.isfinite(np.diag(case.sensor.covariance))
    angles = np.isfinite(np.diag(case.sensor.rotation_covariance))
    return Level.WARN if known[:3].all() and angles.all() else Level.FAIL


def _order(case: Case) -> Reason | None:
    """Return which two axes are swapped, where two are; a single reversed one has its message."""
    found = None if case.metrics is None else case.metrics.mounting.axes
    if found is None or not found.mirrored:
        return None
    moved = [k for k in range(3) if found.along[k][1] != "xyz"[k]]
    if len(moved) != 2 or any(found.along[k][0] == "-" for k in moved):
        return None
    one, two = ("xyz"[k] for k in moved)
    return Reason(
        Level.FAIL,
        f"Axes {one} and {two} are swapped: {one} reads along the lidar's {found.along[moved[0]]}, "
        f"{two} along its {found.along[moved[1]]}, which no mounting does; exchange them in the "
        "driver.",
    )
