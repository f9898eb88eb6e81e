"""One configuration composed of the options beside each algorithm, read from YAML."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_origin

from pydantic import BaseModel, Field, ValidationError

from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.lidar.options import PointCloudOptions
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.options import Options, named_fault, words_of
from l2m_gtsam.planning.motion import PlanOptions
from l2m_gtsam.qa.options import FleetOptions, QaOptions
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.yaml_file import read_yaml
from l2m_gtsam.text import shown, shown_value

Model = TypeVar("Model", bound=BaseModel)

LONGEST_KEY, LONGEST_REASON = 120, 400  # letters
MOST_ENTRIES = 40  # of a report


EntryName = Annotated[str, Field(min_length=1, max_length=60)]
EntryText = Annotated[str, Field(max_length=300)]
ReportEntries = Annotated[dict[EntryName, EntryText], Field(max_length=MOST_ENTRIES)]


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
    lidar: PointCloudOptions = PointCloudOptions()
    """Poses from point clouds."""
    slam: SlamOptions = SlamOptions()
    """`l2m slam`."""
    qa: QaOptions = QaOptions()
    """Verdicts of `l2m report`."""
    fleet: FleetOptions = FleetOptions()
    """Outliers and pictures of `l2m batch`."""
    report: ReportEntries = Field(default_factory=dict)
    """What else the head of a report of `l2m calibrate` says, by name: vehicle, operator, place,
    serial numbers, temperature. Text; numbers in quotes. At most 40 entries of 60 and 300 letters;
    kept in `calibration.yaml` under `options`."""


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
        raise ConfigError(f"{path}: {fault_in(model, error)}") from error


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


def with_poses(
    config: Config, logs: Sequence[Path], poses: Sequence[Path], times: Path | None = None
) -> Config:
    """Return the configuration with the poses of drives in files; as it is where none is given.

    Parameters
    ----------
    logs
        The drives.
    poses
        A file for each of them, in their order.
    times
        Times of KITTI's poses.

    Raises
    ------
    ConfigError
        There are not as many files as drives, or times without poses.
    """
    if not poses:
        if times is not None:
            raise ConfigError("--pose-times: goes with --poses, a file of KITTI")
        return config
    if len(poses) != len(logs):
        raise ConfigError(
            f"--poses: {len(poses)} files for {len(logs)} drives; give one for each, in their order"
        )
    paths = {str(log): path for log, path in zip(logs, poses, strict=True)}
    given = {"paths": paths, "path": None} | ({} if times is None else {"times": times})
    pose_file = config.bag.pose_file.model_copy(update=given)
    bag = config.bag.model_copy(update={"pose_file": pose_file})
    return config.model_copy(update={"bag": bag})


def fault_in(model: type[BaseModel], error: ValidationError, *above: str) -> str:
    """Return one line about the first fault of options.

    Parameters
    ----------
    model
        Their kind.
    error
        What pydantic raises.
    above
        Keys above theirs.
    """
    fault = named_fault(error)
    parts = (*above, *map(str, fault["loc"]))
    key = shown(".".join(parts), LONGEST_KEY) or "the file"
    if fault["type"] == "extra_forbidden":
        accepted = ", ".join(_accepted(model, fault["loc"][:-1]))
        return f"unknown key {key!r}; accepted here: {accepted}"
    why = shown(words_of(fault), LONGEST_REASON)
    return f"{key}: {why}, got {shown_value(fault['input'])}"


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
