"""The base of every options model: frozen, documented field by field, unknown keys refused."""

from pydantic import BaseModel, ConfigDict


class Options(BaseModel):
    """Options that stand beside their algorithm; ``config.py`` only composes them."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )
