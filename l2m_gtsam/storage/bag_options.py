"""What is read from a recording, and how; whether a field strength fits its unit.

Anywhere on Earth, also near steel, a field is 10 to 200 uT strong. Drivers publish gauss,
microtesla or bare directions under the name of tesla; the strength reveals it.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator, model_validator
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.errors import BagError
from l2m_gtsam.options import Options

PLAUSIBLE_UT = (10.0, 200.0)
EARTH_UT = 50.0
# A strength that is constant to this, relative, over many readings was normalised.
CONSTANT = 1e-6
ENOUGH_READINGS = 20
# Readings that differ by less, relative, are a sensor at rest, whatever its rounding.
TURNED = 1e-3


class Unit(StrEnum):
    """Unit of the readings in a bag."""

    AUTO = "auto"
    TESLA = "tesla"
    MILLITESLA = "millitesla"
    MICROTESLA = "microtesla"
    NANOTESLA = "nanotesla"
    GAUSS = "gauss"
    MILLIGAUSS = "milligauss"


MICROTESLA_PER = {
    Unit.AUTO: 1e6,  # what ROS prescribes; the strength is judged
    Unit.TESLA: 1e6,
    Unit.MILLITESLA: 1e3,
    Unit.MICROTESLA: 1.0,
    Unit.NANOTESLA: 1e-3,
    Unit.GAUSS: 100.0,
    Unit.MILLIGAUSS: 0.1,
}
# In order of how often drivers publish them; 1 mG is 0.1 uT, so that some strengths fit two.
SUSPECTS = (Unit.GAUSS, Unit.MICROTESLA, Unit.NANOTESLA, Unit.MILLIGAUSS, Unit.MILLITESLA)


@dataclass(frozen=True)
class Strength:
    """Smallest, median and largest |B| of a sensor in uT as read; NaN without a finite reading."""

    low: float
    median: float
    high: float
    readings: int


def strength(field: FloatArray) -> Strength:
    """Summarise |B| of readings in uT, shape (N, 3); readings with a NaN axis do not count."""
    norm = np.linalg.norm(field[np.isfinite(field).all(axis=1)], axis=1)
    if not len(norm):
        return Strength(float("nan"), float("nan"), float("nan"), 0)
    return Strength(float(norm.min()), float(np.median(norm)), float(norm.max()), len(norm))


def is_turning(field: FloatArray) -> bool:
    """Return whether readings, shape (N, 3), turn: a stuck sensor is not a direction."""
    finite = field[np.isfinite(field).all(axis=1)]
    if not len(finite):
        return False
    return bool(np.ptp(finite, axis=0).max() > TURNED * np.abs(finite).max())


def fault(found: Strength, turning: bool, unit: Unit) -> str | None:
    """Return what is wrong with a strength, as half a sentence; None where nothing is.

    Parameters
    ----------
    found
        Strength in uT after conversion from ``unit``.
    turning
        Whether the direction of the readings changes.
    unit
        The unit that was assumed; only `AUTO` is judged by strength.
    """
    constant = found.high - found.low <= CONSTANT * found.median
    if not found.readings or (constant and not turning):
        return None  # dead or stuck, not in a wrong unit: the calibration says so of it alone
    if constant and found.readings >= ENOUGH_READINGS:
        return (
            f"every reading is {found.median * 1e-6:.4g} long, as read in tesla: directions "
            "without a strength (no unit at all), which cannot be calibrated; record the raw field"
        )
    if unit is not Unit.AUTO or PLAUSIBLE_UT[0] <= found.median <= PLAUSIBLE_UT[1]:
        return None
    low, high = PLAUSIBLE_UT
    return (
        f"a typical |B| of {found.median:.4g} uT, as read in tesla, is not the {low:g} to "
        f"{high:g} uT found on Earth; {_suspicion(found.median * 1e-6)}"
    )


def _suspicion(as_written: float) -> str:
    """Return the likely unit of a strength as written in the message."""
    fitting = [
        unit
        for unit in SUSPECTS
        if PLAUSIBLE_UT[0] <= as_written * MICROTESLA_PER[unit] <= PLAUSIBLE_UT[1]
    ]
    if not fitting:
        return f"{as_written:.4g} fits no unit of field; name it with the option `units:`"
    likely = min(fitting, key=lambda unit: _distance(as_written * MICROTESLA_PER[unit]))
    return f"it is likely {likely.value}: set the option `units: {likely.value}`"


def _distance(field_ut: float) -> float:
    return float(abs(np.log(field_ut / EARTH_UT)))


STEP = r"[A-Za-z][A-Za-z0-9_]{0,99}(\[[0-9]{1,6}\])?"
PATH = rf"^{STEP}(\.{STEP}){{0,19}}$"

RegressorName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,99}$")]
"""Letters, digits and underscores, a letter first."""


class RegressorTopic(Options):
    """Where a number is found that goes along with a drive."""

    topic: str = Field(min_length=1)
    """Topic of any type; the leading slash does not matter."""
    field: str = Field(default="data", pattern=PATH)
    """Where the number is in a message: names with dots between, an element of an array with
    its index, for example `current`, `twist.twist.linear.x` or `data[2]`."""
    scale: float = 1.0
    """Factor on the number; coefficients are in microtesla per unit of the product."""

    @field_validator("scale")
    @classmethod
    def _not_nothing(cls, scale: float) -> float:
        if scale == 0:
            raise ValueError("a scale of 0 leaves nothing of the number")
        return scale


class Stamps(StrEnum):
    """Which time of a message counts."""

    HEADER = "header"
    RECORD = "record"


class TfChain(Options):
    """Two frames between which poses are composed."""

    frame: str
    """Reference frame, for example `map`."""
    child_frame: str
    """Tracked frame, for example `base_link`."""
    max_gap_s: float = Field(default=1.0, gt=0)
    """No pose is made where two transforms of a link in the chain are further apart."""


class FixedTransform(Options):
    """A rigid transform as numbers."""

    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Metres."""
    quaternion_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Rotation; of any length but zero."""

    def rigid(self) -> RigidTransform:
        """Return the transform as matrix and vector.

        Raises
        ------
        BagError
            The quaternion is all zero.
        """
        if not any(self.quaternion_xyzw):
            raise BagError(
                "bag.tracked_to_lidar: the quaternion is all zero, it must be a rotation"
            )
        R = Rotation.from_quat(self.quaternion_xyzw).as_matrix()
        return RigidTransform(R, np.array(self.translation))


class BagOptions(Options):
    """What is read from a recording, and how."""

    fields: Annotated[tuple[str, ...], Field(min_length=1)] = ("*",)
    """Topics of type sensor_msgs/MagneticField, names or globs; the leading slash does not
    matter."""
    split_by_frame: bool = False
    """Whether one topic carries several sensors, distinguished by `header.frame_id`; sensors are
    then named after their frame instead of their topic."""
    poses: str | None = None
    """Topic of the poses: Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped;
    if not given, the only such topic of the bag, Odometry first."""
    tf: TfChain | None = None
    """Compose the poses from /tf and /tf_static instead."""
    tracked_to_lidar: FixedTransform = FixedTransform()
    """T_tracked_lidar: the lidar in the frame that the poses track."""
    frame: str | None = None
    """Name to give the frame that the poses are in, where the bag calls the map's otherwise."""
    stamps: Stamps = Stamps.HEADER
    """`header`, or `record` for the time at which the bag received a message."""
    units: Unit = Unit.AUTO
    """Unit of the readings: `auto` takes tesla, as ROS prescribes, and refuses a strength that
    does not fit; or `tesla`, `millitesla`, `microtesla`, `nanotesla`, `gauss`, `milligauss`."""

    regressors: dict[RegressorName, RegressorTopic] = Field(default_factory=dict)
    """Numbers that `l2m calibrate` reads beside the readings, by names of your choice: motor
    currents, speeds, duty cycles. What follows them is separated from the map's field."""

    @model_validator(mode="after")
    def _one_source_of_poses(self) -> "BagOptions":
        if self.poses is not None and self.tf is not None:
            raise ValueError("give `poses` or `tf`, not both")
        return self
