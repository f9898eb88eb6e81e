"""Options of a plan."""

from pydantic import Field

from l2m_gtsam.options import Options
from l2m_gtsam.planning.motion import MotionOptions


class PlanOptions(Options):
    """What is assumed and tried before a drive is calibrated."""

    rate_hz: float = Field(default=10.0, gt=0, le=1000)
    """Readings per second of sensors that the bag does not have yet."""
    noise_ut: float = Field(default=0.2, gt=0)
    """Standard deviation of the sensors' noise in microtesla, where neither
    `calibration.solve.sensor_noise_ut` nor the map says one: a map that learns it gives that of
    the mapping suite."""
    motion: MotionOptions = MotionOptions()
    """Extra motions that are tried."""
