"""The base of every options model: frozen, documented field by field, unknown keys refused."""

from collections.abc import Collection

from pydantic import BaseModel, ConfigDict, ValidationError


class Options(BaseModel):
    """Options that stand beside their algorithm; ``config.py`` only composes them."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )


def first_fault(error: ValidationError, *above: str, hidden: Collection[str] = ()) -> str:
    """Return the first fault as the path of its key, and what is wrong with it.

    Parameters
    ----------
    error
        What pydantic raises.
    above
        Keys above those that were checked.
    hidden
        Levels that a file does not have.
    """
    fault = error.errors()[0]
    keys = (*above, *(str(part) for part in fault["loc"] if part not in hidden))
    return f"{'.'.join(keys) or 'the file'}: {fault['msg']}"
