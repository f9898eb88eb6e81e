"""What is read from a recording, and how."""

from enum import StrEnum
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.errors import BagError
from l2m_gtsam.options import Options
from l2m_gtsam.storage.units import Unit, Units

STEP = r"[A-Za-z][A-Za-z0-9_]{0,99}(\[[0-9]{1,6}\])?"
PATH = rf"^{STEP}(\.{STEP}){{0,19}}$"

RegressorName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,99}$")]
"""Letters, digits and underscores, a letter first."""


def _not_nothing(scale: float) -> float:
    if scale == 0:
        raise ValueError("a scale of 0 leaves nothing of the number")
    return scale


class RegressorTopic(Options):
    """Where a number is found that goes along with a drive."""

    topic: str = Field(min_length=1)
    """Topic of any type; the leading slash does not matter."""
    field: str = Field(default="data", pattern=PATH)
    """Where the number is in a message: names with dots between, an element of an array with
    its index, for example `current`, `twist.twist.linear.x` or `data[2]`."""
    scale: Annotated[float, AfterValidator(_not_nothing)] = 1.0
    """Factor on the number; coefficients are in microtesla per unit of the product."""


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

    @property
    def ends(self) -> tuple[str, str]:
        """Both frames, as tf2 writes them."""
        return self.frame.lstrip("/"), self.child_frame.lstrip("/")


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


def _listed(value: Any) -> Any:
    """Return a single text as a list of one."""
    return (value,) if isinstance(value, str) else value


def _units(value: Any) -> Units:
    """Return a named unit, or microtesla per count."""
    if isinstance(value, str) and value in list(Unit):
        return Unit(value)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and 0 < value < float("inf"):
        return float(value)
    accepted = ", ".join(Unit)
    raise ValueError(f"accepted: {accepted}, or a positive number, microtesla per count")


class TimeUnit(StrEnum):
    """Unit of the times in a table."""

    AUTO = "auto"
    SECONDS = "s"
    MILLISECONDS = "ms"
    MICROSECONDS = "us"
    NANOSECONDS = "ns"


Names3 = tuple[str, str, str]


class ColumnOptions(Options):
    """Which columns of a CSV file are what; what is not given follows from the names."""

    stamp: str | None = None
    """Column of the times."""
    time_unit: TimeUnit = TimeUnit.AUTO
    """Unit of the times; `auto` takes that of the column's name, else the one that makes a date of
    today, else seconds."""
    fields: dict[str, Names3] = Field(default_factory=dict)
    """Columns x, y and z of each magnetometer, by a name of your choice."""
    position: Names3 | None = None
    """Columns x, y and z of the position in metres."""
    orientation: tuple[str, str, str, str] | None = None
    """Columns x, y, z and w of the quaternion."""


class PoseFileOptions(Options):
    """Poses from a file of their own: TUM, KITTI with a file of times, or CSV."""

    path: Path | None = None
    """The file, for all logs that `paths` does not name; `--poses` sets it."""
    paths: dict[str, Path] = Field(default_factory=dict)
    """A file for each log, by the log's path as it is given."""
    times: Path | None = None
    """Times of KITTI's poses in seconds, a line each; `--pose-times` sets it."""
    offset_s: float = 0.0
    """Added to the times of the poses, where their clock is not that of the readings."""
    columns: ColumnOptions = ColumnOptions()
    """Columns of a CSV file with poses."""

    def of(self, log: Path) -> Path | None:
        """Return the file with the poses of a log, if there is one."""
        return self.paths.get(str(log), self.path)


Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
Axes = tuple[Axis, Axis, Axis]


def _each_once(axes: Axes) -> Axes:
    """Refuse an axis that is there twice."""
    if sorted(axis[-1] for axis in axes) != list("xyz"):
        raise ValueError("each of x, y and z must be there once, with or without a minus")
    return axes


class BagOptions(Options):
    """What is read from a recording, and how."""

    fields: Annotated[tuple[str, ...], BeforeValidator(_listed), Field(min_length=1)] = ("*",)
    """Topics of the magnetometers, one or a list, names or globs; the leading slash does not
    matter. Of any type: `TOPIC:PATH` names the vector in its messages, as in `/imu/data:mag`."""
    split_by_frame: bool = False
    """Whether one topic carries several sensors, distinguished by `header.frame_id`; sensors are
    then named after their frame instead of their topic."""
    poses: str | None = None
    """Topic of the poses: Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped or
    Path; if not given, the only such topic of the bag, Odometry first."""
    tf: TfChain | None = None
    """Compose the poses from /tf and /tf_static instead."""
    pose_file: PoseFileOptions = PoseFileOptions()
    """Poses from a file instead."""
    columns: ColumnOptions = ColumnOptions()
    """Columns of a log in CSV."""
    tracked_to_lidar: FixedTransform = FixedTransform()
    """T_tracked_lidar: the lidar in the frame that the poses track."""
    frame: str | None = None
    """Name to give the frame that the poses are in, where the bag calls the map's otherwise."""
    stamps: Stamps = Stamps.HEADER
    """`header`, or `record` for the time at which the bag received a message."""
    units: Annotated[Units, BeforeValidator(_units)] = Unit.AUTO
    """Unit of the readings: `auto` takes the one that their type prescribes (tesla in ROS) and
    refuses a strength that does not fit; or `tesla`, `millitesla`, `microtesla`, `nanotesla`,
    `gauss`, `milligauss`; or a number, microtesla per count of the sensor."""

    axes: dict[str, Annotated[Axes, AfterValidator(_each_once)]] = Field(default_factory=dict)
    """For drivers that mix axes: which axes of the readings are x, y and z of a sensor, by its name
    (`*` stands for anything), as `{mag_0: [y, -x, z]}`."""

    regressors: dict[RegressorName, RegressorTopic] = Field(default_factory=dict)
    """Numbers that `l2m calibrate` reads beside the readings, by names of your choice: motor
    currents, speeds, duty cycles. What follows them is separated from the map's field."""

    def in_order(self, sensor: str, field: FloatArray) -> FloatArray:
        """Return a sensor's readings, shape (N, 3), along its axes as `axes` has them."""
        fitting = [axes for name, axes in self.axes.items() if fnmatchcase(sensor, name)]
        if not fitting:
            return field
        columns = ["xyz".index(axis[-1]) for axis in fitting[0]]
        signs = np.array([-1.0 if axis.startswith("-") else 1.0 for axis in fitting[0]])
        return np.asarray(field[:, columns] * signs)

    @model_validator(mode="after")
    def _one_source_of_poses(self) -> "BagOptions":
        if self.poses is not None and self.tf is not None:
            raise ValueError("give `poses` or `tf`, not both")
        return self
