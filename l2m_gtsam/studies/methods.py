"""Ways to calibrate one sensor that studies compare, each from a given start."""

from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.graph.alternation import OneKeyOptions, alternate, start_estimate
from l2m_gtsam.graph.calibration import Estimate
from l2m_gtsam.graph.view import QueryableMap
from l2m_gtsam.solve.closed_form import ClosedFormOptions


def two_step(
    readings: Readings, field_map: QueryableMap, t_start: FloatArray, closed_form: ClosedFormOptions
) -> Estimate:
    """Return where closed form and translation graph settle in turns, without a joint graph.

    Parameters
    ----------
    readings
        Of one sensor.
    field_map
        The magnetic map.
    t_start
        The guess in the lidar frame in metres, shape (3,).
    closed_form
        The inner step.
    """
    options = OneKeyOptions(closed_form=closed_form, alternation_readings=len(readings))
    start = start_estimate(t_start[None], options)
    return alternate(readings, field_map, start, options, lambda *_: None).estimate
