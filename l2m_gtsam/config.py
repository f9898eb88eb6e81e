"""One configuration composed of the options beside each algorithm, read from YAML."""

from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar, get_origin

from pydantic import BaseModel, Field, ValidationError

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.prior_options import PriorOptions
from l2m_gtsam.calibration.start.global_start import StartOptions
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.lidar.localisation import ScanLocalisationOptions, ScanStartOptions
from l2m_gtsam.lidar.loops import LoopOptions
from l2m_gtsam.lidar.odometry import OdometryOptions
from l2m_gtsam.lidar.search import SearchOptions
from l2m_gtsam.mapping.suite.options import SuiteOptions
from l2m_gtsam.maps.build import MapOptions
from l2m_gtsam.maps.compare import CompareOptions
from l2m_gtsam.options import Options
from l2m_gtsam.planning.motion import MotionOptions
from l2m_gtsam.qa.fleet.options import FleetOptions
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.recording.regressors import ResampleOptions
from l2m_gtsam.recording.sync import SyncOptions
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.solve.model_comparison import ModelOptions
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.cloud_topic import CloudTopicOptions
from l2m_gtsam.storage.scan_topic import ScanOptions
from l2m_gtsam.storage.yaml_file import read_yaml

Model = TypeVar("Model", bound=BaseModel)


class MappingOptions(Options):
    """How a map is built from mapping bags."""

    sync: SyncOptions = SyncOptions(thin_distance_m=0.05, thin_angle_deg=10.0)
    """Which readings enter; a map needs its readings spread in space, not in heading."""
    model: MapOptions = MapOptions()
    """The kind of map and its options."""
    structure: CloudTopicOptions = CloudTopicOptions(edge=0.05)
    """How a structure cloud is read: from a file, which is in the map frame, only `edge` counts."""
    lidar: CloudTopicOptions = CloudTopicOptions(edge=0.1, max_range=30.0)
    """How scans become the cloud that is saved with the map; their topic is `lidar.topic`."""
    compare: CompareOptions = CompareOptions()
    """How `l2m map compare` holds readings out."""
    suite: SuiteOptions = SuiteOptions()
    """How `l2m map suite` calibrates the sensors that map."""


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
    models: ModelOptions = ModelOptions()
    """How models of each sensor are compared after the solve."""
    regressors: ResampleOptions = ResampleOptions()
    """How the numbers of `bag.regressors` get to the times of the readings."""


class PoseSource(StrEnum):
    """Where the poses of a drive in a map come from."""

    AUTO = "auto"
    CLOUDS = "clouds"


class LidarOptions(Options):
    """How poses come from point clouds."""

    poses: PoseSource = PoseSource.AUTO
    """`auto`: from the clouds where a bag has no poses of its own, and the map has a cloud; or
    `clouds`: from the clouds, whatever else there is."""
    topic: str | None = None
    """Topic of type sensor_msgs/PointCloud2; if not given, the only one of the bag. Scans are in
    the frame of the lidar."""
    scan: ScanOptions = ScanOptions()
    """What is taken of each scan."""
    odometry: OdometryOptions = OdometryOptions()
    """How the lidar is followed from scan to scan."""
    start: ScanStartOptions | None = None
    """Where the drive begins in the map; looked for along the mapping drives if it is not given."""
    search: SearchOptions = SearchOptions()
    """How it is looked for."""
    localisation: ScanLocalisationOptions = ScanLocalisationOptions()
    """How scans are localised on the map's cloud."""
    loops: LoopOptions = LoopOptions()
    """How places are recognised that a drive returns to."""


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


class Config(Options):
    """Everything that can be configured."""

    bag: BagOptions = BagOptions()
    """What is read from a recording."""
    mapping: MappingOptions = MappingOptions()
    """`l2m map build`, `l2m map update`, `l2m map compare` and `l2m map suite`."""
    calibration: CalibrationOptions = CalibrationOptions()
    """`l2m calibrate`, and `l2m plan` before it."""
    plan: PlanOptions = PlanOptions()
    """`l2m plan`."""
    lidar: LidarOptions = LidarOptions()
    """Poses from point clouds."""
    slam: SlamOptions = SlamOptions()
    """`l2m slam`."""
    qa: QaOptions = QaOptions()
    """Verdicts of `l2m report`."""
    fleet: FleetOptions = FleetOptions()
    """Outliers and pictures of `l2m batch`."""


def load_config(path: Path | None) -> Config:
    """Return the configuration in a YAML file; defaults for what it leaves out.

    Raises
    ------
    ConfigError
        The file is missing or not YAML, or a key or value is not understood; the line names the
        key and what is accepted.
    """
    if path is None:
        return Config()
    return load_options(path, Config)


def load_options(path: Path, model: type[Model]) -> Model:
    """Return the options of a kind in a YAML file; errors as of ``load_config``."""
    content = read_yaml(path, ConfigError)
    try:
        return model.model_validate({} if content is None else content)
    except ValidationError as error:
        raise ConfigError(_explain(path, error, model)) from error


def with_uncertainty(config: Config, name: str | None) -> Config:
    """Return the configuration with the map's errors counted as named; as it is for None.

    Raises
    ------
    ConfigError
        The name is not known.
    """
    if name is None:
        return config
    if name not in list(Uncertainty):
        accepted = ", ".join(Uncertainty)
        raise ConfigError(f"--uncertainty: unknown {name!r}; accepted: {accepted}")
    solve = config.calibration.solve.model_copy(update={"uncertainty": Uncertainty(name)})
    calibration = config.calibration.model_copy(update={"solve": solve})
    return config.model_copy(update={"calibration": calibration})


def _explain(path: Path, error: ValidationError, model: type[BaseModel]) -> str:
    """Return one line about the first fault."""
    fault = error.errors()[0]
    key = ".".join(str(part) for part in fault["loc"]) or "the file"
    if fault["type"] == "extra_forbidden":
        accepted = ", ".join(_accepted(model, fault["loc"][:-1]))
        return f"{path}: unknown key {key!r}; accepted here: {accepted}"
    return f"{path}: {key}: {fault['msg']}, got {fault['input']!r}"


def _accepted(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the options at a location."""
    parts = iter(location)
    for part in parts:
        if str(part) not in model.model_fields:  # a place in a list of options
            continue
        inner: Any = model.model_fields[str(part)].annotation
        if get_origin(inner) is dict:
            next(parts, None)  # a name that the user gave
        candidates = [inner, *getattr(inner, "__args__", ())]
        nested = [c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)]
        if not nested:
            return []
        model = nested[0]
    return sorted(model.model_fields)
