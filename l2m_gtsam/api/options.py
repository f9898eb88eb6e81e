"""Options as a model or as the plain values of a configuration."""

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from l2m_gtsam.config import fault_in
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.options import Options

Model = TypeVar("Model", bound=Options)


def options_of(model: type[Model], given: Model | Mapping[str, Any] | None, name: str) -> Model:
    """Return options, defaults where none are given; a ConfigError names the first fault."""
    if isinstance(given, model):
        return given
    try:
        return model.model_validate({} if given is None else given)
    except ValidationError as error:
        raise ConfigError(fault_in(model, error, name)) from error
