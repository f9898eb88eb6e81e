"""How a drive is localised: key poses, odometry, start, tiles of an unknown field."""

from enum import StrEnum

from pydantic import Field, model_validator

from l2m_gtsam.errors import ConfigError
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.options import AnyQuaternion, Options
from l2m_gtsam.recording.odometry_jumps import JumpOptions
from l2m_gtsam.recording.regressors import ResampleOptions
from l2m_gtsam.solve.robust import RobustOptions


class StartSearchOptions(Options):
    """How the start of a drive is searched for in a whole map."""

    window_m: float = Field(default=8.0, gt=0)
    """Path length of the first window. It is doubled until the start is unique,"""
    longest_m: float = Field(default=32.0, gt=0)
    """up to this, or to the end of the drive: over more, odometry's errors blur what is compared.
    """
    readings: int = Field(default=80, ge=10, le=400)
    """Limit of readings of a window, spread over its path."""
    least_readings: int = Field(default=16, ge=6)
    """Fewer readings do not determine a place: among thousands one explains them by chance."""
    step_m: float = Field(default=0.2, ge=0.05, le=1)
    """Of the lattice of places in the map; headings are as far apart as moves the outermost reading
    by a step. The field of a building varies over about three times that."""
    height_m: float | None = None
    """Height of the lidar in the map where the drive begins, within `position_m`; searched for over
    all heights that the map has data for if not given."""
    outliers: float = Field(default=0.15, ge=0, lt=0.5)
    """Share of the readings that may be wrong without a place being ruled out."""
    seeds: int = Field(default=150, ge=10, le=2000)
    """The most places of the lattice that are followed to their minima,"""
    candidates: int = Field(default=8, ge=2, le=50)
    """and the most minima whose likelihoods are compared."""
    apart_m: float = Field(default=0.3, gt=0)
    """Minima closer than this,"""
    apart_deg: float = Field(default=10.0, gt=0, le=180)
    """and than this in rotation, are one place."""
    clear: float = Field(default=10.0, gt=0)
    """The start is unique if the second best place is less likely than the best by this factor's
    natural logarithm; 10 are odds of 22,000 to 1."""
    least_inside: float = Field(default=0.4, gt=0, le=1)
    """A place where the map has data for a smaller share of the readings does not count."""
    least_explained: float = Field(default=0.7, gt=0, le=1)
    """One that explains a smaller share of these is not where the drive was,"""
    largest_chi2: float = Field(default=2.0, gt=1)
    """nor is one that leaves more than so many times the variance of what is known to be wrong: on
    the recorded drives true places leave 0.2 to 1.7, a false one 2.2."""


NEEDS_MAP = "`slam.start.anywhere` searches a map for the start: give one with --map"
MOST_WAVES = 1000  # of a tile: what takes a matrix of 8 MB


class TileOptions(Options):
    """The tiles that an unknown field is described by; lengths in metres."""

    core: float = Field(default=3.0, gt=0.5, le=20)
    """A place belongs to a tile if it is within half of this of the pose the tile is fixed to,
    along both axes of that pose."""
    margin: float = Field(default=0.75, gt=0, le=5)
    """The box of a tile's waves reaches so far beyond its core."""
    modes: int = Field(default=200, ge=30, le=MOST_WAVES)
    """The most waves of a tile. What shorter ones would hold counts as noise."""
    last_core: float = Field(default=5.0, gt=0.5, le=20)
    """Size of tiles in the last stage off line, if it is larger than `core`, with waves as
    short, up to 1000: larger tiles connect more of the path, where it is known well enough for
    them."""
    learn_over_m: float = Field(default=20.0, gt=0)
    """Path length from the start over which strength and depth of the sources are learnt: over it
    odometry has to be better than the field's detail. Path without readings does not count."""
    hyperparameters: Hyperparameters | None = None
    """Strength and depth, where they are known; not learnt then."""

    @property
    def edge(self) -> float:
        """Edge of a tile's box in metres."""
        return self.core + 2 * self.margin

    @property
    def last(self) -> "TileOptions":
        """Tiles of the last stage off line: never smaller than the others."""
        return self.model_copy(update={"core": max(self.core, self.last_core)})


class WholeFieldOptions(Options):
    """The one field of a drive with a single sensor, or with several in a room, without a map."""

    waves: int = Field(default=500, ge=50, le=2000)
    """The most eigenfunctions. Where a coarse field needs more, it is described by tiles; the fine
    one in which a drive is solved at last has so many of the longest."""
    offset: float = Field(default=10.0, gt=0)
    """Standard deviation per axis of what steel on the vehicle adds to the readings beyond the
    calibration, uT. It is estimated even where the calibration is fixed: the poses would have to
    explain it."""
    distortion: float = Field(default=0.3, gt=0)
    """And of the entries of C: soft iron beside a sensor that was calibrated elsewhere, or not at
    all, comes to that. A drive that turns determines most of them, so that a larger value
    costs little."""
    online_distortion: float = Field(default=0.03, gt=0)
    """The same on line, where the drive so far is short: beside errors of the poses and an unknown
    field it does not determine as much, and poses follow what is wrong."""
    entries: int = Field(default=1_000_000, ge=0)
    """Of several sensors, off line: the most readings (means between key poses) times waves. Where
    there would be more, tiles alone describe the field; so they do with 0. A drive with as many
    takes two to five minutes of a processor."""
    solve_after_m: float = Field(default=10.0, gt=0)
    """On line, path length with readings after which the drive is solved for the first time, and
    again whenever it has grown by two fifths."""


class CalibrationUse(StrEnum):
    """What becomes of the sensors' calibration."""

    AUTO = "auto"
    FIXED = "fixed"
    REFINED = "refined"


class Usage(StrEnum):
    """What becomes of something that a recording may have."""

    USED = "used"
    IGNORED = "ignored"


class StepAxes(StrEnum):
    """Along which axes odometry knows its steps."""

    VEHICLE = "vehicle"
    FIXED = "fixed"


class KeyPoseOptions(Options):
    """Which poses of a drive are variables."""

    distance_m: float = Field(default=0.2, gt=0)
    """A key pose is made after this distance,"""
    angle_deg: float = Field(default=10.0, gt=0, le=180)
    """or after this rotation. Readings lie between key poses, as far along as
    odometry has them, and less surely so the further away both are."""
    readings: int = Field(default=8, ge=1)
    """The most readings of a sensor on a key pose, spread over its time: a vehicle that is parked
    reads one place again and again."""


class DriftOptions(Options):
    """How wrong odometry becomes, where the recording does not say or is not asked.

    Errors of odometry's steps count as independent, so that sigmas grow with the root of the
    distance. Shares are those after `over_m`: over less distance odometry is trusted less than with
    a constant share, over more it is trusted more, and there the map dominates.
    """

    position_share: float = Field(default=0.01, gt=0, lt=1)
    """Standard deviation of the position per axis, as a share of the distance."""
    rotation_deg_per_m: float = Field(default=0.05, gt=0)
    """Standard deviation of the rotation about each axis, in degrees per metre,"""
    rotation_share: float = Field(default=0.01, ge=0, lt=1)
    """and as a share of the turning itself."""
    height_share: float | None = Field(default=None, ge=0, lt=1)
    """Standard deviation of the height, along the third axis of the frame of the poses, in place of
    `position_share` (and of `steady`, in the same ratio): 0 for wheels on an even floor."""
    tilt_deg_per_m: float | None = Field(default=None, ge=0)
    """Standard deviation of roll and pitch, about axes across the third axis of the frame of the
    poses, in place of `rotation_deg_per_m` (and of `rotation_share`, in the same ratio): 0 where an
    even floor or gravity holds them."""
    over_m: float = Field(default=10.0, gt=0)
    """The distance over which these hold."""
    scale: float = Field(default=0.0, ge=0, lt=1)
    """Standard deviation of a relative error that all lengths share, as with wheels. It is
    estimated with the poses, and the other sigmas are of the remaining errors. With their wide
    defaults it is not needed."""
    steady: float | None = Field(default=None, ge=0, lt=1)
    """Standard deviation per axis of a drift that is the same all along the drive, along fixed axes
    as by a current, wind or a slope, as a share of the distance. It is estimated with the poses
    beside the independent errors. `position_share` where that counts, if not given; 0 for none. Not
    with `scale`."""
    steady_turn_deg_per_m: float = Field(default=0.0, ge=0)
    """Standard deviation of a turning about the third axis of the frame of the poses that is the
    same all along the drive, as by a gyroscope's bias or by unequal wheels, in degrees per metre.
    It is estimated with the poses. 0 for none. Not with `scale`."""
    axes: StepAxes = StepAxes.VEHICLE
    """Along which axes steps and turns are known: `vehicle`, as by wheels or scans, where an error
    of the heading turns all later steps; or `fixed`, as by beacons, where it turns none, and an
    error of a tilt does not tilt the axis of later turns. The latter works without a map,
    on line with one sensor."""
    stated: Usage = Usage.USED
    """Whether covariances that a recording states of its odometry count instead, where they grow
    along the drive."""
    least_m: float = Field(default=0.001, gt=0)
    """No step is known better than this,"""
    least_deg: float = Field(default=0.02, gt=0)
    """nor than this in rotation. Both are also added to what a recording states."""

    @property
    def of_height(self) -> float:
        """Ratio of the height's standard deviation to that along a level axis."""
        return 1.0 if self.height_share is None else self.height_share / self.position_share

    @property
    def of_tilt(self) -> float:
        """Ratio of the tilts' standard deviation to that of the heading."""
        return 1.0 if self.tilt_deg_per_m is None else self.tilt_deg_per_m / self.rotation_deg_per_m

    @model_validator(mode="after")
    def _scale_along_the_vehicle(self) -> "DriftOptions":
        if self.scale and self.axes is StepAxes.FIXED:
            raise ValueError("`scale` and `axes: fixed`: a scale is that of wheels, give one")
        if self.scale and self.steady:
            raise ValueError("`scale` and `steady`: one drive hardly separates them, give one")
        if self.scale and self.steady_turn_deg_per_m:
            raise ValueError("`scale` and `steady_turn_deg_per_m`: one is estimated, give one")
        return self


class StartPoseOptions(Options):
    """Where a drive begins in the map."""

    position: tuple[float, float, float] | None = None
    """Position of the lidar in the map in metres; that of the first recorded pose if not given."""
    quaternion_xyzw: AnyQuaternion | None = None
    """Rotation from lidar to map, of any length but zero; that of the first recorded pose if not
    given."""
    position_m: float = Field(default=0.1, gt=0)
    """Standard deviation of the position per axis in metres."""
    rotation_deg: float = Field(default=2.0, gt=0, le=45)
    """Standard deviation of the rotation about each axis in degrees."""
    anywhere: bool = False
    """The drive begins anywhere in the map: position and heading are searched for, by readings and
    odometry alone. The z axis of odometry's frame is assumed to be up within `rotation_deg`."""
    search: StartSearchOptions = StartSearchOptions()
    """How, with `anywhere`."""

    @property
    def is_given(self) -> bool:
        """Whether it is said where the drive begins; without a map its first pose is else exact."""
        return self.position is not None or self.quaternion_xyzw is not None

    @property
    def by_odometry(self) -> bool:
        """Whether the first recorded pose puts odometry into the map: both are in one frame."""
        is_given = self.position is not None and self.quaternion_xyzw is not None
        return not (self.anywhere or is_given)

    @model_validator(mode="after")
    def _known_or_not(self) -> "StartPoseOptions":
        if self.anywhere and (self.position is not None or self.quaternion_xyzw is not None):
            raise ValueError("`anywhere` and a `position` or `quaternion_xyzw`: give one of them")
        return self


class OnlineOptions(Options):
    """How data that come on line are taken."""

    delay_s: float = Field(default=0.2, ge=0, le=10)
    """A key pose is made so long after its time: readings that come later than that are refused."""
    silent_s: float = Field(default=2.0, gt=0)
    """A sensor without readings for so long is reported."""
    save_every_s: float = Field(default=60.0, gt=0)
    """The command saves its state so often, in the time of the recording."""


class SlamOptions(Options):
    """How a drive is localised."""

    max_pose_gap_s: float = Field(default=0.5, gt=0)
    """Readings between two odometry poses further apart than this are dropped."""
    regressors: ResampleOptions = ResampleOptions()
    """How recorded numbers, whose fields are taken off, get to the times of readings."""
    key_poses: KeyPoseOptions = KeyPoseOptions()
    """Which poses are variables."""
    drift: DriftOptions = DriftOptions()
    """How far odometry is trusted."""
    jumps: JumpOptions = JumpOptions()
    """Which of its steps are not believed at all."""
    start: StartPoseOptions = StartPoseOptions()
    """Where the drive begins."""
    calibration: CalibrationUse = CalibrationUse.AUTO
    """`refined`: estimated with the poses, with its covariance as the prior, so that its sigmas are
    in those of the poses. `fixed`: taken as exact. `auto`: refined; fixed where its sigmas are so
    small that readings do not show them, and for one sensor without map and scans, where the
    estimated field would absorb errors of the calibration."""
    scans: Usage = Usage.USED
    """`used`: point clouds, if the bag has any, are registered on the cloud of the map, or on each
    other where places are come to again; or `ignored`."""
    robust: RobustOptions = RobustOptions()
    """How readings are treated that the map does not explain. Scans that do not fit odometry and
    each other are left out with the same `confidence`."""
    tiles: TileOptions = TileOptions()
    """How the field is described where there is no map."""
    whole_field: WholeFieldOptions = WholeFieldOptions()
    """How it is described there where the drive has one sensor."""
    online: OnlineOptions = OnlineOptions()
    """How data are taken on line."""
    max_iterations: int = Field(default=50, ge=1)
    """The most steps of the optimiser in each round."""


def refuse_offline_only(options: SlamOptions, *, has_map: bool, one_field: bool) -> None:
    """Refuse what works off line only.

    Parameters
    ----------
    options
        As of ``OnlineSlam``.
    has_map
        Whether there is a map.
    one_field
        Whether there is a single sensor and nothing else that knows its places.

    Raises
    ------
    ConfigError
        Odometry knows its steps along fixed axes, in a map or with several sensors; or, without a
        map, the start is to be searched for, or the calibration of a single sensor to be refined.
    """
    if options.drift.axes is StepAxes.FIXED and not one_field:
        raise ConfigError(
            "`slam.drift.axes: fixed` works off line, and on line with one sensor and no map; give "
            "`vehicle`"
        )
    if has_map:
        return
    if options.start.anywhere:
        raise ConfigError(NEEDS_MAP)
    if options.calibration is CalibrationUse.REFINED and one_field:
        raise ConfigError(
            "`slam.calibration: refined` of one sensor without a map works off line only; on line "
            "give `auto` or `fixed`"
        )
