"""Options of a calibration, composed of those of its steps."""

from pydantic import Field

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.changed_places import ChangesOptions
from l2m_gtsam.calibration.priors import PriorOptions
from l2m_gtsam.calibration.start.global_start import StartOptions
from l2m_gtsam.options import Options
from l2m_gtsam.recording.regressors import ResampleOptions
from l2m_gtsam.recording.sync import SyncOptions
from l2m_gtsam.solve.model_comparison import ModelOptions


class CalibrationOptions(Options):
    """How a calibration is computed from a recording and a map."""

    sync: SyncOptions = SyncOptions()
    """Which readings enter, and how they get their poses."""
    start: dict[str, tuple[float, float, float]] = Field(default_factory=dict)
    """Where the solve starts for a sensor's `t_lidar_mag`, by sensor name, metres; looked for where
    it is not given."""
    search: StartOptions = StartOptions()
    """How starts are looked for."""
    priors: PriorOptions = PriorOptions()
    """What is known of sensors beforehand: places, rotations, the geometry of arrays."""
    solve: OneKeyOptions = OneKeyOptions()
    """The one-key solve."""
    changes: ChangesOptions = ChangesOptions()
    """How places are judged that differ from the map."""
    models: ModelOptions = ModelOptions()
    """How models of each sensor are compared after the solve."""
    regressors: ResampleOptions = ResampleOptions()
    """How the numbers of `bag.regressors` get to the times of the readings."""
