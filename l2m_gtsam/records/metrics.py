"""What a calibration is judged by: frozen records of plain numbers, which `metrics.json` holds.

Positions are in metres, fields in microtesla, angles in degrees, times in seconds. A number that
does not exist is NaN. Rows of axes are in the order x, y, z.
"""

from dataclasses import dataclass, field
from typing import Annotated

from l2m_gtsam.records.record import Record, Row, Rows, Shape
from l2m_gtsam.records.repeatability import Halves, Repeatability

FAR = 1e8  # metres: further than any place of the Earth from another


@dataclass(frozen=True)
class AxisOrder(Record):
    """Which axes of the lidar the axes of a sensor lie along, as nearly as any do.

    Attributes
    ----------
    along
        For the sensor's x, y and z: an axis of the lidar with its sign, "+x" to "-z".
    off_deg
        Angle of the axis that lies furthest from what is said of it.
    mirrored
        Whether the three are no rotation: an axis is reversed, or two are swapped.
    """

    along: tuple[str, str, str]
    off_deg: float
    mirrored: bool

    @property
    def usual(self) -> bool:
        """Whether the sensor's axes lie along the lidar's own."""
        return self.along == ("+x", "+y", "+z")

    @property
    def in_order(self) -> str:
        """What `bag.axes` has to say so that they do: axes of the sensor for x, y and z."""
        found = {
            where[1]: where[0].strip("+") + own
            for own, where in zip("xyz", self.along, strict=True)
        }
        return f"[{', '.join(found[axis] for axis in 'xyz')}]"


@dataclass(frozen=True)
class Mounting(Record):
    """What C and H mean for a person.

    Attributes
    ----------
    scale
        Gain of each sensor axis: length of its row of C.
    skew_deg
        By how much the angles between the sensor's axes differ from a right angle: xy, yz, zx.
    angle_deg
        How far the sensor is turned against the lidar.
    turned_about
        Axis of that rotation in the lidar frame, length 1.
    angle_sigma_deg
        Largest standard deviation of the rotation about any of the sensor's axes.
    hard_iron
        Length of H.
    axes
        Which axes of the lidar its axes lie along.
    """

    scale: Annotated[Row, Shape("3")]
    skew_deg: Annotated[Row, Shape("3")]
    angle_deg: float
    turned_about: Annotated[Row, Shape("3")]
    angle_sigma_deg: float
    hard_iron: float
    axes: AxisOrder


@dataclass(frozen=True)
class FitFigures(Record):
    """How well one sensor's readings fit, and what its sigmas rest on.

    Attributes
    ----------
    readings
        That count.
    sensor_noise, map_noise, pose_noise
        What the sensor, the map's uncertainty and the poses' contribute to a residual, per axis,
        root mean square.
    mean, rms
        Of the residuals, per axis.
    anomaly
        How much the field that the map predicts differs from a uniform one along the drive, per
        axis, root mean square: what determines the position.
    without_map
        What is left of the readings, per axis, if the field is taken to be uniform.
    """

    readings: int
    sensor_noise: float
    map_noise: float
    pose_noise: float
    mean: Annotated[Row, Shape("3")]
    rms: Annotated[Row, Shape("3")]
    anomaly: float
    without_map: float

    @property
    def left(self) -> float:
        """Root mean square of the residuals per axis."""
        return float((sum(value**2 for value in self.rms) / 3) ** 0.5)

    @property
    def unexplained(self) -> float:
        """What is left beside what a uniform field would leave: 0 is all explained, 1 nothing."""
        return self.left / self.without_map if self.without_map > 0 else float("nan")


@dataclass(frozen=True)
class Normalised(Record):
    """Residuals in units of their standard deviations: squared lengths are chi-square of three.

    Attributes
    ----------
    std
        Per axis; 1 is consistent.
    edges, counts
        Histogram of squared lengths; the last bin holds all beyond.
    beyond_95
        Share of those beyond the 95 % quantile; 0.05 is consistent.
    """

    std: Annotated[Row, Shape("3")]
    edges: Annotated[Row, Shape("N+1")]
    counts: Annotated[tuple[int, ...], Shape("N")]
    beyond_95: float


@dataclass(frozen=True)
class Autocorrelation(Record):
    """How alike the normalised residuals of readings k apart are.

    Attributes
    ----------
    lags
        Readings apart, from 0.
    correlation
        Mean over the axes.
    step_s
        Median time between two readings.
    independent
        How many independent readings they are worth.
    """

    lags: Annotated[tuple[int, ...], Shape("N")]
    correlation: Annotated[Row, Shape("N")]
    step_s: float
    independent: float

    @property
    def next(self) -> float:
        """Correlation of neighbours."""
        return self.correlation[1] if len(self.correlation) > 1 else 0.0


@dataclass(frozen=True)
class Directions(Record):
    """From which directions the field came, seen from the lidar.

    Attributes
    ----------
    covered
        Share of the directions of space from which it came, within 15 degrees.
    spread
        Standard deviation of the field along its principal axes, the largest first.
    tilt_deg
        Between the highest and the lowest angle of the field over the lidar's xy plane.
    """

    covered: float
    spread: Annotated[Row, Shape("3")]
    tilt_deg: float


@dataclass(frozen=True)
class CurveErrors(Record):
    """Readings before and after the calibration beside the map's, all along the lidar's axes.

    Attributes
    ----------
    before, after
        Mean of the squared length of the difference to the map's reading, uT^2: the paper's e_B.
    before_axes, after_axes
        Mean absolute difference per axis.
    after_std
        Standard deviation of the difference after the calibration per axis.
    """

    before: float
    after: float
    before_axes: Annotated[Row, Shape("3")]
    after_axes: Annotated[Row, Shape("3")]
    after_std: Annotated[Row, Shape("3")]


@dataclass(frozen=True)
class Series(Record):
    """A thinned course of the drive as one sensor saw it, to be drawn.

    Attributes
    ----------
    seconds
        Since the first reading of any sensor in its drive, length N.
    place
        Of the sensor in the map, (N, 3).
    residual, normalised
        ``C b + H - z`` in the sensor frame, in uT and in sigmas, (N, 3).
    rejected
        Whether it does not count.
    before, after, map
        Readings along the lidar's axes: as read, corrected, and as the map has it, (N, 3).
    drive
        Which drive each is of, from 0, length N; absent where there is one.
    """

    seconds: Annotated[Row, Shape("N")]
    place: Annotated[Rows, Shape("N 3")]
    residual: Annotated[Rows, Shape("N 3")]
    normalised: Annotated[Rows, Shape("N 3")]
    rejected: Annotated[tuple[bool, ...], Shape("N")]
    before: Annotated[Rows, Shape("N 3")]
    after: Annotated[Rows, Shape("N 3")]
    map: Annotated[Rows, Shape("N 3")]
    drive: Annotated[tuple[int, ...] | None, Shape("N")] = None


@dataclass(frozen=True)
class SensorMetrics(Record):
    """All figures of one sensor that was solved.

    Of several drives there are comparisons of these in place of halves of a single one.
    """

    sensor: str
    mounting: Mounting
    fit: FitFigures
    normalised: Normalised
    autocorrelation: Autocorrelation
    directions: Directions
    curves: CurveErrors
    halves: Halves
    series: Series
    drives: Repeatability | None = None


@dataclass(frozen=True)
class MapPicture(Record):
    """The map around the drive at the sensors' middle height, on a coarse grid.

    Attributes
    ----------
    extent
        Left, right, bottom, top.
    height
        Of the cut.
    strength, sigma
        Length of the field and its standard deviation per axis; NaN where the map has no data.
    """

    extent: Annotated[Row, Shape("4")]
    height: float
    strength: Annotated[Rows, Shape("N M")]
    sigma: Annotated[Rows, Shape("N M")]

    def __post_init__(self) -> None:
        """Raise a ValueError for a place that cannot be drawn."""
        super().__post_init__()
        left, right, bottom, top = self.extent
        if not (-FAR <= left <= right <= FAR and -FAR <= bottom <= top <= FAR):
            raise ValueError(f"extent is {self.extent}, no place of at most {FAR:g} m")


@dataclass(frozen=True)
class DriveMetrics(Record):
    """How the vehicle moved, in all drives together.

    Attributes
    ----------
    path
        Places of the lidar in the map, thinned, (N, 3); NaN between two drives.
    seconds, length
        How long the drives were.
    heave
        Between the lowest and the highest place of the lidar.
    tilt_deg
        Largest angle between the lidar's z axis and its mean.
    heading
        Share of the headings that were driven, in steps of 15 degrees.
    """

    path: Annotated[Rows, Shape("N 3")]
    seconds: float
    length: float
    heave: float
    tilt_deg: float
    heading: float


@dataclass(frozen=True)
class Measures(Record):
    """The figures of one calibration that its verdict rests on.

    Attributes
    ----------
    sensors
        Those that were solved.
    drive
        How the vehicle moved.
    bags
        Paths of several drives, in the order in which series count them.
    """

    sensors: tuple[SensorMetrics, ...]
    drive: DriveMetrics
    bags: tuple[str, ...] | None = field(default=None, kw_only=True)

    def get(self, sensor: str) -> SensorMetrics | None:
        """Return the figures of a sensor; none if it was not solved."""
        return next((each for each in self.sensors if each.sensor == sensor), None)


@dataclass(frozen=True)
class Metrics(Measures):
    """All figures of one calibration.

    Attributes
    ----------
    map
        Around the drive.
    """

    map: MapPicture
