"""What is taken of a mapping suite before its own drive has told anything."""

from pydantic import Field

from l2m_gtsam.options import Options
from l2m_gtsam.recording.sync import SyncOptions


class SuiteOptions(Options):
    """How the sensors of a mapping suite are calibrated from their own drive."""

    sync: SyncOptions = SyncOptions(thin_distance_m=0.03, thin_angle_deg=5.0)
    """Which readings enter. One place seen with two headings tells most of the sensors."""
    position_m: float = Field(default=0.3, gt=0)
    """How far a sensor may sit from where it is assumed, along each axis: standard deviation in
    metres. Assumed is the lidar's origin, or what a suite says that is given to start from."""
    matrix: float = Field(default=0.1, gt=0, lt=1)
    """How far each entry of C may be from what is assumed, the identity if nothing is given."""
    offset_ut: float = Field(default=20.0, gt=0)
    """How far H may be from what is assumed, zero if nothing is given, in microtesla."""
    clock_s: float = Field(default=0.02, gt=0)
    """How far a sensor's clock may be off, in seconds."""
    windows: int = Field(default=4, ge=1)
    """Parts of the survey that are looked at, spread over it."""
    readings: int = Field(default=3000, ge=100)
    """The most readings of one of them."""
    modes: int = Field(default=300, ge=50)
    """About how many waves describe the field in one of them; time goes with the square."""
    rounds: int = Field(default=6, ge=1)
    """How often strength and depth of the field's sources are learnt anew, at the most."""
    steps: int = Field(default=10, ge=1)
    """The most steps of the solve in one round."""
