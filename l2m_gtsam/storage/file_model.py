"""What files about sensors share: their vectors and matrices, and how a fault is told."""

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.storage.yaml_file import read_yaml

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


class Lenient(BaseModel):
    """A part of a file; what is derived from the rest is ignored when read."""

    model_config = ConfigDict(extra="ignore", frozen=True)


FileModel = TypeVar("FileModel", bound=BaseModel)


def read_model(path: Path, model: type[FileModel]) -> FileModel:
    """Return the content of a YAML file as its model.

    Raises
    ------
    CalibrationError
        The file is missing, is not YAML or is not of this form; the line names the first fault.
    """
    content = read_yaml(path, CalibrationError)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        fault = error.errors()[0]
        key = ".".join(str(part) for part in fault["loc"]) or "the file"
        msg = f"{path}: not a calibration file of this program: {key}: {fault['msg']}"
        raise CalibrationError(msg) from error
